"""The Rate tab: a clip, a question, five answers; before the first real one, two clips to practise with.

The keys of a clip are commands made for that clip and removed with it, so a press names the clip
that was on screen, however slow the line is. The buttons press the same keys (``static/page.js``).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from onedemo.app.annotation.rating_session import Desk
from onedemo.app.annotation.scale import ANSWERS
from onedemo.app.services.demo_images import version_of
from onedemo.app.ui import rate_html as html
from onedemo.app.ui.strings import RATE_KEYS, keys_dialog
from onedemo.app.ui.tab import Pressing
from onedemo.types import Status

if TYPE_CHECKING:
    from onedemo.app.ui.session import Session

_MIDDLE = 3


class Rate(Pressing):
    """The Rate tab of one session."""

    title = "Rate"

    def __init__(self, session: Session) -> None:
        page, trainer = session.page, session.page.trainer
        self._session = session
        self._store, self._run, self._fps = trainer.store, trainer.run, trainer.demo.fps
        self._pictures, self._version = page.pictures, version_of(trainer.store, trainer.run)
        super().__init__(session.client)
        self.desk = Desk(
            trainer.store, trainer.run, session.rater, page.assignment, session.client.client_id,
            dt=trainer.dt, fps=trainer.demo.fps, frames=trainer.demo.frames, done=session.done,
        )  # fmt: skip
        page.desks[session.client.client_id] = self.desk
        self._status: Status = trainer.status()
        self._clip_keys: list[Any] = []
        self._undo_keys: list[Any] = []
        self._keys_for: Any = None
        self._drawn: tuple[int, str] | None = None
        self._mark: tuple[int, int] | None = None
        gui = session.client.gui
        self._notice, self._top = gui.add_html(""), gui.add_html("")
        self._stage = gui.add_html("")
        self._answering = gui.add_folder(None, visible=False)
        with self._answering:
            # Never redrawn: who presses a button with the keyboard keeps the focus on it.
            gui.add_html(html.answers_html())
            marks = tuple((value, str(value)) for value in range(1, 6))
            self._slider = gui.add_slider("Rating", 1, 5, 1, _MIDDLE, marks=marks)
            gui.add_html(html.SUBMIT)
        self._tools = gui.add_html("")
        self._ahead = gui.add_html("")
        gui.add_html(keys_dialog(RATE_KEYS))

    def show(self) -> None:
        """Draws the tab and lets its keys act."""
        with self._lock:
            self._shown, self._drawn = True, None
            if self._lesson is None:
                self._attempt(self.desk.refill)
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
            if self._shown and self._lesson is None:
                self._attempt(self.desk.refill, keep_problem=True)
                self._draw()

    def close(self) -> None:
        """Frees the clips for others."""
        self._session.page.desks.pop(self._client.client_id, None)
        self.desk.close()

    @property
    def _lesson(self) -> Any:
        lesson = self._session.lesson
        return None if lesson is None or lesson.over else lesson

    # Presses

    def _learn(self, step: Any) -> bool:
        """One press in the lesson; after the last, the first real clip."""
        moved = step()
        if self._lesson is None:
            self._store.accounts.set_practised(self._session.rater.id)
            self.desk.refill()
        return moved

    # Drawing

    def _draw(self) -> None:
        count = self._store.ratings.count_for_training(self._run)  # as many as the trainer counts
        with self._client.atomic():  # Clip and keys change together.
            if self._lesson is not None:
                self._draw_lesson()
            else:
                self._draw_clip(self.desk.current, count)

    def _draw_clip(self, clip: int | None, count: int) -> None:
        asking = clip is not None
        self._put(self._top, html.top_html(count, self._status.target_ratings, asking=asking))
        if clip is not None:
            # A mark is drawn by the browser; it is given back whenever the clip is drawn anew.
            if self._drawn != (clip, self._problem):
                self._drawn, self._mark = (clip, self._problem), self.desk.mark
            self._put(self._stage, html.clip_html(clip, self._version, self._fps, self._problem, self._mark))
        else:
            self._put(self._stage, html.waiting_html(self._status, count, self._problem))
        self._put(self._tools, html.tools_html(rating=asking, can_undo=self.desk.can_undo))
        self._put(self._notice, html.notice_html(self.desk))
        self._put(self._ahead, html.ahead_html(self.desk.upcoming, self._version))
        self._show_answers(asking)
        self._set_keys(clip)

    def _draw_lesson(self) -> None:
        lesson = self._lesson
        self._put(self._top, html.lesson_top_html(lesson.index + 1, len(lesson.exercises)))
        self._put(self._stage, html.lesson_html(lesson, self._pictures.demo, self._problem))
        self._put(self._tools, html.tools_html(rating=True, can_undo=False, practising=True))
        self._put(self._notice, "")
        self._show_answers(lesson.answer is None)
        key = ("lesson", lesson.index, lesson.answer)
        if key != self._keys_for:
            self._remove_keys()
            self._keys_for = key
            if lesson.answer is None:
                for value, answer in enumerate(ANSWERS, start=1):
                    step = partial(self._learn, partial(lesson.give, value))
                    self._clip_keys.append(self._key(f"{value}: {answer}", str(value), step))
            else:
                self._clip_keys.append(self._key("Go on", "G", partial(self._learn, lesson.go_on)))
            self._clip_keys.append(self._key("Skip the practice", "S", partial(self._learn, lesson.leave)))

    def _show_answers(self, visible: bool) -> None:
        if self._answering.visible != visible:
            self._answering.visible = visible

    def _set_keys(self, clip: int | None) -> None:
        if clip != self._keys_for:
            _remove(self._clip_keys)
            if clip is not None:
                if self._slider.value != _MIDDLE:
                    self._slider.value = _MIDDLE
                for value, answer in enumerate(ANSWERS, start=1):
                    action = partial(self.desk.rate, clip, value)
                    self._clip_keys.append(self._key(f"{value}: {answer}", str(value), action))
                self._clip_keys.append(self._key("Skip this one", "S", partial(self.desk.skip, clip)))
            self._keys_for = clip
        if self.desk.can_undo != bool(self._undo_keys):
            _remove(self._undo_keys)
            if self.desk.can_undo:
                for hotkey in ("U", "backspace"):
                    self._undo_keys.append(self._key("Take the last one back", hotkey, self.desk.undo))

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
