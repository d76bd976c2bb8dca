"""``onedemo bench ratings``: how much of the move is learned from how many ratings."""

from __future__ import annotations

from collections.abc import Sequence

from onedemo.experiments.jobs.method import method_job
from onedemo.experiments.report.blocks import Block, Chart, Document, Line, Reference, Text
from onedemo.experiments.runner import Job, Outcome, by_label
from onedemo.experiments.statistics import spread
from onedemo.experiments.tables import backflip
from onedemo.experiments.tables.summary import Groups, each_seed, figure, minutes, table

TITLE = "onedemo: how many ratings"
SEEDS = 5
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
        method_job(_label(method, ratings), seed, method=method, ratings=ratings, steps=steps)
        for seed in seeds
        for method in METHODS
        for ratings in numbers
        if not (quick and method == "paper" and ratings < max(numbers))
    ]


def report(outcomes: Sequence[Outcome], *, quick: bool) -> Document:
    """The chart with the paper's point in it, and figures."""
    groups = by_label(outcomes)
    steps = max(outcome.job.settings["steps"] for outcome in outcomes)
    paper = f"the paper, {_PAPER_RATINGS} ratings of a person"
    blocks: list[Block] = [
        Text(
            f"The tumbling demo of 8 s, a rater without error, {steps:,} control steps of practice; four of "
            "seven ratings before practice, the others during its first half."
        ),
        *_chart(
            groups, "net_turns", name="ratings", title="Net backward turns by number of ratings",
            y_label="turns, mean of 16 episodes",
            reference=Reference(label=paper, y=_PAPER_TURNS, x=_PAPER_RATINGS),
        ),
        Text(_fewest(groups)),
        table(_FIGURES, groups, "Mean of 16 episodes; mean ± deviation over seeds"),
        each_seed(_EACH, groups, "Each seed, mean of 16 episodes"),
        *_chart(
            groups, "backflip_reward", name="ratings_reward", title="Backflip reward by number of ratings",
            y_label="reward, mean of 16 episodes",
            reference=Reference(label=paper, y=_PAPER_REWARD, x=_PAPER_RATINGS),
        ),
    ]  # fmt: skip
    return Document(title=TITLE, blocks=blocks)


def _label(method: str, ratings: int) -> str:
    return f"{method}, {ratings} ratings"


def _chart(
    groups: Groups, name_of_figure: str, *, name: str, title: str, y_label: str, reference: Reference
) -> list[Chart]:
    lines = []
    for method in METHODS:
        points = []
        for group in groups.values():
            settings = group[0].job.settings
            over_seeds = spread(group, figure(name_of_figure))
            if settings["method"] == method and over_seeds.missing < len(over_seeds.values):
                points.append((settings["ratings"], over_seeds))
        points.sort(key=lambda point: point[0])
        if points:
            lines.append(
                Line(
                    label=method, x=[ratings for ratings, _ in points], y=[s.mean for _, s in points],
                    low=[s.low for _, s in points], high=[s.high for _, s in points], marks=True,
                )
            )  # fmt: skip
    chart = Chart(
        name=name, title=title, x_label="ratings", y_label=y_label, lines=lines, references=[reference],
        log_x=True, note="Dots: mean over seeds; band: least to most of them.",
    )  # fmt: skip
    return [chart] if lines else []


def _fewest(groups: Groups) -> str:
    """The fewest ratings with which every seed turns as often as the paper's agent."""
    parts = []
    for method in METHODS:
        enough = [
            group[0].job.settings["ratings"]
            for group in groups.values()
            if group[0].job.settings["method"] == method
            and spread(group, figure("net_turns")).count(_PAPER_TURNS) == len(group)
        ]
        parts.append(f"{method}: **{min(enough)}**" if enough else f"{method}: with none of these numbers")
    return f"Fewest ratings with which every seed makes at least {_PAPER_TURNS:g} turns: {'; '.join(parts)}."


_FIGURES = {
    "net turns": figure("net_turns"),
    "best": figure("net_turns", "best"),
    "clean turns": figure("clean_turns"),
    "backflip reward": figure("backflip_reward"),
    "similarity, aligned": figure("aligned_similarity"),
    "demo's own states": lambda result: result["demo_rated"],
    "shuffled": lambda result: result["demo_shuffled"],
    "minutes": minutes,
}
_EACH = {"net turns": figure("net_turns"), "backflip reward": figure("backflip_reward")}
