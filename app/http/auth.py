"""Who may come in: links and cookies, the role that each route asks for, what goes with every answer.

A link's token becomes a cookie. A route is served only to those whose role it names; one that names
none is served to nobody.
"""

from __future__ import annotations

import asyncio
import sqlite3
import threading
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from typing import Literal, NamedTuple
from urllib.parse import parse_qs

from aiohttp import web

from onedemo.app.http import assets
from onedemo.app.http.sessions import RATER, Sessions
from onedemo.app.http.tokens import hash_token, new_session_token, session_token_of
from onedemo.app.network.bind import Listening
from onedemo.app.network.rate_limit import (
    STRANGERS_AT_ONCE,
    STRANGERS_PER_S,
    WRONG_LINKS_AT_ONCE,
    WRONG_LINKS_PER_S,
    Buckets,
)
from onedemo.app.network.refusals import read_body
from onedemo.app.templates import render
from onedemo.storage.accounts import SESSION_DAYS, Link
from onedemo.storage.store import Store

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
Role = Literal["stranger", "annotator", "researcher"]


class Route(NamedTuple):
    """One address of the front, and the least that somebody must be to get it."""

    method: Literal["GET", "POST"]
    path: str
    role: Role
    handler: Handler
    audit: str = ""
    """What the audit log says when it was served; "" for what is not worth a line."""
    names_page: bool = True
    """Of a POST: whether it is let through only if it names an open page. A handler that looks for itself at
    something that no other site can know, such as the token of a link, says no."""


PAGE_HEADER = "X-Onedemo-Page"
"""In what a page sends: the name of that page. Another site can neither read it nor send such a header."""

SECURITY_HEADERS = {
    "Content-Security-Policy": assets.POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}

_RANK = {"annotator": 1, "researcher": 2}
"""Each may do what those before it may. Whoever is not named is a stranger."""
_SLOWED_S = 1.0
"""Until somebody who asks too often is told so; only so many connections can wait for that."""
_TOO_OFTEN = "Too many requests came from your address. Please wait a minute."
_LONGEST_LOGIN = 1024
"""Bytes of the form of the login page."""


class AccessControl:
    """Recognises who asks and lets nobody through to what is not theirs.

    Args:
        store: Knows the tokens.
        listening: Which hosts may be named, and who asks.
        port: Tells the port of the front, once it is open.
        is_open: Whether a rater, by number, has a page of that name open.
    """

    def __init__(
        self, store: Store, listening: Listening, port: Callable[[], int],
        is_open: Callable[[int, str], bool] = lambda rater, page: False,
    ) -> None:  # fmt: skip
        self._store = store
        self._listening = listening
        self._is_open = is_open
        self.sessions = Sessions(store, listening, port)
        self.offences = Buckets(WRONG_LINKS_PER_S, WRONG_LINKS_AT_ONCE)
        """Of each sender: wrong links, and requests that no browser sends."""
        self._strangers = Buckets(STRANGERS_PER_S, STRANGERS_AT_ONCE)

    def application(self, routes: Iterable[Route]) -> web.Application:
        """A server of these routes and nothing else."""
        table = tuple(routes)
        self._least = {route.handler: _RANK.get(route.role, 0) for route in table}
        self._audited = {route.handler: route.audit for route in table if route.audit}
        self._unnamed = {route.handler for route in table if not route.names_page}
        app = web.Application(middlewares=[self._guard], client_max_size=1 << 16)
        # Without the base path, too: some proxies take it off, and a health check need not know it.
        for base in {"", self._listening.base_path}:
            app.add_routes([web.route(route.method, base + route.path, route.handler) for route in table])
        return app

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            response = await self._let_in(request, handler)
        except web.HTTPNotFound as nothing:
            response = self._nothing_here(request) or nothing
        except web.HTTPException as problem:
            response = problem
        if not response.prepared:
            for name, value in SECURITY_HEADERS.items():
                response.headers.setdefault(name, value)
            response.headers.setdefault("Cache-Control", "no-store")
        if isinstance(response, web.HTTPException):
            raise response
        return response

    async def _let_in(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if not self._listening.knows(request.host):
            raise web.HTTPMisdirectedRequest(
                text="onedemo does not go by this name. Whoever started it can allow it with --allow-host."
            )
        if request.method not in ("GET", "POST"):  # aiohttp answers HEAD by GET, which would open links
            raise web.HTTPMethodNotAllowed(request.method, ["GET", "POST"])
        await self.sessions.recognise(request)
        if RATER not in request:
            await self._slow_down(request)
        have = _RANK.get(request[RATER].role, 0) if RATER in request else 0
        # An address that does not exist is no secret, but strangers are not told which ones do.
        unknown = request.match_info.http_exception is not None
        least = 1 if unknown else self._least.get(request.match_info.handler)
        if least is None:
            raise web.HTTPForbidden(text="Nobody may do that.")
        if have < least:
            if have == 0:
                return await self._ask_for_link(request)
            raise web.HTTPForbidden(text="Only researchers may do that.")
        if request.method == "POST":
            self._check_page(request)
        if what := self._audited.get(request.match_info.handler):
            detail = request.query_string
            await asyncio.to_thread(self._store.audit.note, request[RATER].name, what, detail)
        return await handler(request)

    async def _slow_down(self, request: web.Request) -> None:
        """Strangers are answered only so often; beyond that late, and once for each connection.

        A link counts for itself, wherever it is opened: one that opens is not refused for what others do.
        """
        token = request.query.get("token", "") if request.path.endswith("/login") else ""
        if not self._strangers[hash_token(token) if token else self._listening.sender(request)].take():
            await asyncio.sleep(_SLOWED_S)
            refusal = web.HTTPTooManyRequests(text=_TOO_OFTEN)
            refusal.force_close()
            raise refusal

    def _check_page(self, request: web.Request) -> None:
        if not same_origin(request):
            raise web.HTTPForbidden(text="This page can only be used from its own address.")
        if request.match_info.handler in self._unnamed:
            return
        page = request.headers.get(PAGE_HEADER, "")
        if not page:
            raise web.HTTPForbidden(text=f"This is done from a page, which names itself in {PAGE_HEADER}.")
        if not self._is_open(request[RATER].id, page):
            raise web.HTTPConflict(text="This page had lost its connection. Please try again in a moment.")

    def _login_page(
        self, status: int, note: str = "", token: str = "", mine: tuple[str, str] | None = None
    ) -> web.Response:
        """What to do without a session.

        Args:
            status: Of the answer.
            note: What happened.
            token: With it there is the button that opens its link.
            mine: Name and address of the page of whoever is signed in here, at an address of another person.
        """
        html = render(
            "login.html", base=self._listening.base_path, note=note, token=token, days=SESSION_DAYS, mine=mine
        )
        return web.Response(text=html, content_type="text/html", status=status)

    async def _ask_for_link(self, request: web.Request) -> web.Response:
        """The login page in place of a tab that somebody was sent: signing in leads there."""
        tab = request.match_info.get("tab", "")
        rater = await self.sessions.last(request) if "rater" in request.match_info else None
        mine = None if rater is None else (rater.name, self._listening.page_path(rater.id) + tab)
        response = self._login_page(401, mine=mine)
        if tab:
            self.sessions.keep_tab(request, response, tab)
        return response

    def _nothing_here(self, request: web.Request) -> web.Response | None:
        """The answer to somebody who went to an address that there is not; None for a program."""
        if RATER not in request or "text/html" not in request.headers.get("Accept", ""):
            return None
        html = render(
            "missing.html", base=self._listening.base_path, page=self._listening.page_path(request[RATER].id)
        )
        return web.Response(text=html, content_type="text/html", status=404)

    async def log_in(self, request: web.Request) -> web.StreamResponse:
        """Trades the token of a link for a cookie; one that opens once gets a page with a button first.

        Programs that look at a link before a person does (mail scanners, previews in a chat) press no
        button, so they do not use it up.
        """
        token = request.query.get("token", "")
        if not token:
            return self._login_page(200)
        link = await asyncio.to_thread(self._store.accounts.link, hash_token(token))
        if link is not None and link.once and link.state == "open":
            response = self._login_page(200, token=token)
            # With no-referrer a browser would not say that it is this page that posts the form.
            response.headers["Referrer-Policy"] = "same-origin"
            if not self.sessions.nonce(request):
                self.sessions.put_nonce(request, response)
            return response
        return await self._open(request, token, link)

    async def signed_out(self, request: web.Request) -> web.Response:
        """What is seen after signing out."""
        return self._login_page(200, "You are signed out: nobody can go on with your page in this browser.")

    async def press_button(self, request: web.Request) -> web.StreamResponse:
        """Opens the link of the page with the button."""
        if request.content_type != "application/x-www-form-urlencoded":
            raise web.HTTPUnsupportedMediaType(text="A link is opened by the form of its page.")
        body = await read_body(request, _LONGEST_LOGIN)
        fields = parse_qs(body.decode("utf-8", "replace"))
        token = fields.get("token", [""])[0]
        if not token:
            return self._login_page(403, _REFUSED["unknown"])
        link = await asyncio.to_thread(self._store.accounts.link, hash_token(token))
        return await self._open(request, token, link)

    async def _open(self, request: web.Request, token: str, link: Link | None) -> web.StreamResponse:
        if link is None:
            return await self._refuse(request, token, link)
        session = (
            await self._session_of(request, link) or self._foreseen(request, token) or new_session_token()
        )
        opened = await self._trade(token, session)
        if opened is None:
            return await self._refuse(request, token, link)
        with suppress(sqlite3.Error):  # the link is used, so its owner is let in
            await asyncio.to_thread(
                self._store.audit.note, opened.rater.name, "signed in", f"link {opened.id}"
            )
        return self._let_go_on(request, opened, session)

    def _let_go_on(self, request: web.Request, link: Link, session: str) -> web.StreamResponse:
        """The way to the person's page, with its cookies."""
        tab = self.sessions.kept_tab(request)
        response = web.HTTPSeeOther(self._listening.page_path(link.rater.id) + tab)
        self.sessions.put(request, response, link.rater.id, session)
        return response

    def _foreseen(self, request: web.Request, token: str) -> str | None:
        """The session that this browser gets by a link that opens once: the same each time it asks.

        The answer to the press of the button may be lost after the link was used up. It is known to whoever
        has both the link and the number that came with the button.
        """
        nonce = self.sessions.nonce(request)
        return session_token_of(token, nonce) if nonce else None

    async def _trade(self, token: str, session: str) -> Link | None:
        """As ``Accounts.open_link``; a link is not used up for somebody who was sent away meanwhile."""
        decided = threading.Lock()

        def first() -> bool:
            return decided.acquire(blocking=False)

        opening = asyncio.ensure_future(
            asyncio.to_thread(self._store.accounts.open_link, hash_token(token), hash_token(session), first)
        )
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            if first():
                raise
            return await opening  # it is being committed

    async def _session_of(self, request: web.Request, link: Link) -> str | None:
        """The session that this browser has by that link already, as far as the request tells."""
        for token in self.sessions.tokens(request):
            if await asyncio.to_thread(self._store.accounts.link_of_session, hash_token(token)) == link.id:
                return token
        return None

    async def _refuse(self, request: web.Request, token: str, link: Link | None) -> web.StreamResponse:
        if link is not None and link.state == "used" and (session := self._foreseen(request, token)):
            came_by = await asyncio.to_thread(self._store.accounts.link_of_session, hash_token(session))
            if came_by == link.id:  # asked again: the answer was lost on its way
                return self._let_go_on(request, link, session)
        if link is not None and link.state in ("used", "expired") and request.method == "GET":
            # Clicked again in the browser that it let in? The person's own cookie is sent below /r/N alone.
            page = self._listening.page_path(link.rater.id)
            if "rater" not in request.match_info:
                raise web.HTTPSeeOther(f"{page}login?{request.query_string}")
            if await self._session_of(request, link) is not None:
                raise web.HTTPSeeOther(page)
        if not self.offences[self._listening.sender(request)].take():  # of links that open, none is refused
            await asyncio.sleep(_SLOWED_S)
            response = self._login_page(429, _REFUSED["too many"])
            response.force_close()
            return response
        address = self._listening.client(request)
        why = "unknown" if link is None else link.state
        await asyncio.to_thread(
            self._store.audit.note, address, "sign-in refused", f"{why} link", stranger=True
        )
        if link is None:
            return self._login_page(403, _REFUSED["unknown"])
        # Read anew: of two who press at once, one finds it used.
        now = await asyncio.to_thread(self._store.accounts.link, hash_token(token))
        assert now is not None
        return self._login_page(403, _REFUSED.get(now.state, _REFUSED["unknown"]))


_REFUSED = {
    "too many": "Too many wrong links came from your address. Please try again in a minute.",
    "unknown": "This link does not work. It may be incomplete.",
    "used": "This link was used already, and opens only once. Please ask for another.",
    "expired": "The time of this link is over. Please ask for another.",
    "revoked": "This link was revoked. Please ask for another if you still take part.",
}


def same_origin(request: web.Request) -> bool:
    """Whether a page of this front sent the request."""
    origin = request.headers.get("Origin", "")
    return origin in (f"http://{request.host}", f"https://{request.host}")
