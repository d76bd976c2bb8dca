"""The one place that turns what is wrong with a request into a short answer, 4xx.

Nothing of a body is read before the right is checked, nothing is ever inflated, and what nobody read ends
the connection.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import sqlite3
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
from aiohttp import web
from aiohttp.http import HttpProcessingError

from onedemo.app.network.bind import Listening
from onedemo.app.network.connections import NOT_UNDERSTOOD, Connection
from onedemo.app.network.rate_limit import Buckets

log = logging.getLogger("onedemo.page")

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

LARGEST_JSON = 1 << 14
"""Bytes of a press or an action: a few hundred are needed."""
BODY_S = 10.0
"""Until a body of that size has arrived."""
LOGIN_S = 15.0
"""Until somebody who opens a link is told how it went."""
_NOT_SAVED = "This could not be saved ({}). Nothing is lost: please try again."
_OFFENCES = (400, 408, 411, 413, 414, 415, 431)
"""Answers to what no browser sends by itself."""


class Refusals:
    """Two middlewares: one around everything, one around the handlers.

    Args:
        listening: Knows where requests come from.
        offences: Counts, for each sender, wrong links and broken requests of those without a session.
        person: The number of who asks; None for strangers.
    """

    def __init__(
        self, listening: Listening, offences: Buckets, person: Callable[[web.Request], int | None]
    ) -> None:
        self._listening, self._offences, self._person = listening, offences, person

    @web.middleware
    async def around(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Around everything, so that no answer is a traceback."""
        connection = request.protocol
        if isinstance(connection, Connection):
            connection.heard()
        try:
            check_headers(request)
            async with asyncio.timeout(LOGIN_S if request.path.endswith("/login") else None):
                response = await handler(request)
        except web.HTTPException as answer:
            response = answer
        except Exception as error:
            response = explain(error)
        if response.status in _OFFENCES and self._person(request) is None:
            sender = self._offences[self._listening.sender(request)]
            if not sender.take():
                response = web.HTTPTooManyRequests(text="Too many broken requests came from your address.")
        if not request.content.is_eof() and not response.prepared:
            response.force_close()
        if isinstance(response, web.HTTPException):
            raise response
        return response

    @web.middleware
    async def within(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Around the handlers: access has been checked by now."""
        person = self._person(request)
        if person is not None and isinstance(request.protocol, Connection):
            request.protocol.belongs_to(person)
        return await handler(request)


def check_headers(request: web.BaseRequest) -> None:
    """Refuses bodies that would have to be inflated or read in another character set.

    Raises:
        web.HTTPUnsupportedMediaType: If that is asked for.
    """
    if request.headers.get("Content-Encoding", "identity").strip().lower() != "identity":
        raise web.HTTPUnsupportedMediaType(text="Nothing encoded (Content-Encoding) is taken here.")
    if (request.charset or "utf-8").lower() not in ("utf-8", "utf8"):
        raise web.HTTPUnsupportedMediaType(text="Text is taken as UTF-8 alone.")


async def read_body(request: web.BaseRequest, most: int = LARGEST_JSON) -> bytes:
    """A body that is small and comes soon.

    Args:
        request: Of somebody who may send one.
        most: Bytes.

    Raises:
        web.HTTPException: If it is larger, or takes more than 10 s.
    """
    too_large = web.HTTPRequestEntityTooLarge(most, most, text=f"No more than {most} bytes are taken here.")
    if (request.content_length or 0) > most:
        raise too_large
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for block in request.content.iter_any():
                body += block
                if len(body) > most:
                    raise too_large
    except TimeoutError:
        raise web.HTTPRequestTimeout(text=f"The request did not arrive within {BODY_S:g} s.") from None
    return bytes(body)


async def read_json(request: web.BaseRequest) -> Any:
    """What a browser sends for an action.

    Raises:
        web.HTTPException: As ``read_body``.
        ValueError: If it is no JSON, or none that anybody needs.
    """
    body = await read_body(request)
    try:
        return msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None


def explain(error: Exception) -> web.HTTPException:
    """The answer to what a handler did not expect."""
    if isinstance(error, sqlite3.Error):
        log.error("the database could not be used: %s", error)
        return web.HTTPServiceUnavailable(text=_NOT_SAVED.format(error))
    if isinstance(error, TimeoutError):
        return web.HTTPServiceUnavailable(text="The server is very busy. Please try again in a minute.")
    too_long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
    # The last two: a body that is not as announced.
    hostile = (OverflowError, RecursionError, UnicodeError, HttpProcessingError, web.RequestPayloadError)
    if too_long or isinstance(error, hostile):
        return web.HTTPBadRequest(text=NOT_UNDERSTOOD)
    if isinstance(error, ConnectionError):  # whoever asked has gone
        return web.HTTPBadRequest(text="The connection ended.")
    log.error("a request could not be answered", exc_info=error)
    return web.HTTPInternalServerError(text="Something went wrong here. It has been noted.")
