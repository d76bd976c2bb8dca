"""The public HTTP port: one table of what there is and who may have it.

``auth`` and ``sessions`` say who asks, ``media`` and ``exports`` hand out files, ``uploads`` takes videos,
`viser_proxy`` carries the page's WebSocket to Viser. The page itself is our HTML and scripts, and Viser's
client taken out of its one file (``assets``). The connections below all this are ``onedemo.app.network``.
"""

from __future__ import annotations

import asyncio
import sqlite3
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import version
from typing import Any, Protocol

from aiohttp import web

from onedemo.app.annotation.presses import PageGone, Press, read_press
from onedemo.app.annotation.rating_session import AnsweredElsewhere
from onedemo.app.http import assets
from onedemo.app.http.auth import SECURITY_HEADERS, AccessControl, Route
from onedemo.app.http.commands import Actions
from onedemo.app.http.curves import Curves
from onedemo.app.http.exports import Downloads
from onedemo.app.http.invitations import page_address
from onedemo.app.http.mask_preview import MaskPreview
from onedemo.app.http.media import Files, Filmed
from onedemo.app.http.sessions import PERSON, RATER
from onedemo.app.http.uploads import Uploads
from onedemo.app.http.viser_proxy import Proxy
from onedemo.app.network.bind import Listening, not_opened
from onedemo.app.network.capacity import Limits, raise_descriptors
from onedemo.app.network.connections import Connections
from onedemo.app.network.rate_limit import (
    ACTIONS_WAITING,
    PRESSES_AT_ONCE,
    PRESSES_PER_S,
    PRESSES_WAITING,
    PRESSES_WAITING_EACH,
    Buckets,
    Places,
)
from onedemo.app.network.refusals import Refusals, read_body, read_json
from onedemo.app.services.demo_images import Pictures
from onedemo.errors import UserError
from onedemo.types import Demo, Status

_CLOSE_S = 1.0
"""What requests that are being answered have when the port closes."""
_HEALTH_S = 5.0
"""A trainer that has not said by then how it is, is not well."""
_THREADS = 32
"""For whatever may take long: exports, uploads, links. They wait for the disk, not for each other."""
_PRESSING_THREADS = 8
UPLOAD = r"/demos/{upload:[0-9a-f]{32}}"
"""Where a video is that was sent and not kept yet."""
_TLS_ALONE = {"Strict-Transport-Security": "max-age=31536000"}


class Trained(Filmed, Protocol):
    """What the front needs to know of a trainer."""

    demo: Demo

    def status(self) -> Status:
        """What the trainer is doing."""
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

    def press(self, rater_id: int, press: Press) -> bool:
        """Carries out what somebody pressed; whether it counted."""
        ...

    def is_open(self, rater_id: int, token: str) -> bool:
        """Whether somebody has a page of that name open."""
        ...

    def tabs(self, role: str) -> list[str]:
        """The tabs of a role as their addresses end, the first one first."""
        ...


class Front:
    """The public port, in a thread with an event loop of its own.

    Args:
        page: The Viser page behind this port; its trainer is the run that is served.
        listening: Where to listen, and under which names.
    """

    def __init__(self, page: Inside, listening: Listening) -> None:
        store = page.trainer.store
        self._page = page
        self._listening = listening
        self._host = listening.host
        self._port = listening.port
        self._tls = listening.ssl_context()
        self._actions = Actions(page)
        self._files = Files(page)
        self._curves = Curves(page)
        self._downloads = Downloads(store, SECURITY_HEADERS)
        self._uploads = Uploads(store.path.parent)
        self._access = AccessControl(store, listening, lambda: self._port, page.is_open)
        self._refusals = Refusals(listening, self._access.offences, _person)
        limits = Limits.of(raise_descriptors(), addresses_known=not listening.behind_proxy)
        self._connections = Connections(limits, addresses_known=not listening.behind_proxy)
        self._proxy = Proxy(page, store, most_pages=limits.pages)
        # Threads of their own: whatever waits in one of them, nothing else waits for it.
        self._pressing = ThreadPoolExecutor(_PRESSING_THREADS, "onedemo-press")
        self._acting = ThreadPoolExecutor(1, "onedemo-action")
        self._looking = ThreadPoolExecutor(1, "onedemo-health")
        self._presses = Buckets(PRESSES_PER_S, PRESSES_AT_ONCE)
        self._pressed = Places(PRESSES_WAITING, PRESSES_WAITING_EACH)
        self._acted = Places(ACTIONS_WAITING, ACTIONS_WAITING)
        self._health_asked: asyncio.Future[Status] | None = None
        self._html, self._policy = assets.page_html(), assets.PAGE_POLICY
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The port it listens on."""
        return self._port

    def routes(self) -> tuple[Route, ...]:
        """All there is, each with the least role that it asks for."""
        files, downloads, uploads = self._files, self._downloads, self._uploads
        sessions = self._access.sessions
        # The page asks for these below its person; programs may leave the person out.
        either = (
            Route("GET", "/static/{name}", "annotator", files.static),
            Route("GET", "/static/vendor/{package}/{name}", "annotator", files.vendored),
            Route("GET", "/static/viser/{name}", "annotator", files.viser),
            Route("GET", r"/clips/{clip:\d{1,15}}.jpg", "annotator", files.clip),
            Route("GET", r"/pairs/{pair:\d{1,15}}.jpg", "annotator", files.pair),
            Route("GET", r"/demo/frames/{index:\d{1,6}}.jpg", "annotator", files.demo_frame),
            Route("GET", "/demo/video.webm", "annotator", files.demo_video),
            Route("GET", r"/demo/examples/{name:[a-z]{1,20}}.jpg", "annotator", files.demo_example),
            Route("GET", r"/rollouts/{iteration:\d{1,9}}.{suffix:jpg|webm}", "researcher", files.rollout),
            Route("GET", "/curves.json", "researcher", self._curves.curves),
            Route("GET", "/export.csv", "researcher", downloads.csv, "downloaded ratings"),
            Route("GET", "/comparisons.csv", "researcher", downloads.comparisons, "downloaded comparisons"),
            Route("GET", "/skips.csv", "researcher", downloads.skips, "downloaded skips"),
            Route("GET", "/segments.parquet", "researcher", downloads.parquet, "downloaded segments"),
            Route("GET", "/export.zip", "researcher", downloads.everything, "downloaded everything"),
            Route("GET", "/card.md", "researcher", downloads.card, "downloaded the data card"),
            Route("GET", "/preview", "researcher", downloads.preview),
            Route("GET", "/ratings", "researcher", downloads.given),
            Route("GET", r"/demos/{demo:[0-9a-f]{64}}.jpg", "researcher", uploads.picture),
            Route("POST", "/demos", "researcher", uploads.add, "uploaded a video"),
            Route("GET", UPLOAD + "/poster.jpg", "researcher", uploads.poster),
            Route("POST", UPLOAD + "/result", "researcher", uploads.bring_in),
            Route("GET", UPLOAD + r"/result-{result:\d{1,6}}.webm", "researcher", uploads.result),
            Route("POST", UPLOAD + "/mask", "researcher", MaskPreview(uploads).find),
            Route(
                "GET", UPLOAD + r"/result-{result:\d{1,6}}-{end:first|last}.jpg", "researcher", uploads.still
            ),
            Route("POST", UPLOAD + "/keep", "researcher", uploads.keep, "added a demo"),
            Route("POST", UPLOAD + "/discard", "researcher", uploads.discard),
        )
        return (
            Route("GET", "/login", "stranger", self._access.log_in),
            Route("GET", PERSON + "/login", "stranger", self._access.log_in),
            Route("POST", "/login", "stranger", self._access.press_button, names_page=False),
            Route("GET", "/signed-out", "stranger", self._access.signed_out),
            Route("GET", "/healthz", "stranger", self._health),
            *(
                Route("GET", f"/static/{name}", "stranger", files.login_static)
                for name in sorted(assets.PUBLIC)
            ),
            Route("GET", "/", "annotator", self._home),
            Route("GET", PERSON, "annotator", self._page_of),
            Route("GET", PERSON + "/", "annotator", self._page_of),
            Route("GET", PERSON + "/session", "stranger", sessions.state),
            Route("POST", PERSON + "/signout", "annotator", sessions.sign_out),
            Route("POST", PERSON + "/press", "annotator", self._press, names_page=False),
            Route("POST", PERSON + "/do", "researcher", self._do),
            *either,
            *(route._replace(path=PERSON + route.path) for route in either),
            Route("GET", PERSON + r"/{tab:[a-z]{1,20}}", "annotator", self._page_of),
        )

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
            raise not_opened(failure[0], self._host, self._port) from None
        return self._listening.address(self._port)

    def close(self) -> None:
        """Closes the port and every connection."""
        if self._thread is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(timeout=10)

    # The thread

    def _run(self, ready: threading.Event, failure: list[BaseException]) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.set_default_executor(threads := ThreadPoolExecutor(_THREADS, "onedemo-front"))
        try:
            self._loop.run_until_complete(self._serve(ready))
        except Exception as error:  # whatever it is: the caller must not believe the port open
            failure.append(error)
        finally:
            # What is still being answered would ask for a thread after there are none.
            for task in (left := asyncio.all_tasks(self._loop)):
                task.cancel()
            self._loop.run_until_complete(asyncio.wait(left, timeout=_CLOSE_S) if left else asyncio.sleep(0))
            sessions = self._access.sessions.threads
            pools = (threads, sessions, self._pressing, self._acting, self._looking)
            ends = [threading.Thread(target=pool.shutdown, daemon=True) for pool in pools]
            for end in ends:
                end.start()
            for end in ends:
                end.join(_CLOSE_S)  # a film that is being drawn is not waited for
            for pool in pools:
                pool.shutdown(wait=False, cancel_futures=True)
            self._loop.close()
            ready.set()

    async def _serve(self, ready: threading.Event) -> None:
        application = self._access.application(self.routes())
        application.middlewares.insert(0, self._refusals.around)
        application.middlewares.append(self._refusals.within)
        application.on_response_prepare.append(self._add_headers)
        runner = web.AppRunner(application, access_log=None, shutdown_timeout=_CLOSE_S)
        await runner.setup()
        assert runner.server is not None
        await self._proxy.open()
        try:
            self._port = await self._connections.open(runner.server, self._host, self._port, self._tls)
            ready.set()
            await self._stop.wait()
        finally:
            await self._connections.close()
            await self._proxy.close()
            self._uploads.close()
            await runner.cleanup()

    async def _add_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        response.headers["X-Onedemo"] = "1"  # a proxy's own answer is without it
        response.headers["Server"] = "onedemo"  # else aiohttp tells its version, and Python's
        for name, value in SECURITY_HEADERS.items():
            response.headers.setdefault(name, value)
        response.headers.setdefault("Cache-Control", "no-store")
        if self._listening.encrypted(request):
            response.headers.update(_TLS_ALONE)

    # What is nobody else's

    async def _home(self, request: web.Request) -> web.StreamResponse:
        raise web.HTTPSeeOther(self._listening.page_path(request[RATER].id))

    async def _page_of(self, request: web.Request) -> web.StreamResponse:
        rater, tab = request[RATER], request.match_info.get("tab", "")
        if tab and tab not in self._page.tabs(rater.role):
            if tab not in self._page.tabs("researcher"):
                raise web.HTTPNotFound()
            raise web.HTTPSeeOther(self._listening.page_path(rater.id))  # sent by somebody who has more
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._proxy.socket(request)
        # Viser's client does what a query tells it, such as to show a recording from elsewhere. And the
        # addresses in the page hold only below the person.
        if request.query_string or not (tab or request.path.endswith("/")):
            raise web.HTTPSeeOther(self._listening.page_path(rater.id) + tab)
        self._proxy.expect(request)
        headers = {"Content-Security-Policy": self._policy}
        return web.Response(text=self._html, content_type="text/html", headers=headers)

    async def _health(self, request: web.Request) -> web.Response:
        try:
            phase = (await asyncio.wait_for(asyncio.shield(self._status()), _HEALTH_S)).phase
        except (sqlite3.Error, TimeoutError):
            phase = "busy"
        healthy = phase not in ("failed", "busy")
        told = {"ok": healthy, "version": version("onedemo"), "phase": phase}
        return web.json_response(told, status=200 if healthy else 503)

    def _status(self) -> asyncio.Future[Status]:
        """What the trainer does, which the database is asked for: once at a time, whoever asks."""
        if self._health_asked is None or self._health_asked.done():
            self._health_asked = asyncio.wrap_future(
                self._looking.submit(lambda: self._page.trainer.status()), loop=self._loop
            )
        return self._health_asked

    async def _press(self, request: web.Request) -> web.Response:
        rater = request[RATER].id
        if not self._presses[str(rater)].take():
            raise web.HTTPTooManyRequests(text="That was too fast for anybody. Please press once more.")
        with self._pressed.one(rater) as free:
            if not free:
                raise web.HTTPServiceUnavailable(text="Earlier answers are still being saved: please wait.")
            try:
                press = read_press(await read_body(request))
                counted = await self._in_turn(self._pressing, self._page.press, rater, press)
            except PageGone as told:
                raise web.HTTPGone(text=str(told)) from None
            except AnsweredElsewhere as told:
                raise web.HTTPConflict(text=str(told)) from None
            except ValueError as error:
                raise web.HTTPBadRequest(text=f"This could not be done: {error}.") from None
        return web.json_response({"counted": counted})

    async def _do(self, request: web.Request) -> web.Response:
        with self._acted.one(0) as free:
            if not free:
                raise web.HTTPServiceUnavailable(text="Other changes are still being made: please wait.")
            try:
                body = await read_json(request)
                address = page_address(self._listening, self._port, request.headers["Origin"])
                told = await self._in_turn(self._acting, self._actions.do, request[RATER], body, address)
            except (ValueError, UserError) as error:
                raise web.HTTPBadRequest(text=f"This could not be done: {error}.") from None
        return web.Response(status=204) if told is None else web.Response(text=told, content_type="text/html")

    async def _in_turn(self, threads: ThreadPoolExecutor, work: Callable[..., Any], *values: Any) -> Any:
        return await self._loop.run_in_executor(threads, partial(work, *values))


def _person(request: web.Request) -> int | None:
    return request[RATER].id if RATER in request else None
