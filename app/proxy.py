"""The WebSocket of a page, passed on to Viser, which listens on the loopback only.

Viser serves nothing else that a browser needs, so nothing else is passed on.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Protocol

from aiohttp import ClientSession, WSMsgType, web

from app.door import RATER, SESSION, same_origin
from trainer.store import Store

RATER_HEADER = "X-Onedemo-Rater"
SECRET_HEADER = "X-Onedemo-Secret"
SESSION_HEADER = "X-Onedemo-Session"
SCHEME_HEADER = "X-Onedemo-Scheme"

_MAX_CLIENT_MESSAGE = 1 << 20
"""Bytes a browser may send in one message; what the page needs is a few hundred."""


class Behind(Protocol):
    """Where Viser is, and what opens it."""

    port: int
    secret: str


class Proxy:
    """Carries the messages of all pages.

    Args:
        page: The Viser page behind the door.
        store: Knows whose session still holds.
    """

    def __init__(self, page: Behind, store: Store) -> None:
        self._page, self._store = page, store
        self._sockets: set[web.WebSocketResponse] = set()
        self._upstream: ClientSession | None = None

    async def open(self) -> None:
        """Makes it ready, in the loop it is used in."""
        self._upstream = ClientSession()

    async def close(self) -> None:
        """Closes every page's socket."""
        for browser in tuple(self._sockets):
            await browser.close(code=1001)
        if self._upstream is not None:
            await self._upstream.close()

    async def socket(self, request: web.Request) -> web.StreamResponse:
        """Joins a browser's socket to one of Viser's until either ends or the session is revoked."""
        if not same_origin(request):
            raise web.HTTPForbidden(text="This page can only be used from its own address.")
        assert self._upstream is not None
        offered = request.headers.get("Sec-WebSocket-Protocol", "")
        protocols = [name.strip() for name in offered.split(",") if name.strip()]
        scheme = "dark" if request.cookies.get("scheme") == "dark" else "light"
        # Only what is named here goes on: nothing of the client's own headers reaches Viser.
        identity = {
            RATER_HEADER: str(request[RATER].id),
            SECRET_HEADER: self._page.secret,
            SESSION_HEADER: request[SESSION],
            SCHEME_HEADER: scheme,
        }
        inside = await self._upstream.ws_connect(
            f"http://127.0.0.1:{self._page.port}/",
            protocols=protocols,
            headers=identity,
            max_msg_size=0,
        )
        async with inside:
            outside = web.WebSocketResponse(
                protocols=protocols, heartbeat=30, max_msg_size=_MAX_CLIENT_MESSAGE, compress=False
            )
            await outside.prepare(request)
            self._sockets.add(outside)
            try:
                await self._pump(request[SESSION], inside, outside)
            finally:
                self._sockets.discard(outside)
                await outside.close()
        return outside

    async def _pump(self, session: str, inside, outside: web.WebSocketResponse) -> None:
        tasks = [
            asyncio.ensure_future(_forward(inside, outside)),
            asyncio.ensure_future(_forward(outside, inside)),
            asyncio.ensure_future(self._until_revoked(session)),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _until_revoked(self, session: str) -> None:
        look = partial(self._store.rater_of, session, "session")
        while await asyncio.to_thread(look) is not None:
            await asyncio.sleep(5)


async def _forward(source, target) -> None:
    async for message in source:
        if message.type is WSMsgType.BINARY:
            await target.send_bytes(message.data)
        elif message.type is WSMsgType.TEXT:
            await target.send_str(message.data)
        else:
            return
