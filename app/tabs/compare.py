"""The Compare tab: two clips of the robot beside the video, and which of them is nearer.

The questions of the paper's second baseline, learning from preferences. Keys and flow are those of the
Rate tab; answers have a table of their own.
"""

from __future__ import annotations

from typing import Any

from onedemo.app.annotation import presses
from onedemo.app.annotation.comparison_session import ComparisonSession
from onedemo.app.annotation.phases import waiting_for_pairs
from onedemo.app.annotation.scale import PAIR_REASONS
from onedemo.app.tabs.context import TabContext
from onedemo.app.tabs.pressing import Pressing
from onedemo.app.tabs.strings import COMPARE_KEYS, keys_dialog
from onedemo.app.templates import render
from onedemo.types import Status


class Compare(Pressing):
    """The Compare tab of one session."""

    title = "Compare"
    takes = (presses.Compare, presses.ExplainPair)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context.client)
        self._context = context
        self._comparing = ComparisonSession(
            context.store, context.run, context.rater, context.pair_assignment, context.client.client_id,
            guard_seconds=context.guard_seconds,
        )  # fmt: skip
        self._status = context.training.status()
        gui = context.client.gui
        self._notice, self._top = gui.add_html(""), gui.add_html("")
        self._stage = gui.add_html("")
        self._answers, self._tools = gui.add_html(""), gui.add_html("")
        gui.add_html(keys_dialog(COMPARE_KEYS))

    def show(self) -> None:
        """Draws the tab; presses count from now on."""
        with self._lock:
            self._shown = True
            self.refresh(self._context.training.status())

    def hide(self) -> None:
        """Presses do not count any more."""
        with self._lock:
            self._shown = False

    def refresh(self, status: Status) -> None:
        """Asks for pairs while somebody looks."""
        with self._lock:
            if self._shown:
                self._status = status
                self._context.training.want_pairs()
                self._comparing.refill()
                self._draw()

    def close(self) -> None:
        """Frees the pairs for others."""
        self._comparing.close()

    def _carry_out(self, press: Any) -> bool:
        match press:
            case presses.ExplainPair():
                return self._comparing.explain(press.pair, press.reason.strip())
            case presses.Compare(answer="undo"):
                return self._comparing.undo(press.pair)
            case _:
                return self._comparing.answer(press.pair, press.answer)

    def _draw(self) -> None:
        context, comparing = self._context, self._comparing
        pair, undoable = comparing.current, comparing.undoable
        shown = pair is not None
        undo = {"data-undo-pair": undoable} if undoable else None
        with self._client.atomic():
            self._put(
                self._top, render("compare.html:top", count=context.store.comparisons.count(context.run))
            )
            if shown:
                stage = render(
                    "compare.html:pair", number=pair, source=self._address(pair),
                    ahead=self._address(comparing.upcoming), fps=context.demo.fps,
                )  # fmt: skip
            else:
                told = waiting_for_pairs(self._status, researcher=context.rater.role == "researcher")
                stage = render("parts.html:waiting", told=told)
            self._put(self._stage, stage)
            notice = render(
                "compare.html:notice", skipped=comparing.skipped, explained=comparing.explained,
                taken_back=comparing.taken_back, reasons=PAIR_REASONS,
            )  # fmt: skip
            self._put(self._notice, notice)
            self._put(self._answers, render("compare.html:answers") if shown else "")
            self._put(self._tools, render("player.html:tools", kind="compare" if shown else "", undo=undo))

    def _address(self, pair: int | None) -> str | None:
        return f"pairs/{pair}.jpg?v={self._context.version}" if pair is not None else None
