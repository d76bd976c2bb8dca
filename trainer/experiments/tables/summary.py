"""What tables of trainings have in common: figures out of results, goals, curves, moving pictures.

Results are those of ``onedemo.experiments.jobs.method`` and ``onedemo.experiments.jobs.controls``.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from onedemo.demos.library import find_demo
from onedemo.errors import UserError
from onedemo.experiments.report.blocks import Block, Cell, Chart, Line, Picture, Table, number
from onedemo.experiments.report.movie import movie
from onedemo.experiments.runner import Outcome
from onedemo.experiments.statistics import band, spread

Result = Mapping[str, Any]
Groups = Mapping[str, Sequence[Outcome]]
"""Outcomes of all seeds under each label."""

NOTE_BAND = "Line: mean over seeds; band: least to most of them; thin: each."

_PAIRS = ("#2f5dc4", "#d97a1d")
"""Colours where a label has two lines: the first of ``drawing.COLOURS``, whose module needs matplotlib."""
_OF = 5
"""Seeds that goals are stated for."""
_log = logging.getLogger(__name__)


def figure(name: str, part: str = "mean") -> Callable[[Result], float | None]:
    """Picks a figure of the final policy from a result: ``mean``, ``best`` or ``worst`` of 16 episodes."""

    def pick(result: Result) -> float | None:
        values = result["figures"].get(name)
        return None if values is None else values[part]

    return pick


def minutes(result: Result) -> float:
    """Wall time of a job without its evaluation, on one core."""
    seconds = result["seconds"]
    return (seconds.get("preparation", 0.0) + seconds["training"]) / 60


@dataclass(frozen=True, kw_only=True, slots=True)
class Goal:
    """A figure that should be reached for so many of five seeds."""

    label: str
    """Whose."""
    what: str
    """In words, with the numbers."""
    met: Callable[[Result], bool]
    """By one seed."""
    shown: Callable[[Result], float | None]
    """The figure of a seed that is shown beside it."""
    of_5: int
    """Seeds of five for which it should hold; of other numbers of seeds, the same share."""

    def row(self, outcomes: Sequence[Outcome]) -> tuple[Cell, ...]:
        """Of a table of goals: who, what, each seed, how many of them, the verdict."""
        each = spread(outcomes, self.shown).each
        done = [outcome.result for outcome in outcomes if outcome.result is not None]
        count, seeds = sum(self.met(result) for result in done), len(outcomes)
        needed = math.ceil(seeds * self.of_5 / _OF)
        # Seeds that are missing may still decide it: nothing is claimed before.
        if count >= needed:
            verdict = "**met**"
        elif count + seeds - len(done) >= needed:
            verdict = "open"
        else:
            verdict = "missed"
        return self.label, self.what, each, f"{count} of {seeds}", f"{needed} of {seeds}", verdict


def goals_table(goals: Sequence[Goal], groups: Groups) -> Table:
    """Goals of what was planned, each with its verdict."""
    heads = ("method", "reach", "each seed", "seeds that do", "asked for", "verdict")
    rows = [goal.row(groups[goal.label]) for goal in goals if goal.label in groups]
    return Table(heads=heads, rows=rows)


def table(columns: Mapping[str, Callable[[Result], float | None]], groups: Groups, title: str = "") -> Table:
    """A row for each label, a column for each figure: mean and deviation over seeds."""

    def cell(group: Sequence[Outcome], pick: Callable[[Result], float | None]) -> str:
        over_seeds, run = spread(group, pick), any(outcome.result for outcome in group)
        return "–" if run and over_seeds.missing == len(group) else str(over_seeds)  # a figure it has not

    rows = [(label, *(cell(group, pick) for pick in columns.values())) for label, group in groups.items()]
    return Table(heads=("", *columns), rows=rows, title=title)


def each_seed(
    columns: Mapping[str, Callable[[Result], float | None]], groups: Groups, title: str = ""
) -> Table:
    """The same with the figure of each seed."""
    rows = [
        (label, *(spread(group, pick).each for pick in columns.values())) for label, group in groups.items()
    ]
    return Table(heads=("", *columns), rows=rows, title=title)


def curves(
    groups: Groups, figure_name: str, *, name: str, title: str, y_label: str,
) -> list[Chart]:  # fmt: skip
    """A chart of a figure against the control steps of practice; none if there is nothing to draw.

    Args:
        groups: A line for each label that has results.
        figure_name: A key of the results' ``curve``.
        name: Of the chart's file.
        title: Of the chart.
        y_label: With its unit.
    """
    lines = []
    for label, group in groups.items():
        found = [o.result["curve"] for o in group if o.result and figure_name in o.result["curve"]]
        found = [(curve["env_steps"], curve[figure_name]) for curve in found]
        if found:
            lines.append(band(found).line(label))
    chart = Chart(
        name=name,
        title=title,
        x_label="control steps of practice",
        y_label=y_label,
        lines=lines,
        note=NOTE_BAND,
    )
    return [chart] if lines else []


def error_chart(groups: Groups) -> list[Chart]:
    """Error of the states over time, as in the paper's figure 3 (c): best episode, and mean of 16.

    Of at most two labels: more lines could not be told apart.
    """
    lines: list[Line] = []
    for (label, group), colour in zip(groups.items(), _PAIRS, strict=False):
        found = [outcome.result["errors"] for outcome in group if outcome.result and outcome.result["errors"]]
        for part in ("best", "mean") if found else ():
            over_seeds = band([(errors["seconds"], errors[part]) for errors in found])
            line = over_seeds.line(f"{label}, {part} of 16", dashed=part == "mean", colour=colour)
            lines.append(replace(line, each=()))  # too lively to be told apart
    chart = Chart(
        name="state_error", title="Error of the states against the demo's", x_label="time, s",
        y_label="mean squared error, variances of the demo", lines=lines,
        note="Mean over seeds and their range. A robot that kept still in the demo's mean state would have "
        "1; the torso's angle counts as in a picture. Nothing is aligned: who is late is wrong.",
    )  # fmt: skip
    return [chart] if lines else []


def median_outcome(outcomes: Sequence[Outcome], pick: Callable[[Result], float | None]) -> Outcome | None:
    """The one whose figure is the median of those that have one, the lower of two; None if none has."""
    done = [(value, o.job.seed, o) for o in outcomes if o.result and (value := pick(o.result)) is not None]
    return sorted(done, key=lambda entry: entry[:2])[(len(done) - 1) // 2][2] if done else None


def moving_pictures(groups: Groups, chosen: Mapping[str, str]) -> list[Block]:
    """The best episode of the median seed beside the demo.

    Args:
        groups: Outcomes by label.
        chosen: Label to name of the file; those without results are left out.
    """
    blocks: list[Block] = []
    for label, name in chosen.items():
        median = median_outcome(groups.get(label, ()), figure("net_turns"))
        if median is None or median.result is None:
            continue
        demo, shown = find_demo(median.job.settings["demo"], Path()), median.result["episode"]
        try:
            data = movie(demo, np.array(shown["qpos"]))
        except UserError as error:
            _log.warning("no moving picture of %s: %s", label, error)
            continue
        turns = median.result["figures"]["net_turns"]["each"][shown["which"]]
        text = (
            f"{demo.name} on the left, {label} on the right: "
            f"seed {median.job.seed}, {number(turns)} net turns"
        )
        blocks.append(
            Picture(name=name, data=data, alt=text, note=f"{text}; the median seed, its best episode.")
        )
    return blocks
