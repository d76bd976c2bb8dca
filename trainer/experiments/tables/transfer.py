"""``onedemo bench transfer``: what a predictor of another move is worth (the paper's Table 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from onedemo.demos.library import find_demo
from onedemo.errors import UserError
from onedemo.experiments.jobs.method import method_job
from onedemo.experiments.jobs.transfer import transfer_job
from onedemo.experiments.report.blocks import Block, Document, Heading, Picture, Table, Text, number
from onedemo.experiments.report.strip import strip
from onedemo.experiments.runner import Job, Outcome, by_label
from onedemo.experiments.statistics import spread, spread_of
from onedemo.experiments.tables.summary import (
    Groups,
    curves,
    each_seed,
    figure,
    median_outcome,
    minutes,
    moving_pictures,
    table,
)

TITLE = "onedemo: from one move to another"
SEEDS = 5
RATINGS, PRETRAIN = 55, 30
"""In all, and of these before practice: the paper's."""
SOURCE_RATINGS = 350
STEPS = 1_000_000
SOURCE_STEPS = 300_000
"""Of the first move's run: its policy is thrown away."""
BASELINE_STEPS = 3_000_000
QUICK_RATINGS, QUICK_PRETRAIN, QUICK_SOURCE_RATINGS = 20, 12, 40
QUICK_STEPS, QUICK_SOURCE_STEPS = 32_000, 16_000

_HOP, _FLIP = "hopper-hop", "hopper-backflip"
_TRPO = "TRPO, hand-coded reward"
_METHODS = ("onedemo", "paper")
_RATIO, _BEYOND = 1.5, 767.0


@dataclass(frozen=True, slots=True)
class Direction:
    """From one move to another."""

    title: str
    source: str
    target: str
    figure: str
    """What the target move is measured by."""
    figure_name: str

    def label(self, method: str, tuned: bool) -> str:
        """Of the jobs of one method."""
        return f"{self.title}: {method}, {'fine-tuned' if tuned else 'from scratch'}"

    @property
    def baseline(self) -> str:
        """Label of TRPO on the target's hand-coded reward."""
        return f"{self.title}: {_TRPO}"


THERE = Direction("backflip to hop", _FLIP, _HOP, "hop_return", "hopping return")
BACK = Direction("hop to backflip", _HOP, _FLIP, "backflip_reward", "backflip reward")

PAPER = {"TRPO": 1006.89, "fine-tuned": 767.16, "from scratch": 433.28}
"""Table 3 of Gandhi et al. 2019: hopping reward, one run each."""


def plan(seeds: tuple[int, ...], *, quick: bool) -> list[Job]:
    """Seed by seed; the paper's direction first."""
    directions = (THERE,) if quick else (THERE, BACK)
    methods = _METHODS[:1] if quick else _METHODS
    jobs = []
    for seed in seeds:
        for direction in directions:
            for method in methods:
                jobs += _pair(direction, method, seed, quick)
            if not quick and direction is THERE:
                settings = {"demo": direction.target, "steps": BASELINE_STEPS}
                jobs.append(Job(kind="handcoded", label=direction.baseline, settings=settings, seed=seed))
    return jobs


def _pair(direction: Direction, method: str, seed: int, quick: bool) -> list[Job]:
    ratings, pretrain = (QUICK_RATINGS, QUICK_PRETRAIN) if quick else (RATINGS, PRETRAIN)
    target = method_job(
        direction.label(method, tuned=False), seed, demo=direction.target, method=method, ratings=ratings,
        steps=QUICK_STEPS if quick else STEPS,
        changes={"ratings.pretrain": pretrain, "ratings.online": ratings - pretrain},
    )  # fmt: skip
    source = method_job(
        "", seed, demo=direction.source, method=method,
        ratings=QUICK_SOURCE_RATINGS if quick else SOURCE_RATINGS,
        steps=QUICK_SOURCE_STEPS if quick else SOURCE_STEPS,
    )  # fmt: skip
    return [target, transfer_job(direction.label(method, tuned=True), seed, source=source, target=target)]


def report(outcomes: Sequence[Outcome], *, quick: bool) -> Document:
    """The paper's figures beside ours, goals, curves, strips and moving pictures."""
    groups = by_label(outcomes)
    goals = _goals(groups)
    blocks: list[Block] = [
        Text(_INTRODUCTION),
        Heading("What should be reached"),
        goals,
        Heading("Hopping from a predictor of the backflip"),
        _papers_table(groups),
        *_direction(THERE, groups),
    ]
    if any(label.startswith(BACK.title) for label in groups):
        blocks += [Heading("A backflip from a predictor of the hop"), *_direction(BACK, groups)]
    pictures = {THERE.label("onedemo", tuned=True): "hop_transferred.webp"}
    blocks += [
        Text(_EXPLANATIONS),
        Heading("What it looks like"),
        *_strips(groups),
        *moving_pictures(groups, pictures),
    ]
    data = {
        "paper": PAPER,
        "goals": [dict(zip(goals.heads, row, strict=True)) for row in goals.rows],
        "ratios": {key: spread_of(values).values for key, values in _ratios(groups).items()},
    }
    return Document(title=TITLE, blocks=blocks, data=data)


def _direction(direction: Direction, groups: Groups) -> list[Block]:
    own = {label: group for label, group in groups.items() if label.startswith(direction.title)}
    short = {label.removeprefix(f"{direction.title}: "): group for label, group in own.items()}
    name = "hop" if direction is THERE else "backflip"
    return [
        table(_FIGURES[direction.figure], short, "Mean of 16 episodes; mean ± deviation over seeds"),
        each_seed(_EACH[direction.figure], short, "Each seed"),
        *curves(
            short, direction.figure, name=f"{name}_curve", y_label=direction.figure_name,
            title=f"{direction.figure_name}, {direction.title}",
        ),
    ]  # fmt: skip


def _papers_table(groups: Groups) -> Table:
    """The paper's Table 3, and the same of ours: the best episode, as the paper's is the maximum."""
    rows = []
    for ours, theirs in ((THERE.baseline, "TRPO"), *_labels(THERE)):
        best = spread(groups.get(ours, ()), figure("hop_return", "best"))
        whole = spread(groups.get(ours, ()), figure("hop_reward", "best"))
        ratings = 0 if theirs == "TRPO" else RATINGS
        if ours in groups:
            name = ours.removeprefix(f"{THERE.title}: ")
            rows.append((name, ratings, PAPER[theirs], str(best), str(whole)))
    heads = ("", "ratings", "paper", "return until the fall, best of 16", "reward of 8 s, best of 16")
    return Table(heads=heads, rows=rows, title="Table 3")


def _labels(direction: Direction) -> list[tuple[str, str]]:
    return [
        (direction.label(method, tuned), "fine-tuned" if tuned else "from scratch")
        for method in _METHODS
        for tuned in (True, False)
    ]


def _ratios(groups: Groups) -> dict[str, list[float | None]]:
    """Fine-tuned over scratch, seed by seed, of the figure of each direction and of the hop's reward."""
    ratios = {}
    for direction, name in ((THERE, "hop_return"), (THERE, "hop_reward"), (BACK, "backflip_reward")):
        for method in _METHODS:
            pair = [groups.get(direction.label(method, tuned)) for tuned in (True, False)]
            if pair[0] is None or pair[1] is None:
                continue
            part = "best" if direction is THERE else "mean"
            each = [_by_seed(group, name, part) for group in pair if group is not None]
            ratios[f"{direction.title}, {method}, {name}"] = [
                each[0][seed] / each[1][seed] if _both_there(each, seed) else None for seed in each[0]
            ]
    return ratios


def _by_seed(group: Sequence[Outcome], name: str, part: str) -> dict[int, Any]:
    pick = figure(name, part)
    return {o.job.seed: None if o.result is None else pick(o.result) for o in group}


def _both_there(each: Sequence[Mapping[int, Any]], seed: int) -> bool:
    tuned, scratch = each[0].get(seed), each[1].get(seed)
    return tuned is not None and scratch is not None and scratch > 0


def _goals(groups: Groups) -> Table:
    """The project's, set before any of these runs: over the means of the seeds."""
    rows = []
    for name, ratio in _ratios(groups).items():
        direction, method, _ = name.split(", ")
        way = THERE if direction == THERE.title else BACK
        figure_name, part = name.rsplit(", ", 1)[1], "best" if way is THERE else "mean"
        pair = [
            spread(groups[way.label(method, tuned)], figure(figure_name, part)) for tuned in (True, False)
        ]
        missing = any(each.missing for each in pair)
        of_means = pair[0].mean / pair[1].mean if pair[1].mean > 0 else np.nan
        verdict = "open" if missing else "**met**" if of_means >= _RATIO else "missed"
        rows.append(
            (name, f"{_RATIO:g} x scratch", str(pair[0]), str(pair[1]), number(of_means),
             spread_of(ratio).each, verdict)
        )  # fmt: skip
        if way is THERE:
            beyond = "open" if missing else "**met**" if pair[0].mean >= _BEYOND else "missed"
            rows.append((name, f"beyond: {_BEYOND:g}", str(pair[0]), str(pair[1]), "", pair[0].each, beyond))
    heads = (
        "direction, method, figure",
        "reach",
        "fine-tuned",
        "from scratch",
        "ratio",
        "each seed",
        "verdict",
    )
    return Table(
        heads=heads, rows=rows,
        notes=("Hop: best of 16 episodes, as the paper's is the maximum; backflip: mean of 16. Ratio: of the "
               "means over seeds; of each seed beside it.",),
    )  # fmt: skip


def _strips(groups: Groups) -> list[Block]:
    """The paper's figure: the first two seconds of the hop, demo above robot."""
    blocks: list[Block] = []
    for tuned, name in ((True, "hop_fine_tuned"), (False, "hop_scratch")):
        label = THERE.label("onedemo", tuned)
        median = median_outcome(groups.get(label, ()), figure("hop_reward"))
        if median is None or median.result is None:
            continue
        demo = find_demo(THERE.target, Path())
        try:
            data = strip(demo, np.array(median.result["episode"]["qpos"]), first=0.1, last=0.35)
        except UserError:
            continue  # a machine that cannot draw; the figures stand without
        text = f"above the demo, below {label}, seed {median.job.seed} (the median), at the same times"
        blocks.append(
            Picture(name=f"{name}.webp", data=data, alt=text, note=text[0].upper() + text[1:] + ".")
        )
    return blocks


_FIGURES = {
    "hop_return": {
        "return until the fall": figure("hop_return"),
        "best": figure("hop_return", "best"),
        "upright, s": figure("upright_seconds"),
        "reward of 8 s": figure("hop_reward"),
        "its best": figure("hop_reward", "best"),
        "similarity, aligned": figure("aligned_similarity"),
        "ratings": lambda result: result["ratings"],
        "minutes": minutes,
    },
    "backflip_reward": {
        "backflip reward": figure("backflip_reward"),
        "best": figure("backflip_reward", "best"),
        "net turns": figure("net_turns"),
        "most": figure("net_turns", "best"),
        "similarity, aligned": figure("aligned_similarity"),
        "ratings": lambda result: result["ratings"],
        "minutes": minutes,
    },
}
_EACH = {
    "hop_return": {
        "return until the fall, best of 16": figure("hop_return", "best"),
        "reward of 8 s, best of 16": figure("hop_reward", "best"),
        "similarity, aligned": figure("aligned_similarity"),
    },
    "backflip_reward": {
        "backflip reward": figure("backflip_reward"),
        "net turns": figure("net_turns"),
    },
}
_INTRODUCTION = (
    "A predictor that learned the backflip from 350 ratings is fine-tuned to the hop with 55 (30 before "
    "practice, 25 during it), and compared with one that has as many from scratch, and with TRPO on "
    "the reward of Hopper-v5. The hop's demo lasts 8 s. Then the other way round. The rater makes no error. "
    "The fine-tuned runs know the first move's 350 ratings too; those are not counted in the 55."
)
_EXPLANATIONS = (
    "**Return until the fall**: of stock Hopper-v5, where a lean of more than 0.2 rad or a height below "
    "0.7 m ends the episode; a rater does not see 0.2 rad as a fall, so this is a hard measure for a learner "
    "that is never told of it. **Reward of 8 s**: the same rewards over the whole episode, falls or not. The "
    "paper does not say which of the two its hopping reward is. **Minutes**: of the second run, without "
    "evaluation. The first run is trained for 300,000 steps: its policy is not used."
)
