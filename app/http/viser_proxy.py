"""The WebSocket of a page, passed on to Viser, which listens on the loopback only.

Viser serves nothing else that a browser needs, so nothing else is passed on. A proxy before this server may
not pass it on, or not as it came: then nothing happens in the browser, and the log says what is wrong.
"""

from __future__ import annotations

import asyncio
import logging
import re
import sqlite3
from contextlib import suppress
from typing import Protocol

from aiohttp import (
    ClientError,
    ClientSession,
    ClientTimeout,
    ClientWebSocketResponse,
    WSCloseCode,
    WSMsgType,
    web,
)

from onedemo.app.http.auth import same_origin
from onedemo.app.http.sessions import RATER, SESSION
from onedemo.app.http.viser_protocol import known
from onedemo.app.network.connections import Connection
from onedemo.app.network.rate_limit import (
    BYTES_AT_ONCE,
    BYTES_PER_S,
    LARGEST_MESSAGE,
    MESSAGES_AT_ONCE,
    MESSAGES_PER_S,
    MOST_PAGES,
    MOST_PAGES_EACH,
    Bucket,
    Places,
)
from onedemo.storage.store import Store
from onedemo.types import Rater

log = logging.getLogger("onedemo.page")

RATER_HEADER = "X-Onedemo-Rater"
SECRET_HEADER = "X-Onedemo-Secret"
SCHEME_HEADER = "X-Onedemo-Scheme"
TAB_HEADER = "X-Onedemo-Tab"

_PROTOCOL = re.compile(r"viser-v[0-9A-Za-z.+-]{1,40}")
_CONNECT_S = 10.0
_CLOSE_S = 2.0
"""What a browser has to answer that its page is closed."""
_LOOK_S = 1.0
"""How soon a page is closed whose session has ended."""
_FOLLOWED_S = 20.0
"""Within this time a page opens its socket."""
_MOST_FOLLOWED = 1000
"""Sessions of which it is remembered that their page opens sockets: those that did so last."""
_MOST_WARNINGS = 20
"""Of each kind."""
_PROXY = "a proxy before this server must pass on WebSockets and the Host header; see `onedemo proxy nginx`"


class Behind(Protocol):
    """Where Viser is, and what opens it."""

    port: int
    secret: str


class Proxy:
    """Carries the messages of all pages.

    Args:
        page: The Viser page behind the public port.
        store: Knows whose session still holds.
        most_pages: Open at once.
    """

    def __init__(self, page: Behind, store: Store, *, most_pages: int = MOST_PAGES) -> None:
        self._page, self._store = page, store
        self._sockets: dict[web.WebSocketResponse, str] = {}
        """Each open page, with the session it belongs to."""
        self._places = Places(most_pages, MOST_PAGES_EACH)
        self._followed: dict[str, None] = {}
        """Sessions whose page has opened a socket, the last of them, in order."""
        self._warned: dict[str, set[str]] = {}
        self._upstream: ClientSession | None = None
        self._watching: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Makes it ready, in the loop it is used in."""
        self._upstream = ClientSession(timeout=ClientTimeout(total=None, sock_connect=_CONNECT_S))
        self._watching = asyncio.ensure_future(self._end_sessions())

    async def close(self) -> None:
        """Closes every page's socket."""
        if self._watching is not None:
            self._watching.cancel()
        if self._sockets:  # whoever does not answer is not waited for
            ends = [asyncio.ensure_future(each.close(code=WSCloseCode.GOING_AWAY)) for each in self._sockets]
            await asyncio.wait(ends, timeout=_CLOSE_S)
        if self._upstream is not None:
            await self._upstream.close()

    async def socket(self, request: web.Request) -> web.StreamResponse:
        """Joins a browser's socket to one of Viser's until either ends or the session is revoked."""
        if not same_origin(request):
            origin = request.headers.get("Origin", "none")[:200]
            self._warn(
                "origin", f"{origin} {request.host}",
                "a page was refused its connection: it came from %a, and was asked for at %a; " + _PROXY,
                origin, request.host,
            )  # fmt: skip
            raise web.HTTPForbidden(text="This page can only be used from its own address.")
        self._note_socket(request[SESSION])
        with self._places.one(request[RATER].id) as free:
            if not free:
                raise web.HTTPServiceUnavailable(
                    text="Too many pages are open. Close some and reload this one."
                )
            return await self._join(request)

    def expect(self, request: web.Request) -> None:
        """Notes that a page was given to a browser, and warns unless it opens its socket."""
        if request[SESSION] not in self._followed:
            asyncio.get_running_loop().call_later(
                _FOLLOWED_S, self._look_for_socket, request[RATER], request[SESSION]
            )

    def _note_socket(self, session: str) -> None:
        self._followed.pop(session, None)
        self._followed[session] = None
        if len(self._followed) > _MOST_FOLLOWED:
            del self._followed[next(iter(self._followed))]

    def _look_for_socket(self, rater: Rater, session: str) -> None:
        if session not in self._followed:
            self._warn(
                "socket", rater.name,
                "the page of %s was opened, and its connection did not come within %d s; " + _PROXY,
                rater.name, _FOLLOWED_S,
            )  # fmt: skip

    def _warn(self, kind: str, what: str, text: str, *values: object) -> None:
        """Logs something once, and so many such things in all: strangers cause them."""
        warned = self._warned.setdefault(kind, set())
        if what not in warned and len(warned) < _MOST_WARNINGS:
            warned.add(what)
            log.warning(text, *values)

    async def _join(self, request: web.Request) -> web.StreamResponse:
        assert self._upstream is not None
        offered = ",".join(request.headers.getall("Sec-WebSocket-Protocol", ()))
        protocols = [name.strip() for name in offered.split(",")]
        if not all(_PROTOCOL.fullmatch(name) for name in protocols):
            raise web.HTTPBadRequest(text="Only the page itself can use this connection.")
        scheme = "dark" if request.cookies.get("scheme") == "dark" else "light"
        # Only what is named here goes on: nothing of the client's own headers reaches Viser.
        identity = {
            RATER_HEADER: str(request[RATER].id),
            SECRET_HEADER: self._page.secret,
            SCHEME_HEADER: scheme,
            TAB_HEADER: request.match_info.get("tab", ""),
        }
        try:
            async with asyncio.timeout(_CONNECT_S):
                inside = await self._upstream.ws_connect(
                    f"http://127.0.0.1:{self._page.port}/",
                    protocols=protocols,
                    headers=identity,
                    max_msg_size=0,
                )
        except (ClientError, TimeoutError):
            raise web.HTTPServiceUnavailable(text="The page cannot be had just now. Please reload.") from None
        async with inside:
            outside = web.WebSocketResponse(
                protocols=protocols, heartbeat=30, max_msg_size=LARGEST_MESSAGE, compress=False,
                autoping=False, timeout=_CLOSE_S,
            )  # fmt: skip
            await outside.prepare(request)
            if isinstance(request.protocol, Connection):  # whatever they are part of: frames, too, cost time
                request.protocol.allow(Bucket(BYTES_PER_S, BYTES_AT_ONCE))
            self._sockets[outside] = request[SESSION]
            try:
                await _pump(inside, outside)
            finally:
                del self._sockets[outside]
                await outside.close()
        return outside

    async def _end_sessions(self) -> None:
        """Closes pages whose session was revoked, signed out or has expired; notes use of the others."""
        while True:
            await asyncio.sleep(_LOOK_S)
            sessions = set(self._sockets.values())
            self._store.accounts.note_use(sessions)
            try:
                ended = await asyncio.to_thread(self._store.accounts.ended_sessions, sessions)
            except sqlite3.Error:  # locked, say: it is looked at again
                continue
            for browser, session in tuple(self._sockets.items()):
                if session in ended:
                    await browser.close(code=WSCloseCode.POLICY_VIOLATION, message=b"this session has ended")
            with suppress(sqlite3.Error):  # what is left is written the next time
                await asyncio.to_thread(self._store.audit.finish)


async def _pump(inside: ClientWebSocketResponse, outside: web.WebSocketResponse) -> None:
    tasks = [asyncio.ensure_future(_show(inside, outside)), asyncio.ensure_future(_listen(outside, inside))]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _show(inside: ClientWebSocketResponse, outside: web.WebSocketResponse) -> None:
    """Passes on what the page says to the browser."""
    async for message in inside:
        if message.type is not WSMsgType.BINARY:
            return
        await outside.send_bytes(message.data)


async def _listen(outside: web.WebSocketResponse, inside: ClientWebSocketResponse) -> None:
    """Passes on what a browser may say, and drops the rest; a flood ends the connection."""
    messages = Bucket(MESSAGES_PER_S, MESSAGES_AT_ONCE)
    async for message in outside:
        if not messages.take():
            await outside.close(code=WSCloseCode.POLICY_VIOLATION, message=b"too many messages")
            return
        if message.type is WSMsgType.PING:
            await outside.pong(message.data)
        elif message.type is WSMsgType.BINARY and known(message.data):
            await inside.send_bytes(message.data)
