"""The public HTTP port: one table of what there is and who may have it.

``onedemo.app.http.auth`` says who asks, ``onedemo.app.http.media`` and ``onedemo.app.http.exports`` hand
out files, ``onedemo.app.http.viser_proxy`` carries
the page's WebSocket to Viser. The page itself is Viser's single HTML file with our style sheet and
key handling added.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import sqlite3
import threading
from importlib.metadata import version
from typing import Protocol

from aiohttp import web

from onedemo.app.annotation.presses import PageGone, Press, read_press
from onedemo.app.annotation.rating_session import AnsweredElsewhere
from onedemo.app.http import assets
from onedemo.app.http.auth import RATER, SECURITY_HEADERS, AccessControl, Route
from onedemo.app.http.bind import Listening
from onedemo.app.http.commands import Actions
from onedemo.app.http.exports import Downloads
from onedemo.app.http.media import Files, Filmed
from onedemo.app.http.uploads import Uploads
from onedemo.app.http.viser_proxy import Proxy
from onedemo.app.services.demo_images import Pictures
from onedemo.errors import UserError
from onedemo.types import Status

log = logging.getLogger("onedemo.page")


class Trained(Filmed, Protocol):
    """What the front needs to know of a trainer."""

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
    """The public port, in a thread with an event loop of its own.

    Args:
        page: The Viser page behind the door; its trainer is the run that is served.
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
        self._downloads = Downloads(store, SECURITY_HEADERS)
        self._uploads = Uploads(store.path.parent)
        self._access = AccessControl(store, listening, lambda: self._port)
        self._proxy = Proxy(page, store)
        self._html = assets.page_html()
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The port it listens on."""
        return self._port

    def routes(self) -> tuple[Route, ...]:
        """All there is, each with the least role that it asks for."""
        files, downloads = self._files, self._downloads
        return (
            Route("GET", "/login", "stranger", self._access.log_in),
            Route("POST", "/login", "stranger", self._access.press_button),
            Route("GET", "/healthz", "stranger", self._health),
            *(Route("GET", path, "stranger", files.login_static) for path in sorted(assets.PUBLIC)),
            Route("GET", "/", "annotator", self._home),
            Route("GET", r"/r/{rater:\d{1,9}}", "annotator", self._page_of),
            Route("GET", r"/r/{rater:\d{1,9}}/session", "annotator", self._session),
            Route("POST", r"/r/{rater:\d{1,9}}/press", "annotator", self._press),
            Route("POST", r"/r/{rater:\d{1,9}}/do", "researcher", self._do),
            Route("GET", "/static/{name}", "annotator", files.static),
            Route("GET", r"/clips/{clip:\d{1,15}}.jpg", "annotator", files.clip),
            Route("GET", r"/pairs/{pair:\d{1,15}}.jpg", "annotator", files.pair),
            Route("GET", r"/demo/frames/{index:\d{1,6}}.jpg", "annotator", files.demo_frame),
            Route("GET", r"/demo/examples/{name:[a-z]{1,20}}.jpg", "annotator", files.demo_example),
            Route("GET", r"/rollouts/{iteration:\d{1,9}}.{suffix:jpg|webm}", "researcher", files.rollout),
            Route("GET", "/export.csv", "researcher", downloads.csv, "downloaded ratings"),
            Route("GET", "/comparisons.csv", "researcher", downloads.comparisons, "downloaded comparisons"),
            Route("GET", "/skips.csv", "researcher", downloads.skips, "downloaded skips"),
            Route("GET", "/segments.parquet", "researcher", downloads.parquet, "downloaded segments"),
            Route("GET", "/card.md", "researcher", downloads.card, "downloaded the data card"),
            Route("GET", "/preview", "researcher", downloads.preview),
            Route("GET", r"/r/{rater:\d{1,9}}/ratings", "researcher", downloads.given),
            Route("POST", "/demos", "researcher", self._uploads.add, "uploaded a demo"),
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
            raise _explain(failure[0], self._host, self._port) from None
        shown = "127.0.0.1" if self._host in ("", "0.0.0.0", "::") else self._host
        scheme = "http" if self._tls is None else "https"
        return f"{scheme}://{f'[{shown}]' if ':' in shown else shown}:{self._port}"

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
            # What is still being answered would ask for a thread after there are none.
            for task in (left := asyncio.all_tasks(self._loop)):
                task.cancel()
            self._loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
            self._loop.close()
            ready.set()

    async def _serve(self, ready: threading.Event) -> None:
        application = self._access.application(self.routes())
        runner = web.AppRunner(application, access_log=None, shutdown_timeout=2)
        await runner.setup()
        await self._proxy.open()
        try:
            site = web.TCPSite(runner, self._host, self._port, ssl_context=self._tls)
            await site.start()
            self._port = runner.addresses[0][1]
            ready.set()
            await self._stop.wait()
        finally:
            await self._proxy.close()
            await runner.cleanup()

    # What is nobody else's

    async def _home(self, request: web.Request) -> web.StreamResponse:
        raise web.HTTPSeeOther(f"/r/{request[RATER].id}")

    async def _page_of(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._proxy.socket(request)
        return web.Response(text=self._html, content_type="text/html")

    async def _session(self, request: web.Request) -> web.Response:
        """What an open page asks while its live connection is down; whoever has no session gets 401."""
        return web.Response(status=204)

    async def _health(self, request: web.Request) -> web.Response:
        status = self._page.trainer.status()
        healthy = status.phase != "failed"
        return web.json_response({"ok": healthy, "version": version("onedemo"), "phase": status.phase})

    async def _press(self, request: web.Request) -> web.Response:
        body = await request.read()
        try:
            counted = await asyncio.to_thread(self._page.press, request[RATER].id, read_press(body))
        except PageGone as told:
            raise web.HTTPGone(text=str(told)) from None
        except AnsweredElsewhere as told:
            raise web.HTTPConflict(text=str(told)) from None
        except ValueError as error:
            raise web.HTTPBadRequest(text=f"This could not be done: {error}.") from None
        except sqlite3.Error as error:
            log.exception("a press could not be saved")
            text = f"This could not be saved ({error}). Nothing is lost: please try again."
            raise web.HTTPServiceUnavailable(text=text) from None
        return web.json_response({"counted": counted})

    async def _do(self, request: web.Request) -> web.Response:
        try:
            await asyncio.to_thread(self._actions.do, request[RATER], await request.json())
        except (ValueError, UserError) as error:
            raise web.HTTPBadRequest(text=f"This could not be done: {error}.") from None
        except sqlite3.Error as error:
            raise web.HTTPServiceUnavailable(text=f"This could not be saved ({error}).") from None
        return web.Response(status=204)


def _explain(error: BaseException, host: str, port: int) -> UserError:
    if isinstance(error, OSError) and error.errno in (98, 48, 10048):
        return UserError(f"port {port} on {host} is in use; choose another with --port")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return UserError(f"port {port} on {host} cannot be opened ({reason}); choose another with --port")
