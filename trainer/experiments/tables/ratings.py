"""``onedemo bench ratings``: how much of the move is learned from how many ratings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from onedemo.experiments.jobs.method import method_job
from onedemo.experiments.report.blocks import Block, Chart, Line, Reference
from onedemo.experiments.runner import Job
from onedemo.experiments.statistics import Spread, spread
from onedemo.experiments.tables import backflip, parts
from onedemo.experiments.tables.parts import Groups, columns, figure

STEPS = backflip.STEPS
"""Control steps of practice: the runs with 100 and 350 ratings serve both tables."""
RATINGS = (25, 50, 100, 200, 350, 700)
QUICK_STEPS, QUICK_RATINGS = backflip.QUICK_STEPS, (25, backflip.QUICK_RATINGS)
METHODS = ("onedemo", "paper")

_PAPER_RATINGS, _PAPER_TURNS, _PAPER_REWARD = 350, 2.0, 3365.0
"""What the paper reports, with ratings of a person."""


def plan(seeds: tuple[int, ...], *, quick: bool) -> list[Job]:
    """Seed by seed; quick: the paper's method with the larger number alone."""
    steps, numbers = (QUICK_STEPS, QUICK_RATINGS) if quick else (STEPS, RATINGS)
    return [
        method_job(f"{method}, {ratings} ratings", seed, method=method, ratings=ratings, steps=steps)
        for seed in seeds
        for method in METHODS
        for ratings in numbers
        if not (quick and method == "paper" and ratings < max(numbers))
    ]


def _by_ratings(groups: Groups, method: str, name: str) -> dict[int, Spread]:
    """Number of ratings to a figure of the runs of a method, ascending."""
    found = {}
    for group in groups.values():
        given = group[0].job.settings
        if given["method"] == method:
            found[given["ratings"]] = spread(group, figure(name))
    return dict(sorted(found.items()))


@dataclass(frozen=True, slots=True)
class _Chart:
    """A figure against the number of ratings, a line for each method, and the paper's point."""

    figure: str
    name: str
    title: str
    y_label: str
    paper: float

    def __call__(self, groups: Groups) -> Iterable[Block]:
        lines = []
        for method in METHODS:
            found = _by_ratings(groups, method, self.figure)
            there = {n: over for n, over in found.items() if over.missing < len(over.values)}
            if there:
                y, low, high = ([getattr(s, k) for s in there.values()] for k in ("mean", "low", "high"))
                lines.append(Line(label=method, x=list(there), y=y, low=low, high=high, marks=True))
        label = f"the paper, {_PAPER_RATINGS} ratings of a person"
        if lines:
            yield Chart(
                name=self.name, title=f"{self.title} by number of ratings", x_label="ratings",
                y_label=f"{self.y_label}, mean of 16 episodes", lines=lines, log_x=True,
                references=[Reference(label=label, y=self.paper, x=_PAPER_RATINGS)],
                note="Dots: mean over seeds; band: least to most of them.",
            )  # fmt: skip


def _fewest(groups: Groups, method: str) -> str:
    """The fewest ratings with which every seed turns as often as the paper's agent."""
    found = _by_ratings(groups, method, "net_turns")
    enough = [n for n, turns in found.items() if turns.count(_PAPER_TURNS) == len(turns.values)]
    return f"**{min(enough)}**" if enough else "with none of these numbers"


_FIGURES = {
    **columns("net turns"),
    "best": figure("net_turns", "best"),
    **columns("clean turns", "backflip reward", "similarity, aligned"),
    **columns("demo's own states", "shuffled", "minutes"),
}

TABLE = parts.Experiment(
    title="onedemo: how many ratings", seeds=5, plan=plan,
    parts=[
        parts.Worded(
            "The tumbling demo of 8 s, a rater without error, {steps:,} control steps of practice; four of "
            "seven ratings before practice, the others during its first half.",
            parts.settings,
        ),
        _Chart("net_turns", "ratings", "Net backward turns", "turns", _PAPER_TURNS),
        parts.Worded(
            "Fewest ratings with which every seed makes at least {turns:g} turns: onedemo: {onedemo}; "
            "paper: {paper}.",
            lambda groups: {"turns": _PAPER_TURNS, **{name: _fewest(groups, name) for name in METHODS}},
        ),
        parts.Figures(_FIGURES, parts.OVER_SEEDS),
        parts.Figures(
            columns("net turns", "backflip reward"), "Each seed, mean of 16 episodes", parts.each
        ),
        _Chart("backflip_reward", "ratings_reward", "Backflip reward", "reward", _PAPER_REWARD),
    ],
)  # fmt: skip
