"""Who may come in: links and cookies, the role that each route asks for, what goes with every answer.

A link's token becomes a cookie. A route is served only to those whose role it names; one that names
none is served to nobody.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from typing import Literal, NamedTuple

from aiohttp import web

from app import assets
from app.links import hash_token, new_session_token
from trainer.records import Rater
from trainer.store import Store

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
Role = Literal["stranger", "annotator", "researcher"]


class Route(NamedTuple):
    """One address of the front, and the least that somebody must be to get it."""

    method: Literal["GET", "POST"]
    path: str
    role: Role
    handler: Handler


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
_SESSION_DAYS = 30
_MOST_SESSIONS = 8
"""Sessions of one browser that are looked at."""


class Door:
    """Recognises who asks and lets nobody through to what is not theirs.

    Args:
        store: Knows the tokens.
        port: Tells the port of the front, once it is open.
    """

    def __init__(self, store: Store, port: Callable[[], int]) -> None:
        self._store = store
        self._port = port
        self._login = (assets.STATIC / "login.html").read_text()

    def application(self, routes: Iterable[Route]) -> web.Application:
        """A server of these routes and nothing else."""
        table = tuple(routes)
        self._least = {route.handler: _RANK.get(route.role, 0) for route in table}
        app = web.Application(middlewares=[self._guard], client_max_size=1 << 16)
        # Not web.get: it would add HEAD, which would open links without anybody looking.
        app.add_routes([web.route(route.method, route.path, route.handler) for route in table])
        return app

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            response = await self._let_in(request, handler)
        except web.HTTPException as problem:
            response = problem
        if not response.prepared:
            response.headers.update(SECURITY_HEADERS)
            response.headers.setdefault("Cache-Control", "no-store")
        if isinstance(response, web.HTTPException):
            raise response
        return response

    async def _let_in(self, request: web.Request, handler: Handler) -> web.StreamResponse:
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
        return await handler(request)

    async def _recognise(self, request: web.Request) -> None:
        """Notes who asks. One browser may hold sessions of several raters, each with its own tabs."""
        known: list[tuple[Rater, str]] = []
        cookies = [value for name, value in request.cookies.items() if name.startswith(self._cookie(""))]
        for token in cookies[:_MOST_SESSIONS]:
            digest = hash_token(token)
            rater = await asyncio.to_thread(self._store.rater_of, digest, "session")
            if rater is not None:
                known.append((rater, digest))
        if "rater" in request.match_info:  # the page, and its WebSocket, of this rater alone
            wanted = int(request.match_info["rater"])
            known = [(rater, digest) for rater, digest in known if rater.id == wanted]
        # Elsewhere the most that any of the sessions may do.
        known.sort(key=lambda entry: entry[0].role != "researcher")
        if known:
            request[RATER], request[SESSION] = known[0]

    def _cookie(self, rater: int | str) -> str:
        # Browsers share cookies between the ports of a host; two studies on one machine must not.
        return f"onedemo-{self._port()}-{rater}"

    def _login_page(self, status: int) -> web.Response:
        notes = {
            200: "",
            401: "",
            403: "This link does not work. It may be incomplete, or it was withdrawn.",
        }
        html = self._login.replace("<!-- note -->", notes[status])
        return web.Response(text=html, content_type="text/html", status=status)

    async def log_in(self, request: web.Request) -> web.StreamResponse:
        """Trades the token of a link for a cookie."""
        token = request.query.get("token", "")
        if not token:
            return self._login_page(200)
        rater = await asyncio.to_thread(self._store.rater_of, hash_token(token), "link")
        if rater is None:
            return self._login_page(403)
        session = new_session_token()
        await asyncio.to_thread(self._store.add_token, hash_token(session), rater.id, "session")
        response = web.HTTPSeeOther(f"/r/{rater.id}")
        # Lax, not Strict: a link is opened from a mail or a chat, and the redirect must carry it.
        response.set_cookie(
            self._cookie(rater.id),
            session,
            max_age=_SESSION_DAYS * 86400,
            httponly=True,
            samesite="Lax",
            secure=request.secure,
            path="/",
        )
        return response


def same_origin(request: web.Request) -> bool:
    """Whether a page of this front sent the request."""
    origin = request.headers.get("Origin", "")
    return origin in (f"http://{request.host}", f"https://{request.host}")
