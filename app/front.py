"""The public HTTP port: who may come in, and what they get.

A link's token becomes a cookie; without a session nothing is served but the login page, its style
sheet and ``/healthz``. The page itself is Viser's single HTML file with our style sheet and key
handling added; its WebSocket is passed on to Viser, which listens on the loopback only and builds a
page for nobody who does not come through here (see ``app.server``). Viser serves nothing else that
a browser needs, so nothing else is passed on.
"""

from __future__ import annotations

import asyncio
import socket
import sqlite3
import threading
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from aiohttp import ClientSession, WSMsgType, web

from app import assets
from app.actions import Actions
from app.downloads import Downloads, Handler
from app.links import hash_token, new_session_token
from app.pictures import Pictures
from trainer.errors import UserError
from trainer.records import Rater, Status
from trainer.store import Store

RATER_HEADER = "X-Onedemo-Rater"
SECRET_HEADER = "X-Onedemo-Secret"
SESSION_HEADER = "X-Onedemo-Session"
SCHEME_HEADER = "X-Onedemo-Scheme"

_SESSION_DAYS = 30
_MAX_CLIENT_MESSAGE = 1 << 20
"""Bytes a browser may send in one message; what the page needs is a few hundred."""

# Viser's script is inline and compressed, hence unsafe-inline and WebAssembly. The one thing that
# asks for unsafe-eval is its sorter of Gaussian splats, which we do not show: it is refused.
_SECURITY_HEADERS = {
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

_RATER = web.RequestKey("rater", Rater)
_SESSION = web.RequestKey("session", str)
_MOST_SESSIONS = 8
"""Sessions of one browser that are looked at."""


class Trained(Protocol):
    """What the front needs to know of a trainer."""

    store: Store
    run: str

    def status(self) -> Status:
        """What the trainer is doing."""
        ...

    def clip_file(self, clip_id: int) -> Path:
        """The picture of a clip."""
        ...

    def pair_file(self, pair_id: int) -> Path:
        """The picture of a pair."""
        ...

    def rollout_file(self, iteration: int, suffix: str) -> Path:
        """The best rollout of an iteration."""
        ...


class Inside(Protocol):
    """What the front needs to know of the page behind it."""

    port: int
    secret: str

    @property
    def trainer(self) -> Trained:
        """The run that is served."""
        ...

    @property
    def pictures(self) -> Pictures:
        """Of its demo."""
        ...

    def note(
        self, rater_id: int, clip: int, *, mark: tuple[float, float] | None = None, reason: str | None = None
    ) -> bool:
        """What a browser says of a clip besides its rating."""
        ...


def check_port(host: str, port: int) -> None:
    """Raises UserError if the port cannot be opened now; to be called before anything is written."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError, UnicodeError) as error:
        raise _explain(error, host, port) from None


class Front:
    """The public door, in a thread with an event loop of its own.

    Args:
        page: The Viser page behind the door; its trainer is the run that is served.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
    """

    def __init__(self, page: Inside, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self._page = page
        self._store = page.trainer.store
        self._actions = Actions(page)
        self._host = host
        self._port = port
        self._html = assets.page_html()
        self._login = (assets.STATIC / "login.html").read_text()
        self._sockets: set[web.WebSocketResponse] = set()
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The port it listens on."""
        return self._port

    def start(self) -> str:
        """Opens the port and returns the URL of the front.

        Raises:
            UserError: If the port cannot be opened.
        """
        ready: threading.Event = threading.Event()
        failure: list[BaseException] = []
        self._thread = threading.Thread(
            target=self._run, args=(ready, failure), name="onedemo-front", daemon=True
        )
        self._thread.start()
        ready.wait()
        if failure:
            self._thread.join()
            raise _explain(failure[0], self._host, self._port) from None
        shown = "127.0.0.1" if self._host in ("", "0.0.0.0", "::") else self._host
        return f"http://{f'[{shown}]' if ':' in shown else shown}:{self._port}"

    def close(self) -> None:
        """Closes the port and every connection."""
        if self._thread is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(timeout=10)

    # The thread

    def _run(self, ready: threading.Event, failure: list[BaseException]) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve(ready))
        except Exception as error:  # whatever it is: the caller must not believe the port open
            failure.append(error)
        finally:
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
            self._loop.close()
            ready.set()

    async def _serve(self, ready: threading.Event) -> None:
        runner = web.AppRunner(self._application(), access_log=None, shutdown_timeout=2)
        await runner.setup()
        try:
            async with ClientSession() as self._upstream:
                site = web.TCPSite(runner, self._host, self._port)
                await site.start()
                self._port = runner.addresses[0][1]
                ready.set()
                await self._stop.wait()
                for browser in tuple(self._sockets):
                    await browser.close(code=1001)
        finally:
            await runner.cleanup()

    def _application(self) -> web.Application:
        app = web.Application(middlewares=[self._guard], client_max_size=1 << 16)
        app.add_routes(
            [
                web.get("/", self._home),
                web.get(r"/r/{rater:\d{1,9}}", self._page_of),
                web.post(r"/r/{rater:\d{1,9}}/note", self._note),
                web.post(r"/r/{rater:\d{1,9}}/do", _for_researchers(self._do)),
                web.get("/login", self._log_in),
                web.get("/healthz", self._health),
                web.get("/static/{name}", self._static),
                web.get(r"/clips/{clip:\d{1,15}}.jpg", self._clip),
                web.get(r"/pairs/{pair:\d{1,15}}.jpg", self._pair),
                web.get(r"/rollouts/{iteration:\d{1,9}}.{suffix:jpg|webm}", _for_researchers(self._rollout)),
                web.get(r"/demo/frames/{index:\d{1,6}}.jpg", self._demo_frame),
                web.get(r"/demo/examples/{name:[a-z]{1,20}}.jpg", self._demo_example),
                *Downloads(self._store, _SECURITY_HEADERS).routes(_for_researchers),
            ]
        )
        return app

    # Who may come in

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            await self._recognise(request)
            if _RATER not in request and not _is_public(request.path):
                response: web.StreamResponse = self._login_page(401)
            else:
                response = await handler(request)
        except web.HTTPException as problem:
            response = problem
        if not response.prepared:
            response.headers.update(_SECURITY_HEADERS)
            response.headers.setdefault("Cache-Control", "no-store")
        if isinstance(response, web.HTTPException):
            raise response
        return response

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
            request[_RATER], request[_SESSION] = known[0]

    def _cookie(self, rater: int | str) -> str:
        # Browsers share cookies between the ports of a host; two studies on one machine must not.
        return f"onedemo-{self._port}-{rater}"

    def _login_page(self, status: int) -> web.Response:
        notes = {
            200: "",
            401: "",
            403: "This link does not work. It may be incomplete, or it was withdrawn.",
        }
        html = self._login.replace("<!-- note -->", notes[status])
        return web.Response(text=html, content_type="text/html", status=status)

    async def _log_in(self, request: web.Request) -> web.StreamResponse:
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

    # What they get

    async def _home(self, request: web.Request) -> web.StreamResponse:
        raise web.HTTPSeeOther(f"/r/{request[_RATER].id}")

    async def _page_of(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._socket(request)
        return web.Response(text=self._html, content_type="text/html")

    async def _note(self, request: web.Request) -> web.Response:
        if not _same_origin(request):
            raise web.HTTPForbidden(text="This page can only be used from its own address.")
        try:
            note = read_note(await request.json())
            noted = await asyncio.to_thread(partial(self._page.note, request[_RATER].id, **note))
        except ValueError as error:
            raise web.HTTPBadRequest(text=f"This could not be noted: {error}.") from None
        except sqlite3.Error as error:
            raise web.HTTPServiceUnavailable(text=f"This could not be saved ({error}).") from None
        if not noted:
            raise web.HTTPConflict(text="That clip is not on screen any more.")
        return web.Response(status=204)

    async def _do(self, request: web.Request) -> web.Response:
        if not _same_origin(request):
            raise web.HTTPForbidden(text="This page can only be used from its own address.")
        try:
            await asyncio.to_thread(self._actions.do, request[_RATER], await request.json())
        except (ValueError, UserError) as error:
            raise web.HTTPBadRequest(text=f"This could not be done: {error}.") from None
        except sqlite3.Error as error:
            raise web.HTTPServiceUnavailable(text=f"This could not be saved ({error}).") from None
        return web.Response(status=204)

    async def _health(self, request: web.Request) -> web.Response:
        status = self._page.trainer.status()
        healthy = status.phase != "failed"
        return web.json_response({"ok": healthy, "version": version("onedemo"), "phase": status.phase})

    async def _static(self, request: web.Request) -> web.StreamResponse:
        path = assets.STATIC / request.match_info["name"]
        if path.parent != assets.STATIC or path.suffix not in assets.SERVED or not path.is_file():
            raise web.HTTPNotFound()
        return web.FileResponse(path, headers={"Cache-Control": "no-cache"})

    async def _clip(self, request: web.Request) -> web.StreamResponse:
        number = int(request.match_info["clip"])
        clip = await asyncio.to_thread(self._store.clip, number)
        if clip is None or clip.run != self._page.trainer.run:
            raise web.HTTPNotFound()
        path = self._page.trainer.clip_file(number)
        if not path.is_file():
            raise web.HTTPNotFound()
        return web.FileResponse(path, headers=_KEEP | {"Content-Type": "image/jpeg"})

    async def _pair(self, request: web.Request) -> web.StreamResponse:
        number = int(request.match_info["pair"])
        run = await asyncio.to_thread(self._store.pair_run, number)
        path = self._page.trainer.pair_file(number)
        if run != self._page.trainer.run or not path.is_file():
            raise web.HTTPNotFound()
        return web.FileResponse(path, headers=_KEEP | {"Content-Type": "image/jpeg"})

    async def _rollout(self, request: web.Request) -> web.StreamResponse:
        iteration, suffix = int(request.match_info["iteration"]), request.match_info["suffix"]
        try:
            path = await asyncio.to_thread(self._page.trainer.rollout_file, iteration, suffix)
        except FileNotFoundError:
            raise web.HTTPNotFound() from None
        kind = {"jpg": "image/jpeg", "webm": "video/webm"}[suffix]
        return web.FileResponse(path, headers=_KEEP | {"Content-Type": kind})

    async def _demo_frame(self, request: web.Request) -> web.StreamResponse:
        frames = await asyncio.to_thread(self._page.pictures.frames)
        index = int(request.match_info["index"])
        if index >= len(frames):
            raise web.HTTPNotFound()
        return web.Response(body=frames[index], content_type="image/jpeg", headers=_KEEP)

    async def _demo_example(self, request: web.Request) -> web.StreamResponse:
        examples = await asyncio.to_thread(self._page.pictures.examples)
        example = examples.get(request.match_info["name"])
        if example is None:
            raise web.HTTPNotFound()
        return web.Response(body=example, content_type="image/jpeg", headers=_KEEP)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if not _same_origin(request):
            raise web.HTTPForbidden(text="This page can only be used from its own address.")
        offered = request.headers.get("Sec-WebSocket-Protocol", "")
        protocols = [name.strip() for name in offered.split(",") if name.strip()]
        scheme = "dark" if request.cookies.get("scheme") == "dark" else "light"
        # Only what is named here goes on: nothing of the client's own headers reaches Viser.
        identity = {
            RATER_HEADER: str(request[_RATER].id),
            SECRET_HEADER: self._page.secret,
            SESSION_HEADER: request[_SESSION],
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
                await self._pump(request[_SESSION], inside, outside)
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


_KEEP = {"Cache-Control": "private, max-age=31536000, immutable"}
"""Addresses of what differs between runs or demos end in ?v= and what they are of."""


async def _forward(source, target) -> None:
    async for message in source:
        if message.type is WSMsgType.BINARY:
            await target.send_bytes(message.data)
        elif message.type is WSMsgType.TEXT:
            await target.send_str(message.data)
        else:
            return


def _for_researchers(handler: Handler) -> Handler:
    async def checked(request: web.Request) -> web.StreamResponse:
        if request[_RATER].role != "researcher":
            raise web.HTTPForbidden(text="Only researchers may do that.")
        return await handler(request)

    return checked


def read_note(body: Any) -> dict[str, Any]:
    """What a browser says of a clip: ``{"clip": 7, "mark": [0.1, 0.2] or null}`` or ``{"clip", "reason"}``.

    Raises:
        ValueError: If it is anything else.
    """
    if not isinstance(body, dict) or set(body) not in ({"clip", "mark"}, {"clip", "reason"}):
        raise ValueError("a note has a clip, and a mark or a reason")
    clip, mark, reason = body["clip"], body.get("mark"), body.get("reason")
    if type(clip) is not int or not 0 < clip < 2**53:
        raise ValueError("a clip is a number")
    if "reason" in body:
        if not isinstance(reason, str) or not reason.strip() or not reason.isprintable():
            raise ValueError("a reason is one line of text")
        return {"clip": clip, "reason": reason.strip()}
    numbers = mark if isinstance(mark, list) else ()
    if mark is not None and not (len(numbers) == 2 and all(type(x) in (int, float) for x in numbers)):
        raise ValueError("a mark is two numbers")
    return {"clip": clip, "mark": None if mark is None else (float(mark[0]), float(mark[1]))}


def _is_public(path: str) -> bool:
    return path in ("/login", "/healthz") or path in assets.PUBLIC


def _same_origin(request: web.Request) -> bool:
    origin = request.headers.get("Origin", "")
    return origin in (f"http://{request.host}", f"https://{request.host}")


def _explain(error: BaseException, host: str, port: int) -> UserError:
    if isinstance(error, OSError) and error.errno in (98, 48, 10048):
        return UserError(f"port {port} on {host} is in use; choose another with --port")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return UserError(f"port {port} on {host} cannot be opened ({reason}); choose another with --port")
