"""The Data tab: how good the ratings are, by whom, and how to get them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from urllib.parse import quote

from markupsafe import Markup

from onedemo.app.annotation.agreement import (
    FAIR,
    GOOD,
    Difference,
    Disputed,
    Quality,
    Trend,
    differences,
    disputed,
    quality,
    quality_by_rater,
    rating_rows,
    trends,
    verdict,
)
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
                run, method, store.ratings.tallies(run), quality(rows),
                quality_by_rater(rows, raters=given, intervals=False), given, people,
                store.ratings.left_out(run), trends(rows), disputed(rows), differences(rows),
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
    over_time: Mapping[str, Trend], clips: Sequence[Disputed], pairs: Sequence[Difference],
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
        over_time: Trends, as ``agreement.trends``.
        clips: On which people disagree.
        pairs: Who disagree.
    """
    return render(
        "data.html:ratings", run=run, method=method, tallies=counts, whole=whole, each=each, given=given,
        people=people, left_out=left_out, answers=ANSWERS, verdict=verdict, good=GOOD, fair=FAIR,
        trends=[(name, _curves(trend)) for name, trend in over_time.items()], disputed=clips, pairs=pairs,
        counts=sum(given.values(), Counts()),
    )  # fmt: skip


def _curves(trend: Trend) -> list[tuple[str, list[float | None], list[list[tuple[float, float]]]]]:
    """Of each figure of a trend: how it is written, its values, and its line in parts."""
    slowest = max(10.0, *(value for value in trend.seconds if value is not None))
    return [
        (form, values, line(values, low, high))
        for form, values, low, high in (
            (".1f", trend.means, 1.0, 5.0), (".1f", trend.seconds, 0.0, slowest),
            (".2f", trend.alphas, 0.0, 1.0),
        )
    ]  # fmt: skip


def line(values: Sequence[float | None], low: float, high: float) -> list[list[tuple[float, float]]]:
    """A small chart's line: points in percent from the top left, in parts where values are missing.

    Args:
        values: In order, at equal distances.
        low: Value at the bottom; what is less is drawn there.
        high: Value at the top.
    """
    parts: list[list[tuple[float, float]]] = [[]]
    for index, value in enumerate(values):
        if value is None:
            parts.append([])
            continue
        share = min(1.0, max(0.0, (value - low) / (high - low)))
        parts[-1].append((round(100 * index / max(1, len(values) - 1), 1), round(100 * (1 - share), 1)))
    return [part for part in parts if part]


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
