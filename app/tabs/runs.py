"""The Runs tab: all runs of the data directory, side by side; another one is opened or made here."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from onedemo.app.http.uploads import LARGEST
from onedemo.app.tabs import charts
from onedemo.app.tabs.context import TabContext
from onedemo.app.templates import render
from onedemo.config import METHODS
from onedemo.demos.library import list_demos
from onedemo.types import HALTED, Status

_NEWEST = 6
"""Runs that are compared before anybody says which."""
_COMPARED = 12
"""Runs whose curves are drawn at most: more lines cannot be told apart."""


class Runs:
    """The Runs tab of one session."""

    title = "Runs"

    def __init__(self, context: TabContext) -> None:
        self._store, self._run, self._training = context.store, context.run, context.training
        self._lock = threading.RLock()
        self._shown = False
        self._rows: dict[str, list[dict]] = {}
        self._told = ""
        gui = context.client.gui
        self._table = gui.add_html("")
        self._wanted = gui.add_text("Compare", "", hint="Names or parts of names, separated by commas")
        self._wanted.on_update(lambda _: self.refresh(self._training.status()))
        self._told_which = gui.add_html("")
        self._client, self._drawn = context.client, []
        self._curves = [
            charts.Comparison(gui, key, title, dark=context.dark)
            for key, title in (
                ("predicted", "Predicted rating (1 to 5)"),
                ("true_reward", "True reward of an episode (points; never trained on)"),
            )
        ]
        demos = [demo.name for demo in list_demos(context.data_dir / "demos")]
        # The forms are drawn once, so that nothing that is being filled in is lost.
        runs = [entry["id"] for entry in self._store.runs.all()]
        gui.add_html(str(render("runs.html:new_run", demos=demos, methods=list(METHODS), runs=runs)))
        gui.add_html(str(render("runs.html:new_demo", megabytes=LARGEST >> 20)))

    def show(self) -> None:
        """Lists the runs."""
        with self._lock:
            self._shown = True
            self.refresh(self._training.status())

    def hide(self) -> None:
        """Stops following."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """Follows the run at hand."""
        with self._lock:
            if not self._shown:
                return
            runs = self._store.runs.all()
            drawn, more = chosen_runs([run["id"] for run in runs], self._wanted.value, self._run)
            grown = drawn != self._drawn
            for run in drawn:
                rows = self._rows.setdefault(run, [])
                if run == self._run or not rows:
                    new = self._store.runs.iterations(run, after=rows[-1]["number"] if rows else 0)
                    rows += new
                    grown |= bool(new)
            told = str(runs_html(runs, self._figures(runs), self._run, status, drawn))
            with self._client.atomic():
                if told != self._told:
                    self._told = self._table.content = told
                if grown or not self._told_which.content:
                    self._drawn = drawn
                    self._told_which.content = str(render("runs.html:which", drawn=len(drawn), more=more))
                    for curve in self._curves:
                        curve.draw({run: self._rows[run] for run in drawn})

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _figures(self, runs: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        figures = {}
        for run in runs:
            name = run["id"]
            rows = self._rows.get(name)
            last = rows[-1] if rows else (self._store.runs.last_iteration(name) or {})
            figures[name] = {"ratings": sum(self._store.ratings.by_class(name)), **last}
        return figures


def chosen_runs(runs: Sequence[str], wanted: str, current: str) -> tuple[list[str], int]:
    """Which runs are compared.

    Args:
        runs: All, oldest first.
        wanted: Names or parts of names, separated by commas; a whole name means that run alone. Nothing: the
            newest, and the one at hand.
        current: The one at hand.

    Returns:
        Their names, the newest first, at most so many as can be told apart; and how many more were wanted.
    """
    newest = list(reversed(runs))
    parts = [part.strip().lower() for part in wanted.split(",") if part.strip()]
    if not parts:
        others = [run for run in newest if run != current]
        kept = {current, *others[: _NEWEST - 1]}
        return [run for run in newest if run in kept], 0
    whole = {run.lower() for run in runs}
    found = [
        run
        for run in newest
        if any(part == run.lower() or (part not in whole and part in run.lower()) for part in parts)
    ]
    return found[:_COMPARED], max(0, len(found) - _COMPARED)


def runs_html(
    runs: Sequence[Mapping[str, Any]], figures: Mapping[str, Mapping[str, Any]], current: str,
    status: Status, drawn: Sequence[str],
) -> Markup:  # fmt: skip
    """The table of runs, the newest first.

    Args:
        runs: As ``Store.runs.all``.
        figures: Of each: ``ratings``, and the newest iteration's.
        current: The one that is served.
        status: Of that one.
        drawn: Those whose curves are drawn.
    """
    return render(
        "runs.html:table",
        rows=[(run, figures[run["id"]], method_of(run["config"])) for run in reversed(runs)],
        current=current, status=status, resumable=status.phase in HALTED, drawn=drawn,
    )  # fmt: skip


def method_of(config: str) -> str:
    """The method in a run's settings; legacy runs that name none are the paper's."""
    for line in config.splitlines():
        if line.startswith("method = "):
            return line.partition('"')[2].rstrip('"')
    return "paper"
