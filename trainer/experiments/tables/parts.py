"""What a table is made of: a plan of jobs, and parts that say what is reported of their outcomes.

A part is a block of a report as it stands, or makes blocks of the outcomes, which are grouped by label.
Results are those of ``onedemo.experiments.jobs``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from onedemo.experiments.report.blocks import (
    Bars,
    Block,
    Cell,
    Chart,
    Document,
    Heading,
    Line,
    Reference,
    Table,
    Text,
)
from onedemo.experiments.runner import Job, Outcome, by_label
from onedemo.experiments.statistics import band, spread

Result: TypeAlias = Mapping[str, Any]
Groups: TypeAlias = Mapping[str, Sequence[Outcome]]
"""Outcomes of all seeds under each label."""
Pick: TypeAlias = Callable[[Result], float | None]
"""Takes a figure from a result; None if it has no such figure."""
Show: TypeAlias = Callable[[Pick, Sequence[Outcome], Groups], str]
"""A figure of one group as text; the other groups are there to be compared with."""
Select: TypeAlias = Callable[[Groups], Groups]
Part: TypeAlias = Block | Callable[[Groups], Iterable[Block]]

OVER_SEEDS = "Mean of 16 episodes; mean ± deviation over seeds"
_OF = 5
"""Seeds that goals are stated for."""
_PAIRS = ("#2f5dc4", "#d97a1d")
"""Colours where a label has two lines: the first of ``drawing.COLOURS``, whose module needs matplotlib."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Experiment:
    """A table of the paper or ours; it runs nothing itself."""

    title: str
    """Of its report."""
    seeds: int
    """How many of the reporting seeds it takes when none are given; quick forms take at most two."""
    plan: Callable[..., list[Job]]
    """``plan(seeds, quick=...)``: the jobs, most wanted first. Quick: under 5 minutes on two cores, with two
    seeds."""
    parts: Sequence[Part]
    """Of its report. It need not say what was typed, on which machine, and which runs are missing:
    ``report.account`` does."""
    data: Callable[[Groups], Mapping[str, Any]] = lambda groups: {}
    """More figures for JSON than the goals."""
    skipped: Callable[[], str] = lambda: "no seed was asked for"
    """Why there is nothing to run, where the plan is empty."""

    def report(self, outcomes: Sequence[Outcome], *, quick: bool) -> Document:
        """Of one outcome for each job of the plan, in order. Any of them may have no result."""
        if not outcomes:
            why = self.skipped()
            return Document(title=self.title, blocks=[Text(f"**Skipped**: {why}.")], data={"skipped": why})
        groups = by_label(outcomes)
        blocks = list(_made(self.parts, groups))
        verdicts = [block for block in blocks if isinstance(block, Table) and "verdict" in block.heads]
        goals = [dict(zip(table.heads, row, strict=True)) for table in verdicts for row in table.rows]
        data = {"goals": goals} if verdicts else {}
        return Document(title=self.title, blocks=blocks, data={**data, **self.data(groups)})


def _made(parts: Sequence[Part], groups: Groups) -> Iterable[Block]:
    for part in parts:
        if callable(part):
            yield from part(groups)
        else:
            yield part


@dataclass(frozen=True, slots=True)
class Worded:
    """A paragraph that names facts of the jobs, such as ``{steps:,}``."""

    text: str
    facts: Callable[[Groups], Mapping[str, Any]]

    def __call__(self, groups: Groups) -> Iterable[Block]:
        """The paragraph."""
        yield Text(self.text.format_map(self.facts(groups)))


def settings(groups: Groups) -> Mapping[str, Any]:
    """Of the first job."""
    return next(iter(groups.values()))[0].job.settings


def _all(groups: Groups) -> Groups:
    return groups


@dataclass(frozen=True, slots=True)
class Section:
    """Parts under a heading, if it has one, of some of the groups; nothing where there are none of these."""

    heading: str
    parts: Sequence[Part]
    of: Select = _all

    def __call__(self, groups: Groups) -> Iterable[Block]:
        """Heading and parts."""
        if chosen := self.of(groups):
            yield from [Heading(self.heading)] * bool(self.heading)
            yield from _made(self.parts, chosen)


def only(*labels: str) -> Select:
    """Groups of these labels, in this order."""
    return lambda groups: {label: groups[label] for label in labels if label in groups}


# Figures


def figure(name: str, part: str = "mean") -> Pick:
    """A figure of the final policy: ``mean``, ``best`` or ``worst`` of 16 episodes."""

    def pick(result: Result) -> float | None:
        values = result["figures"].get(name)
        return None if values is None else values[part]

    return pick


def minutes(result: Result) -> float:
    """Wall time of a job without its evaluation, on one core."""
    seconds = result["seconds"]
    return (seconds.get("preparation", 0.0) + seconds["training"]) / 60


_OF_EPISODES = {
    "net turns": "net_turns", "clean turns": "clean_turns", "landed": "landings", "turned": "turned",
    "farthest turn": "farthest_turn", "backflip reward": "backflip_reward",
    "with raw actions": "backflip_reward_raw_actions", "return until the fall": "hop_return",
    "reward of 8 s": "hop_reward", "upright, s": "upright_seconds", "predicted": "predicted_similarity",
    "similarity, aligned": "aligned_similarity", "similarity, real time": "true_similarity",
    "state error": "state_error",
}  # fmt: skip
_OF_TRAINING: dict[str, Pick] = {
    "ratings": lambda result: result["ratings"],
    "control steps": lambda result: result["env_steps"],
    "minutes": minutes,
    "demo's own states": lambda result: result.get("demo_rated"),
    "shuffled": lambda result: result.get("demo_shuffled"),
}


def columns(*heads: str, part: str = "mean") -> dict[str, Pick]:
    """Figures of trainings by the heads that tables give them."""
    return {
        head: figure(_OF_EPISODES[head], part) if head in _OF_EPISODES else _OF_TRAINING[head]
        for head in heads
    }


def mean(pick: Pick, group: Sequence[Outcome], groups: Groups) -> str:
    """Mean and deviation over seeds; a dash where there are runs, but without this figure."""
    over_seeds, run = spread(group, pick), any(outcome.result for outcome in group)
    return "–" if run and over_seeds.missing == len(group) else str(over_seeds)


def each(pick: Pick, group: Sequence[Outcome], groups: Groups) -> str:
    """Of each seed."""
    return spread(group, pick).each


@dataclass(frozen=True, slots=True)
class Figures:
    """A row for each label, a column for each figure."""

    columns: Mapping[str, Pick | tuple[Pick, Show]]
    title: str = ""
    """``{seeds}`` in it stands for the seeds, in the order of ``each``."""
    show: Show = mean
    """How figures are shown where the column does not say it."""
    head: str = ""
    """Of the labels."""
    without: str = ""
    """A label that has no row."""
    last: Callable[[Groups], Sequence[Cell]] | None = None
    """One more row."""
    notes: Callable[[Groups], Sequence[str]] = lambda groups: ()

    def __call__(self, groups: Groups) -> Iterable[Block]:
        """The table."""
        shown = [each if isinstance(each, tuple) else (each, self.show) for each in self.columns.values()]
        rows = [
            (label, *(show(pick, group, groups) for pick, show in shown))
            for label, group in groups.items()
            if label != self.without
        ]
        seeds = ", ".join(str(outcome.job.seed) for outcome in next(iter(groups.values())))
        yield Table(
            title=self.title.format(seeds=seeds), heads=(self.head, *self.columns),
            rows=[*rows, *([self.last(groups)] if self.last else [])], notes=self.notes(groups),
        )  # fmt: skip


# Goals


@dataclass(frozen=True, kw_only=True, slots=True)
class Goal:
    """A figure that should be reached for so many of five seeds."""

    label: str
    """Whose."""
    what: str
    """In words, with the numbers."""
    met: Callable[[Result], bool]
    """By one seed."""
    shown: Pick
    """The figure of a seed that is shown beside it."""
    of_5: int
    """Seeds of five for which it should hold; of other numbers of seeds, the same share."""

    def row(self, outcomes: Sequence[Outcome]) -> tuple[Cell, ...]:
        """Of a table of goals: who, what, each seed, how many of them, the verdict."""
        done = [outcome.result for outcome in outcomes if outcome.result is not None]
        count, seeds = sum(self.met(result) for result in done), len(outcomes)
        needed = math.ceil(seeds * self.of_5 / _OF)
        # Seeds that are missing may still decide it: nothing is claimed before.
        missed = "missed" if count + seeds - len(done) < needed else "open"
        return (
            self.label, self.what, spread(outcomes, self.shown).each, f"{count} of {seeds}",
            f"{needed} of {seeds}", "**met**" if count >= needed else missed,
        )  # fmt: skip


def reach(label: str, what: str, *, of_5: int, **least: float) -> Goal:
    """A goal for means of 16 episodes by the names of figures; the first is shown."""
    picks = {figure(name): value for name, value in least.items()}
    return Goal(
        label=label, what=what, shown=next(iter(picks)), of_5=of_5,
        met=lambda result: all((pick(result) or 0) >= value for pick, value in picks.items()),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Goals:
    """Each with its verdict; those of labels that were not planned are left out."""

    goals: Sequence[Goal]

    def __call__(self, groups: Groups) -> Iterable[Block]:
        """The table."""
        heads = ("method", "reach", "each seed", "seeds that do", "asked for", "verdict")
        yield Table(heads=heads, rows=[g.row(groups[g.label]) for g in self.goals if g.label in groups])


# Charts


@dataclass(frozen=True, slots=True)
class Curves:
    """A figure of the results' ``curve`` against the control steps of practice, a line for each label."""

    figure: str
    name: str
    title: str
    y_label: str
    of: Select = _all

    def __call__(self, groups: Groups) -> Iterable[Block]:
        """The chart; none if there is nothing to draw."""
        lines = []
        for label, group in self.of(groups).items():
            found = [o.result["curve"] for o in group if o.result and self.figure in o.result["curve"]]
            if found:
                over_seeds = band([(curve["env_steps"], curve[self.figure]) for curve in found])
                lines.append(over_seeds.line(label))
        if lines:
            yield Chart(
                name=self.name, title=self.title, x_label="control steps of practice", y_label=self.y_label,
                lines=lines, note="Line: mean over seeds; band: least to most of them; thin: each.",
            )  # fmt: skip


def error_chart(groups: Groups) -> Iterable[Block]:
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
    if lines:
        yield Chart(
            name="state_error", title="Error of the states against the demo's", x_label="time, s",
            y_label="mean squared error, variances of the demo", lines=lines,
            note="Mean over seeds and their range. A robot that kept still in the demo's mean state would "
            "have 1; the torso's angle counts as in a picture. Nothing is aligned: who is late is wrong.",
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class BarChart:
    """A bar for each label, a dot for each seed."""

    pick: Pick
    name: str
    title: str
    x_label: str
    note: str
    strong: Sequence[str] = field(default_factory=list)
    reference: Callable[[Groups], Reference] | None = None

    def __call__(self, groups: Groups) -> Iterable[Block]:
        """The chart; none if there is nothing to draw."""
        spreads = [spread(group, self.pick) for group in groups.values()]
        if not np.isfinite([s.mean for s in spreads]).any():
            return
        reference = self.reference(groups) if self.reference else None
        yield Bars(
            name=self.name, title=self.title, x_label=self.x_label, labels=list(groups),
            values=[s.mean if np.isfinite(s.mean) else None for s in spreads],
            each=[[value for value in s.values if value is not None] for s in spreads],
            reference=reference if reference and np.isfinite(reference.y) else None,
            strong=self.strong, note=self.note,
        )  # fmt: skip
