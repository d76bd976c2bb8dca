"""Who may come in: links and cookies, the role that each route asks for, what goes with every answer.

A link's token becomes a cookie. A route is served only to those whose role it names; one that names
none is served to nobody.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from typing import Literal, NamedTuple
from urllib.parse import parse_qs

from aiohttp import web

from onedemo.app.http.bind import Listening
from onedemo.app.http.rate_limit import WRONG_LINKS_AT_ONCE, WRONG_LINKS_PER_S, Buckets
from onedemo.app.http.refusals import read_body
from onedemo.app.http.tokens import hash_token, new_session_token
from onedemo.app.templates import render
from onedemo.storage.accounts import SESSION_DAYS, Link
from onedemo.storage.store import Store
from onedemo.types import Rater

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


RATER = web.RequestKey("rater", Rater)
SESSION = web.RequestKey("session", str)
"""The hash of the cookie's token."""

# Viser's script is inline and compressed, hence unsafe-inline and WebAssembly. The one thing that
# asks for unsafe-eval is its sorter of Gaussian splats, which we do not show: it is refused.
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; worker-src blob:; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; media-src 'self'; "
        "font-src 'self' data:; "
        # Viser follows ?websocket=ws://elsewhere; this keeps it at home.
        "connect-src 'self' data: blob:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
}

_RANK = {"annotator": 1, "researcher": 2}
"""Each may do what those before it may. Whoever is not named is a stranger."""
_LONGEST_LOGIN = 1024
"""Bytes of the form of the login page."""
_MOST_SESSIONS = 8
"""Sessions of one browser that are looked at."""


class AccessControl:
    """Recognises who asks and lets nobody through to what is not theirs.

    Args:
        store: Knows the tokens.
        listening: Which hosts may be named, and who asks.
        port: Tells the port of the front, once it is open.
    """

    def __init__(self, store: Store, listening: Listening, port: Callable[[], int]) -> None:
        self._store = store
        self._listening = listening
        self._port = port
        self.offences = Buckets(WRONG_LINKS_PER_S, WRONG_LINKS_AT_ONCE)
        """Of each sender: wrong links, and requests that no browser sends."""

    def application(self, routes: Iterable[Route]) -> web.Application:
        """A server of these routes and nothing else."""
        table = tuple(routes)
        self._least = {route.handler: _RANK.get(route.role, 0) for route in table}
        self._audited = {route.handler: route.audit for route in table if route.audit}
        app = web.Application(middlewares=[self._guard], client_max_size=1 << 16)
        app.add_routes([web.route(route.method, route.path, route.handler) for route in table])
        return app

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            response = await self._let_in(request, handler)
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
        await self._recognise(request)
        have = _RANK.get(request[RATER].role, 0) if RATER in request else 0
        # An address that does not exist is no secret, but strangers are not told which ones do.
        unknown = request.match_info.http_exception is not None
        least = 1 if unknown else self._least.get(request.match_info.handler)
        if least is None:
            raise web.HTTPForbidden(text="Nobody may do that.")
        if have < least:
            if have == 0:
                return self._login_page(401)
            raise web.HTTPForbidden(text="Only researchers may do that.")
        if request.method == "POST" and not same_origin(request):
            raise web.HTTPForbidden(text="This page can only be used from its own address.")
        if what := self._audited.get(request.match_info.handler):
            detail = request.query_string
            await asyncio.to_thread(self._store.audit.add, request[RATER].name, what, detail)
        return await handler(request)

    async def _recognise(self, request: web.Request) -> None:
        """Notes who asks. One browser may hold sessions of several raters, each with its own tabs."""
        known: list[tuple[Rater, str]] = []
        for token in self._tokens(request):
            digest = hash_token(token)
            rater = await asyncio.to_thread(self._store.accounts.rater_of, digest, "session")
            if rater is not None:
                known.append((rater, digest))
        if "rater" in request.match_info:  # the page, and its WebSocket, of this rater alone
            wanted = int(request.match_info["rater"])
            known = [(rater, digest) for rater, digest in known if rater.id == wanted]
        # Elsewhere the most that any of the sessions may do.
        known.sort(key=lambda entry: entry[0].role != "researcher")
        if known:
            request[RATER], request[SESSION] = known[0]

    def _tokens(self, request: web.Request) -> list[str]:
        prefix = self._cookie("")
        return [value for name, value in request.cookies.items() if name.startswith(prefix)][:_MOST_SESSIONS]

    def _cookie(self, rater: int | str) -> str:
        # Browsers share cookies between the ports of a host; two studies on one machine must not.
        return f"onedemo-{self._port()}-{rater}"

    def _login_page(self, status: int, note: str = "", token: str = "") -> web.Response:
        """What to do without a session; with a token, the button that opens its link."""
        html = render("login.html", note=note, token=token, days=SESSION_DAYS)
        return web.Response(text=html, content_type="text/html", status=status)

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
            return response
        return await self._open(request, token, link)

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
        session = new_session_token()
        opened = None
        if link is not None:
            opened = await asyncio.to_thread(
                self._store.accounts.open_link, hash_token(token), hash_token(session)
            )
        if opened is None:
            return await self._refuse(request, token, link)
        await asyncio.to_thread(self._store.audit.add, opened.rater.name, "signed in", f"link {opened.id}")
        response = web.HTTPSeeOther(f"/r/{opened.rater.id}")
        # Lax, not Strict: a link is opened from a mail or a chat, and the redirect must carry it.
        response.set_cookie(
            self._cookie(opened.rater.id),
            session,
            max_age=SESSION_DAYS * 86400,
            httponly=True,
            samesite="Lax",
            secure=self._listening.encrypted(request),
            path="/",
        )
        return response

    async def _refuse(self, request: web.Request, token: str, link: Link | None) -> web.StreamResponse:
        if not self.offences[self._listening.sender(request)].take():  # of links that open, none is refused
            return self._login_page(429, _REFUSED["too many"])
        address = self._listening.client(request)
        why = "unknown" if link is None else link.state
        await asyncio.to_thread(self._store.audit.add, address, "sign-in refused", f"{why} link")
        if link is None:
            return self._login_page(403, _REFUSED["unknown"])
        if link.state in ("used", "expired"):  # clicked again in the browser that it let in
            for session in self._tokens(request):
                if (
                    await asyncio.to_thread(self._store.accounts.link_of_session, hash_token(session))
                    == link.id
                ):
                    raise web.HTTPSeeOther(f"/r/{link.rater.id}")
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
