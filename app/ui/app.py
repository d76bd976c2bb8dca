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
from typing import Any

import rich
import viser

from onedemo.app.annotation.assignment import REPEAT_AFTER, Again, Assignment
from onedemo.app.annotation.presses import PageGone, Press, Rate, Skip
from onedemo.app.annotation.rating_session import GUARD_SECONDS
from onedemo.app.annotation.tutorial import Lesson
from onedemo.app.http.viser_proxy import RATER_HEADER, SCHEME_HEADER, SECRET_HEADER, TAB_HEADER
from onedemo.app.services.demo_images import Pictures, version_of
from onedemo.app.services.live_rollout import Live
from onedemo.app.services.run_manager import Study
from onedemo.app.tabs import data, guide, rate, runs, start, watch
from onedemo.app.tabs.compare import Compare
from onedemo.app.tabs.context import TabContext
from onedemo.app.ui.session import Session, TabMaker
from onedemo.app.ui.viser_private import hang_up, lock_down, request_headers, start_server
from onedemo.types import Rater

log = logging.getLogger("onedemo.page")

TICK_SECONDS = 0.5
"""How often counters, waiting states and curves are looked at."""
_LOOKED_BACK = REPEAT_AFTER
"""Events of a rater among which is one that was given at a page that has gone."""


class Page:
    """The page of one run, behind the front.

    Args:
        trainer: The run that is shown.
        pictures: Of its demo; made from the demo's video if not given.
        again: How many clips are asked again; the usual shares if not given.
        study: All runs; None if there is this one alone.
        compare: Whether annotators are asked pairs, too.
        guard_seconds: A press that comes sooner after a clip was not made for it.
        live_fps: How often the live robot is drawn, in frames a second.
    """

    def __init__(
        self, trainer: Any, *, pictures: Pictures | None = None, again: Again | None = None,
        study: Study | None = None, compare: bool = False, guard_seconds: float = GUARD_SECONDS,
        live_fps: float = 30.0,
    ) -> None:  # fmt: skip
        self.study, self._compare, self._guard_seconds = study, compare, guard_seconds
        self._live_fps = live_fps
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
        self._server = start_server(self._is_front)
        self.port: int = self._server.get_port()
        lock_down(self._server)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)
        self._ticker = threading.Thread(target=self._tick, name="onedemo-ticker", daemon=True)
        self._ticker.start()

    def serve(self, trainer: Any) -> None:
        """Shows another run from now on: every browser gets a new page."""
        self._live.close()
        self._attach(trainer, None)
        for client in list(self._server.get_clients()):
            hang_up(self._server, client)  # browsers come back by themselves

    def _attach(self, trainer: Any, pictures: Pictures | None) -> None:
        self.trainer = trainer
        self.pictures = pictures or Pictures(trainer.demo, track=lambda: trainer.track, robot=trainer.robot)
        self._assignment = Assignment(again=self._again)
        self._pair_assignment = Assignment()
        self._live = Live(
            trainer.acting, trainer.demo.seconds, trainer.robot, frames_per_second=self._live_fps
        )

    def close(self) -> None:
        """Ends all sessions and the server behind them."""
        self._closing.set()
        self._ticker.join(timeout=5)
        with self._lock:
            sessions, self._sessions = list(self._sessions.values()), {}
        for session in sessions:
            session.close()
        self._live.close()
        self._server.stop()

    def press(self, rater_id: int, press: Press) -> bool:
        """Carries out what somebody pressed at one of their pages; whether it counts, now or already.

        Raises:
            PageGone: If no page of the rater goes by that name.
            AnsweredElsewhere, ValueError, sqlite3.Error: As ``Session.press``.
        """
        if session := self._open(rater_id, press.page):
            return session.press(press)
        kind = {Rate: "rate", Skip: "skip"}.get(type(press))
        if kind is not None:  # its answer may have been lost with the page
            said = self.trainer.store.ratings.answered(self.trainer.run, _LOOKED_BACK, rater_id=rater_id)
            if any((last.clip, last.kind) == (press.clip, kind) for last in said):
                return True
        raise PageGone(
            "Your last answer was not saved: the connection was lost, and something else is shown now."
        )

    def is_open(self, rater_id: int, token: str) -> bool:
        """Whether a rater has a page of that name open."""
        return self._open(rater_id, token) is not None

    def tabs(self, role: str) -> list[str]:
        """The tabs of a role as their addresses end, the first one first."""
        return [vars(maker)["title"].lower() for maker in tabs_of(role, compare=self._compare)]

    def _open(self, rater_id: int, token: str) -> Session | None:
        with self._lock:
            sessions = list(self._sessions.values())
        named = (s for s in sessions if s.token == token and s.rater.id == rater_id)
        return next(named, None)

    # One session per browser

    def _connect(self, client: viser.ClientHandle) -> None:
        headers = request_headers(self._server, client.client_id)
        if not self._is_front(headers):
            hang_up(self._server, client.client_id)
            return
        rater = self._rater(int(headers[RATER_HEADER]))
        if rater is None:
            hang_up(self._server, client.client_id)
            return
        try:
            context = self._context(client, rater, dark=headers.get(SCHEME_HEADER) == "dark")
            makers = tabs_of(rater.role, compare=self._compare)
            session = Session(context, makers, first=headers.get(TAB_HEADER, ""))
        except Exception:
            log.exception("the page of %s could not be built", rater.name)
            hang_up(self._server, client.client_id)
            return
        with self._lock:
            self._sessions[client.client_id] = session
        if client.client_id not in self._server.get_clients():
            self._disconnect(client)  # It left while its page was being built.

    def _is_front(self, headers: Any) -> bool:
        return hmac.compare_digest(headers.get(SECRET_HEADER, "").encode(), self.secret.encode())

    def _context(self, client: viser.ClientHandle, rater: Rater, *, dark: bool) -> TabContext:
        trainer, pictures = self.trainer, self.pictures
        lesson = Lesson(lambda: pictures.chosen().practice)
        if trainer.store.accounts.has_practised(rater.id):
            lesson.leave()
        return TabContext(
            client=client, rater=rater, dark=dark, lesson=lesson, store=trainer.store, run=trainer.run,
            version=version_of(trainer.store, trainer.run), data_dir=trainer.data_dir, demo=trainer.demo,
            dt=trainer.dt, training=trainer, pictures=pictures, live=self._live,
            assignment=self._assignment, pair_assignment=self._pair_assignment,
            guard_seconds=self._guard_seconds,
        )  # fmt: skip

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
            try:
                status = self.trainer.status()
            except Exception:  # the database may be busy
                log.exception("the training does not say how it is")
                continue
            for session in sessions:
                try:
                    session.refresh(status)
                except Exception:
                    log.exception("a page could not be refreshed")


def tabs_of(role: str, *, compare: bool = False) -> list[TabMaker]:
    """The tabs a role gets, in order."""
    if role == "researcher":
        return [start.Start, watch.Watch, runs.Runs, rate.Rate, Compare, data.Data, guide.Guide]
    return [rate.Rate, *([Compare] if compare else []), guide.Guide]
