"""The Compare tab: two clips of the robot beside the video, and which of them is nearer.

The questions of the paper's second baseline, learning from preferences. Keys and flow are those of the
Rate tab; answers have a table of their own.
"""

from __future__ import annotations

from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

from onedemo.app.annotation.comparison_session import PairDesk
from onedemo.app.services.demo_images import version_of
from onedemo.app.ui.clip_player import player_html
from onedemo.app.ui.rate_html import tools_html
from onedemo.app.ui.strings import COMPARE_KEYS, keys_dialog
from onedemo.app.ui.tab import Pressing
from onedemo.types import Status

if TYPE_CHECKING:
    from onedemo.app.ui.session import Session

_ANSWERS = (("1", "left", "The left one"), ("2", "equal", "Both alike"), ("3", "right", "The right one"))


class Compare(Pressing):
    """The Compare tab of one session."""

    title = "Compare"

    def __init__(self, session: Session) -> None:
        page, trainer = session.page, session.page.trainer
        self._trainer, self._store, self._run = trainer, trainer.store, trainer.run
        super().__init__(session.client)
        self._desk = PairDesk(
            trainer.store, trainer.run, session.rater, page.pair_assignment, session.client.client_id
        )
        self._version = version_of(trainer.store, trainer.run)
        self._message = ""
        self._keys: list[Any] = []
        self._keys_for: Any = None
        gui = session.client.gui
        self._top, self._stage = gui.add_html(""), gui.add_html("")
        self._answers, self._tools = gui.add_html(""), gui.add_html("")
        gui.add_html(keys_dialog(COMPARE_KEYS))

    def show(self) -> None:
        """Draws the tab and lets its keys act."""
        with self._lock:
            self._shown = True
            self.refresh(self._trainer.status())

    def hide(self) -> None:
        """Takes the keys away."""
        with self._lock:
            self._shown = False
            self._remove_keys()

    def refresh(self, status: Status) -> None:
        """Asks for pairs while somebody looks."""
        with self._lock:
            if self._shown:
                self._message = status.message
                self._trainer.want_pairs()
                self._attempt(self._desk.refill, keep_problem=True)
                self._draw()

    def close(self) -> None:
        """Frees the pairs for others."""
        self._desk.close()

    def _draw(self) -> None:
        pair, count = self._desk.current, self._store.comparisons.count(self._run)
        with self._client.atomic():
            self._put(self._top, top_html(count))
            self._put(
                self._stage,
                pair_html(
                    pair, self._desk.upcoming, self._version, self._trainer.demo.fps, self._problem
                )
                if pair is not None else waiting_html(self._message, self._problem),
            )  # fmt: skip
            self._put(self._answers, answers_html() if pair is not None else "")
            tools = tools_html(rating=pair is not None, can_undo=self._desk.can_undo, marking=False)
            self._put(self._tools, tools)
            self._set_keys(pair)

    def _set_keys(self, pair: int | None) -> None:
        wanted = (pair, self._desk.can_undo)
        if wanted == self._keys_for:
            return
        self._remove_keys()
        self._keys_for = wanted
        if pair is not None:
            for key, answer, label in _ANSWERS:
                self._key(label, key, partial(self._desk.answer, pair, answer))
            self._key("Skip this one", "S", partial(self._desk.answer, pair, "skip"))
        if self._desk.can_undo:
            for hotkey in ("U", "backspace"):
                self._key("Take the last one back", hotkey, self._desk.undo)

    def _key(self, label: str, hotkey: Any, action: Any) -> None:
        command = self._client.gui.add_command(label, hotkey=hotkey)
        command.on_trigger(lambda _: self._press(action))
        self._keys.append(command)

    def _remove_keys(self) -> None:
        for command in self._keys:
            command.remove()
        self._keys.clear()
        self._keys_for = None


def top_html(count: int) -> str:
    """The question, and how many were answered."""
    return (
        '<div class="od-rate-top"><h1>Which of the two is nearer to the video?</h1>'
        f'<div class="od-progress"><span><b>{count}</b> answered</span></div></div>'
    )


def pair_html(pair: int, upcoming: int | None, version: str, fps: float, problem: str) -> str:
    """The two robots with the video between them."""
    ahead = f' data-ahead="/pairs/{upcoming}.jpg?v={version}"' if upcoming is not None else ""
    player = player_html(
        f"/pairs/{pair}.jpg?v={version}", fps, "right", "left", "third",
        attributes=f'data-pair="{pair}"{ahead}',
        captions={"right": "Left", "left": "The video", "third": "Right"},
    )  # fmt: skip
    trouble = f'<p class="od-problem" role="alert">{escape(problem)}</p>' if problem else ""
    return f'<div class="od-clip od-pair">{player}</div>{trouble}'


def answers_html() -> str:
    """Left, alike, right; each presses its key."""
    buttons = "".join(
        f'<button type="button" data-key="{key}"><kbd>{key}</kbd><span>{label}</span></button>'
        for key, _, label in _ANSWERS
    )
    return f'<div class="od-answers od-three" role="group" aria-label="Which is nearer?">{buttons}</div>'


def waiting_html(message: str, problem: str) -> str:
    """There is no pair yet."""
    trouble = f'<p class="od-problem" role="alert">{escape(problem)}</p>' if problem else ""
    return (
        '<div class="od-waiting" role="status"><div class="od-mark od-busy" aria-hidden="true"></div>'
        f"<h2>Pairs are being made</h2><p>{escape(message)}</p>"
        f"<p class=od-quiet>They will appear here by themselves.</p>{trouble}</div>"
    )
