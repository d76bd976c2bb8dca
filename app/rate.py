"""The Rate tab: a clip, a question, five answers.

The keys of a clip are commands made for that clip and removed with it, so a press names the clip
that was on screen, however slow the line is. The buttons press the same keys (``static/page.js``).
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

from app.desk import Desk
from app.words import ANSWERS
from trainer.records import Status

if TYPE_CHECKING:
    from app.session import Session

log = logging.getLogger("onedemo.page")

_MIDDLE = 3


class Rate:
    """The Rate tab of one session."""

    title = "Rate"

    def __init__(self, session: Session) -> None:
        trainer = session.page.trainer
        self._store, self._run = trainer.store, trainer.run
        self._client = session.client
        self._lock = threading.RLock()
        self._desk = Desk(
            trainer.store, trainer.run, session.rater, session.page.assignment, session.client.client_id
        )
        self._status: Status = trainer.status()
        self._problem = ""
        self._shown = False
        self._clip_keys: list[Any] = []
        self._undo_keys: list[Any] = []
        self._keys_for: int | None = None
        gui = session.client.gui
        self._top = gui.add_html("")
        self._stage = gui.add_html("")
        self._answering = gui.add_folder(None, visible=False)
        with self._answering:
            # Never redrawn: who presses a button with the keyboard keeps the focus on it.
            gui.add_html(answers_html())
            marks = tuple((value, str(value)) for value in range(1, 6))
            self._slider = gui.add_slider("Rating", 1, 5, 1, _MIDDLE, marks=marks)
            gui.add_html(_SUBMIT)
        self._tools = gui.add_html("")
        self._content: dict[int, str] = {}

    def show(self) -> None:
        """Draws the tab and lets its keys act."""
        with self._lock:
            self._shown = True
            self._attempt(self._desk.refill)
            self._draw()

    def hide(self) -> None:
        """Takes the keys away."""
        with self._lock:
            self._shown = False
            self._remove_keys()

    def refresh(self, status: Status) -> None:
        """Looks for clips while there are none, and counts."""
        with self._lock:
            self._status = status
            if self._shown:
                self._attempt(self._desk.refill, keep_problem=True)
                self._draw()

    def close(self) -> None:
        """Frees the clips for others."""
        self._desk.close()

    # Presses

    def _press(self, action: Any) -> None:
        with self._lock:
            if not self._shown:
                return
            moved = self._attempt(action)
            if moved or self._problem:
                self._draw()
                self._client.flush()

    def _attempt(self, action: Any, *, keep_problem: bool = False) -> bool:
        try:
            moved = action()
        except (sqlite3.Error, ValueError) as error:
            log.exception("a rating could not be saved")
            self._problem = f"This could not be saved ({error}). Nothing is lost: please try again."
            return False
        if not keep_problem:
            self._problem = ""
        return moved

    # Drawing

    def _draw(self) -> None:
        count = sum(self._store.ratings_by_class(self._run))
        with self._client.atomic():  # Clip and keys change together.
            self._draw_all(self._desk.current, count)

    def _draw_all(self, clip: int | None, count: int) -> None:
        self._put(self._top, top_html(count, self._status.target_ratings, asking=clip is not None))
        if clip is not None:
            self._put(self._stage, clip_html(clip, self._desk.upcoming, self._problem))
        else:
            self._put(self._stage, waiting_html(self._status, count, self._problem))
        self._put(self._tools, tools_html(clip is not None, self._desk.can_undo))
        if self._answering.visible != (clip is not None):
            self._answering.visible = clip is not None
        self._set_keys(clip)

    def _put(self, handle: Any, content: str) -> None:
        # Setting the same HTML again would restart the animation.
        if self._content.get(id(handle)) != content:
            self._content[id(handle)] = content
            handle.content = content

    def _set_keys(self, clip: int | None) -> None:
        if clip != self._keys_for:
            _remove(self._clip_keys)
            if clip is not None:
                if self._slider.value != _MIDDLE:
                    self._slider.value = _MIDDLE
                for value, answer in enumerate(ANSWERS, start=1):
                    action = partial(self._desk.rate, clip, value)
                    self._clip_keys.append(self._key(f"{value}: {answer}", str(value), action))
                self._clip_keys.append(self._key("Skip this one", "S", partial(self._desk.skip, clip)))
            self._keys_for = clip
        if self._desk.can_undo != bool(self._undo_keys):
            _remove(self._undo_keys)
            if self._desk.can_undo:
                for hotkey in ("U", "backspace"):
                    self._undo_keys.append(self._key("Take the last one back", hotkey, self._desk.undo))

    def _key(self, label: str, hotkey: Any, action: Any) -> Any:
        command = self._client.gui.add_command(label, hotkey=hotkey)
        command.on_trigger(lambda _: self._press(action))
        return command

    def _remove_keys(self) -> None:
        _remove(self._clip_keys)
        _remove(self._undo_keys)
        self._keys_for = None


def _remove(commands: list[Any]) -> None:
    for command in commands:
        command.remove()
    commands.clear()


_SUBMIT = (
    '<div class="od-submit">'
    '<button type="button" class="od-button od-primary" data-submit>Submit</button></div>'
)


def top_html(count: int, target: int, *, asking: bool) -> str:
    """The question, if there is something to rate, and how far the ratings have come."""
    share = min(1.0, count / target) if target else 0.0
    question = "How alike are the two movements?" if asking else ""
    progress = f"<b>{count}</b> of {target}" if count < target else f"<b>{count}</b>, as many as asked for"
    return (
        f'<div class="od-rate-top"><h1>{question}</h1>'
        f'<div class="od-progress"><span>{progress}</span>'
        f'<i role="progressbar" aria-label="Ratings so far" aria-valuemin="0" aria-valuemax="{target}" '
        f'aria-valuenow="{count}"><i style="width:{100 * share:.1f}%"></i></i></div></div>'
    )


def clip_html(clip: int, upcoming: int | None, problem: str) -> str:
    """The clip, and the next one fetched ahead."""
    source = f"/clips/{clip}.webp"
    sides = "".join(
        f'<figure class="od-side od-{side}"><figcaption>{caption}</figcaption>'
        f'<div><img src="{source}" alt="{caption}" decoding="sync" draggable="false"></div></figure>'
        for side, caption in (("left", "From the video"), ("right", "The robot"))
    )
    ahead = f'<img class="od-ahead" src="/clips/{upcoming}.webp" alt="">' if upcoming is not None else ""
    trouble = f'<p class="od-problem" role="alert">{escape(problem)}</p>' if problem else ""
    return f'<div class="od-clip" data-clip="{clip}">{sides}{ahead}</div>{trouble}'


def answers_html() -> str:
    """The five answers; each presses its key."""
    answers = "".join(
        f'<button type="button" data-key="{value}"><kbd>{value}</kbd><span>{answer}</span></button>'
        for value, answer in enumerate(ANSWERS, start=1)
    )
    return f'<div class="od-answers" role="group" aria-label="Your rating">{answers}</div>'


def waiting_html(status: Status, count: int, problem: str) -> str:
    """Why there is no clip, and for how long."""
    trouble = f'<p class="od-problem" role="alert">{escape(problem)}</p>' if problem else ""
    if status.target_ratings and count >= status.target_ratings:
        body = (
            '<div class="od-mark od-done" aria-hidden="true"></div>'
            "<h2>Thank you. That is all we asked for.</h2>"
            "<p>The robot goes on practising with your ratings. You can close this page.</p>"
        )
    else:
        wait = status.next_clips_s
        when = f" New pairs in about {_seconds(wait)}." if wait is not None else ""
        body = (
            '<div class="od-mark od-busy" aria-hidden="true"></div><h2>Nothing to rate just now</h2>'
            f"<p>{escape(status.message)}{when}</p><p class=od-quiet>They will appear here by themselves.</p>"
        )
    return f'<div class="od-waiting" role="status">{body}{trouble}</div>'


def tools_html(rating: bool, can_undo: bool) -> str:
    """Undo, skip, replay."""
    replay = '<button type="button" class="od-button" data-replay>Replay <kbd>Space</kbd></button>'
    skip = '<button type="button" class="od-button" data-key="s">Skip <kbd>S</kbd></button>'
    undo = (
        f'<button type="button" class="od-button" data-key="u"{"" if can_undo else " disabled"}>'
        "Undo <kbd>U</kbd></button>"
    )
    return f'<div class="od-tools">{undo}{skip + replay if rating else ""}</div>'


def _seconds(value: float) -> str:
    return f"{max(1, round(value))} s" if value < 90 else f"{round(value / 60)} minutes"
