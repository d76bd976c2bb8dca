"""The Viser page: one session per browser, everything in it private to that browser.

Viser has no login of its own. It listens on the loopback only, on a port of its choosing, and a
connection gets a page only if it carries the secret that the front adds; without it, it is closed.
Nothing is ever put under ``server.gui`` or ``server.scene``: that would go to every socket.
"""

from __future__ import annotations

import hmac
import logging
import secrets
import threading
import warnings
from collections.abc import Callable
from typing import Any

import rich
import viser
from viser import _messages

from onedemo.app.annotation.assignment import Again, Ask, Assignment
from onedemo.app.annotation.rating_session import Desk, Mark
from onedemo.app.http.viser_proxy import RATER_HEADER, SCHEME_HEADER, SECRET_HEADER, SESSION_HEADER
from onedemo.app.services.demo_images import Pictures
from onedemo.app.services.live_rollout import Live
from onedemo.app.services.run_manager import Study
from onedemo.app.ui import data_tab, guide_tab, rate_tab, runs_tab, watch_tab
from onedemo.app.ui.compare_tab import Compare
from onedemo.app.ui.session import Session, TabMaker
from onedemo.types import Rater

log = logging.getLogger("onedemo.page")

TICK_SECONDS = 0.5
"""How often counters, waiting states and curves are looked at."""

_MESSAGES_LET_IN: tuple[type, ...] = (
    _messages.ViewerCameraMessage,
    _messages.GuiUpdateMessage,
    _messages.CommandTriggerMessage,
)
"""What a browser may say: where it looks from, a slider moved, a key pressed. Nothing else."""


class Page:
    """The page of one run, behind the front.

    Args:
        trainer: The run that is shown.
        pictures: Of its demo; made from the demo's video if not given.
        again: How many clips are asked again; the usual shares if not given.
        study: All runs; None if there is this one alone.
        compare: Whether annotators are asked pairs, too.
    """

    def __init__(
        self, trainer: Any, *, pictures: Pictures | None = None, again: Again | None = None,
        study: Study | None = None, compare: bool = False,
    ) -> None:  # fmt: skip
        self.study, self.compare = study, compare
        self.secret = secrets.token_urlsafe(32)
        self._again = again or Again()
        self._attach(trainer, pictures)
        self._raters: dict[int, Rater] = {}
        self._sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        rich.get_console().quiet = True  # Viser prints boxes through it, and addresses nobody should open.
        # A browser may leave while something is on its way to it; Viser warns of that each time.
        warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)
        self._server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        self.port: int = self._server.get_port()
        lock_down(self._server)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)
        self._ticker = threading.Thread(target=self._tick, name="onedemo-ticker", daemon=True)
        self._ticker.start()

    def serve(self, trainer: Any) -> None:
        """Shows another run from now on: every browser gets a new page."""
        self.live.close()
        self._attach(trainer, None)
        for client in list(self._server.get_clients()):
            hang_up(self._server, client)  # browsers come back by themselves

    def _attach(self, trainer: Any, pictures: Pictures | None) -> None:
        self.trainer = trainer
        self.pictures = pictures or Pictures(trainer.demo)
        self.assignment = Assignment(again=self._again)
        self.pair_assignment = Assignment()
        self.live = Live(trainer.acting, trainer.demo.seconds)
        self.desks: dict[int, Desk] = {}
        """Where people rate, by client."""
        self._done: dict[str, list[Ask]] = {}

    def close(self) -> None:
        """Ends all sessions and the server behind them."""
        self._closing.set()
        self._ticker.join(timeout=5)
        with self._lock:
            sessions, self._sessions = list(self._sessions.values()), {}
        for session in sessions:
            session.close()
        self.live.close()
        self._server.stop()

    def note(self, rater_id: int, clip: int, *, mark: Mark | None = None, reason: str | None = None) -> bool:
        """What a browser says of a clip besides its rating.

        Args:
            rater_id: Who says it.
            clip: Of which clip.
            mark: Where it goes wrong; None takes that back, unless there is a reason.
            reason: Why it was skipped.

        Returns:
            False if no page of the rater has that clip before it.

        Raises:
            ValueError: As ``Desk.set_mark`` and ``Desk.explain``.
            sqlite3.Error: If it could not be committed.
        """
        for desk in [desk for desk in list(self.desks.values()) if desk.rater.id == rater_id]:
            if desk.explain(clip, reason) if reason is not None else desk.set_mark(clip, mark):
                return True
        return False

    # One session per browser

    def _connect(self, client: viser.ClientHandle) -> None:
        headers = request_headers(self._server, client.client_id)
        if not hmac.compare_digest(headers.get(SECRET_HEADER, "").encode(), self.secret.encode()):
            hang_up(self._server, client.client_id)
            return
        rater = self._rater(int(headers[RATER_HEADER]))
        if rater is None:
            hang_up(self._server, client.client_id)
            return
        try:
            session = Session(
                self, client, rater, dark=headers.get(SCHEME_HEADER) == "dark",
                done=self._done.setdefault(headers[SESSION_HEADER], []),
                makers=tabs_of(rater.role, compare=self.compare),
            )  # fmt: skip
        except Exception:
            log.exception("the page of %s could not be built", rater.name)
            hang_up(self._server, client.client_id)
            return
        with self._lock:
            self._sessions[client.client_id] = session
        if client.client_id not in self._server.get_clients():
            self._disconnect(client)  # It left while its page was being built.

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _rater(self, rater_id: int) -> Rater | None:
        if rater_id not in self._raters:
            self._raters = {rater.id: rater for rater in self.trainer.store.accounts.raters()}
        return self._raters.get(rater_id)

    def _tick(self) -> None:
        while not self._closing.wait(TICK_SECONDS):
            with self._lock:
                sessions = list(self._sessions.values())
            if not sessions:
                continue
            status = self.trainer.status()
            for session in sessions:
                try:
                    session.refresh(status)
                except Exception:
                    log.exception("a page could not be refreshed")


def tabs_of(role: str, *, compare: bool = False) -> list[TabMaker]:
    """The tabs a role gets, in order; the first one is shown first."""
    if role == "researcher":
        return [watch_tab.Watch, runs_tab.Runs, rate_tab.Rate, Compare, data_tab.Data, guide_tab.Guide]
    return [rate_tab.Rate, *([Compare] if compare else []), guide_tab.Guide]


# Viser's private names, all of them; tests/system/test_viser_private.py holds them.


def lock_down(server: viser.ViserServer) -> None:
    """Leaves a client nothing to say to the server as a whole.

    Viser would open a public tunnel for anyone who asks, and take uploads into memory.
    """
    server._websock_server._incoming_handlers.clear()
    connect_callbacks = server._websock_server._client_connect_cb

    def restrict(connection: Any) -> None:
        handlers = connection._incoming_handlers
        for kind in [kind for kind in handlers if kind not in _MESSAGES_LET_IN]:
            del handlers[kind]
        if _messages.GuiUpdateMessage in handlers:
            handlers[_messages.GuiUpdateMessage] = [
                _values_only(handler) for handler in handlers[_messages.GuiUpdateMessage]
            ]

    connect_callbacks.append(restrict)


def request_headers(server: viser.ViserServer, client_id: int) -> Any:
    """The HTTP headers a client's WebSocket was opened with; empty if it has gone."""
    connection = server._websock_server._live_connections.get(client_id)
    request = connection.request if connection is not None else None
    return request.headers if request is not None else {}


def hang_up(server: viser.ViserServer, client_id: int) -> None:
    """Closes a client's connection."""
    import asyncio

    connection = server._websock_server._live_connections.get(client_id)
    loop = server._websock_server._background_event_loop
    if connection is not None and loop is not None:
        asyncio.run_coroutine_threadsafe(connection.close(1008, "not through the front"), loop)


def _values_only(handler: Callable) -> Callable:
    # An update may name any property of a handle; a browser has reason to send only values.
    async def checked(client_id: Any, message: Any) -> None:
        if set(message.updates) == {"value"}:
            await handler(client_id, message)

    return checked
