"""The Data tab: how good the ratings are, by whom, and how to get them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from urllib.parse import quote

from markupsafe import Markup

from onedemo.app.annotation.agreement import Quality, quality, quality_by_rater, rating_rows
from onedemo.app.annotation.scale import ANSWERS
from onedemo.app.tabs.context import TabContext
from onedemo.app.templates import render
from onedemo.storage.rating_counts import Counts
from onedemo.types import Rater, Status

log = logging.getLogger("onedemo.page")

_EVERY_S = 3.0
"""Figures are not worked out more often."""


class Data:
    """The Data tab of one session."""

    title = "Data"

    def __init__(self, context: TabContext) -> None:
        self._store, self._run, self._training = context.store, context.run, context.training
        self._shown = False
        self._counted = -1
        self._counted_at = 0.0
        self._busy = threading.Lock()
        gui = context.client.gui
        self._html = gui.add_html("")
        # Drawn once, so that nothing that is being filled in is lost.
        clips = f"clips/CLIP.jpg?v={context.version}"
        path = str(self._store.path.absolute())
        gui.add_html(str(export_html(self._run, path, clips, context.demo.fps)))

    def show(self) -> None:
        """Counts."""
        self._shown = True
        self.refresh(self._training.status())

    def hide(self) -> None:
        """Stops counting."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """Counts again if somebody looks, beside the thread that serves all pages."""
        event = self._store.ratings.last_event()
        old = time.monotonic() - self._counted_at > _EVERY_S
        if not self._shown or event == self._counted or not (old or self._counted < 0):
            return
        if self._busy.acquire(blocking=False):
            threading.Thread(target=self._count, args=(event, status.method), daemon=True).start()

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _count(self, event: int, method: str) -> None:
        try:
            store, run = self._store, self._run
            rows = rating_rows(store, run)
            people = {rater.name: rater for rater in store.accounts.raters()}
            names = {rater.id: name for name, rater in people.items()}
            given = {names[who]: c for who, c in store.ratings.counts(run).items() if c != Counts()}
            figures = data_html(
                run, method, store.ratings.tallies(run), quality(rows), quality_by_rater(rows, raters=given),
                given, people, store.ratings.left_out(run),
            )  # fmt: skip
            self._html.content = str(figures)
            self._counted, self._counted_at = event, time.monotonic()
        except Exception:
            log.exception("the figures of the Data tab could not be worked out")
        finally:
            self._busy.release()


def data_html(
    run: str, method: str, counts: Mapping[tuple[str, str], list[int]], whole: Quality,
    each: Mapping[str, Quality], given: Mapping[str, Counts], people: Mapping[str, Rater], left_out: set[int],
) -> Markup:  # fmt: skip
    """The tab's figures.

    Args:
        run: Whose ratings.
        method: How it learns.
        counts: As ``Store.ratings.tallies``.
        whole: Quality of all ratings.
        each: Of each rater's, by name.
        given: How many ratings each has given, by name.
        people: Raters by name.
        left_out: Raters whose ratings nothing learns from.
    """
    return render(
        "data.html:ratings", run=run, method=method, tallies=counts, whole=whole, each=each, given=given,
        people=people, left_out=left_out, answers=ANSWERS, counts=sum(given.values(), Counts()),
    )  # fmt: skip


def export_html(run: str, path: str, clips: str, fps: float) -> Markup:
    """A run's ratings one by one; filter, preview and download; where they are.

    Args:
        run: Whose.
        path: Of the file that they are in.
        clips: Where pictures of clips are, CLIP in the place of the number.
        fps: Of the clips.
    """
    return render(
        "data.html:export", run=run, query=f"?run={quote(run)}", path=path, clips=clips, fps=fps,
        answers=ANSWERS,
    )  # fmt: skip
