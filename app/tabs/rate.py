"""The Rate tab: a clip, a question, five answers; before the first one, an introduction and practice clips.

Keys and buttons are the browser's (``static/page.js``): a press comes as a request that names the clip that
was on screen, however slow the line is. Here it is carried out, and what comes next is drawn.
"""

from __future__ import annotations

from typing import Any

from onedemo.app.annotation import presses
from onedemo.app.annotation.phases import waiting
from onedemo.app.annotation.rating_session import RatingSession
from onedemo.app.annotation.scale import ANSWERS, REASONS
from onedemo.app.tabs.clip_player import example_address, video_address
from onedemo.app.tabs.context import TabContext
from onedemo.app.tabs.pressing import Pressing
from onedemo.app.tabs.strings import RATE_KEYS, keys_dialog
from onedemo.app.templates import render
from onedemo.storage.rating_counts import Counts
from onedemo.types import Status


class Rate(Pressing):
    """The Rate tab of one session."""

    title = "Rate"
    takes = (presses.Rate, presses.Skip, presses.Explain, presses.Undo, presses.Practise)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context.client)
        self._context, self._lesson = context, context.lesson
        self._status: Status = context.training.status()
        self._rating = RatingSession(
            context.store, context.run, context.rater, context.assignment, context.client.client_id,
            dt=context.dt, demo=context.demo, guard_seconds=context.guard_seconds, wanted=self._wanted,
        )  # fmt: skip
        gui = context.client.gui
        self._notice, self._top = gui.add_html(""), gui.add_html("")
        self._stage = gui.add_html("")
        self._answering = gui.add_folder(None, visible=False)
        with self._answering:
            # Never redrawn: who presses a button with the keyboard keeps the focus on it.
            gui.add_html(str(render("rate.html:answers", labels=ANSWERS)))
            gui.add_html(str(render("rate.html:slider", labels=ANSWERS)))
        self._tools = gui.add_html("")
        self._ahead = gui.add_html("")
        gui.add_html(keys_dialog(RATE_KEYS))

    def show(self) -> None:
        """Draws the tab; presses count from now on."""
        with self._lock:
            self._shown = True
            self._look()

    def hide(self) -> None:
        """Presses do not count any more."""
        with self._lock:
            self._shown = False

    def refresh(self, status: Status) -> None:
        """Looks for clips while there are none, and counts."""
        with self._lock:
            self._status = status
            if self._shown:
                self._look()

    def close(self) -> None:
        """Frees the clips for others."""
        self._rating.close()

    def _wanted(self) -> int:
        used = self._context.store.ratings.count_for_training(self._context.run)
        return self._status.asked_ratings - used

    def _look(self) -> None:
        if self._lesson.over:
            self._rating.refill()
        self._draw()

    def _carry_out(self, press: Any) -> bool:
        match press:
            case presses.Practise():
                counted = self._lesson.take(press.exercise, press.do)
                if counted and self._lesson.over:
                    self._context.store.accounts.set_practised(self._context.rater.id)
                    self._rating.refill()
                return counted
            case _ if not self._lesson.over:
                return False
            case presses.Rate():
                return self._rating.rate(press.clip, press.value, press.mark)
            case presses.Skip():
                return self._rating.skip(press.clip)
            case presses.Explain():
                return self._rating.explain(press.clip, press.reason.strip())
            case _:
                return self._rating.undo(press.clip)

    # Drawing

    def _draw(self) -> None:
        with self._client.atomic():
            if self._lesson.over:
                self._draw_clip()
            else:
                self._draw_lesson()

    def _draw_clip(self) -> None:
        context, rating, status = self._context, self._rating, self._status
        clip, target = rating.current, status.target_ratings
        each = context.store.ratings.counts(context.run)
        everybody, own = sum(each.values(), Counts()), each.get(context.rater.id, Counts()).given
        shown = clip is not None
        top = render("rate.html:top", own=own, counts=everybody, target=target, shown=shown)
        self._put(self._top, top)
        if shown:
            source, fps = self._address(clip), context.demo.fps
            stage = render("rate.html:clip", number=clip, source=source, fps=fps, mark=rating.mark)
        else:
            told = waiting(
                status, used=everybody.used, taken=rating.taken,
                researcher=context.rater.role == "researcher",
            )  # fmt: skip
            stage = render("parts.html:waiting", told=told)
        self._put(self._stage, stage)
        undoable = rating.undoable
        undo = {"data-undo-clip": undoable} if undoable else None
        self._put(self._tools, render("player.html:tools", kind="rate" if shown else "", undo=undo))
        notice = render(
            "rate.html:notice", skipped=rating.skipped, explained=rating.explained,
            taken_back=rating.taken_back, labels=ANSWERS, reasons=REASONS,
        )  # fmt: skip
        self._put(self._notice, notice)
        # Apart, so that the clip on screen is not drawn anew for it.
        self._put(self._ahead, render("player.html:ahead", source=self._address(rating.upcoming)))
        self._show_answers(shown)

    def _draw_lesson(self) -> None:
        lesson, demo = self._lesson, self._context.demo
        if lesson.introducing:
            clips = len(lesson.exercises)
            stage = render("rate.html:introduction", video=video_address(demo.sha256), clips=clips)
            self._put(self._stage, stage)
            for handle in (self._top, self._tools, self._notice):
                self._put(handle, "")
            self._show_answers(False)
            return
        top = render("rate.html:lesson_top", number=lesson.index, of=len(lesson.exercises))
        source = example_address(lesson.exercise.name, demo.sha256)
        self._put(self._top, top)
        self._put(self._stage, render("rate.html:lesson", lesson=lesson, source=source, fps=demo.fps))
        self._put(self._tools, render("player.html:tools", kind="practice", undo=None))
        self._put(self._notice, "")
        self._show_answers(lesson.answer is None)

    def _address(self, clip: int | None) -> str | None:
        return f"clips/{clip}.jpg?v={self._context.version}" if clip is not None else None

    def _show_answers(self, visible: bool) -> None:
        if self._answering.visible != visible:
            self._answering.visible = visible
