"""``onedemo bench transfer``: what a predictor of another move is worth (the paper's Table 3)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from onedemo.experiments.jobs.method import method_job
from onedemo.experiments.jobs.transfer import transfer_job
from onedemo.experiments.report.blocks import Block, Heading, Table, Text, number
from onedemo.experiments.runner import Job, Outcome
from onedemo.experiments.statistics import Spread, spread, spread_of
from onedemo.experiments.tables import parts
from onedemo.experiments.tables.episode import BESIDE, Episode
from onedemo.experiments.tables.parts import Groups, Pick, columns, figure

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
"""Goals, set before any of these runs."""


@dataclass(frozen=True, slots=True)
class Direction:
    """From one move to another."""

    title: str
    source: str
    target: str
    figures: tuple[str, ...]
    """What the target move is measured by, the main one first."""
    part: str
    """Of 16 episodes: the "best", as the paper's is the maximum, or the "mean"."""

    def label(self, method: str, tuned: bool) -> str:
        """Of the jobs of one method."""
        return f"{self.title}: {method}, {'fine-tuned' if tuned else 'from scratch'}"

    @property
    def baseline(self) -> str:
        """Label of TRPO on the target's hand-coded reward."""
        return f"{self.title}: {_TRPO}"


THERE = Direction("backflip to hop", _FLIP, _HOP, ("hop_return", "hop_reward"), "best")
BACK = Direction("hop to backflip", _HOP, _FLIP, ("backflip_reward",), "mean")

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


@dataclass(frozen=True, slots=True)
class _Pair:
    """One figure of runs that are fine-tuned and of runs from scratch, over seeds."""

    tuned: Spread
    scratch: Spread
    ratios: Spread
    """Seed by seed."""

    def verdict(self, met: bool) -> str:
        """Nothing is claimed while a seed is missing."""
        return "open" if self.tuned.missing or self.scratch.missing else "**met**" if met else "missed"


def _by_seed(outcomes: Sequence[Outcome], pick: Pick) -> dict[int, float | None]:
    return {o.job.seed: None if o.result is None else pick(o.result) for o in outcomes}


def _pairs(groups: Groups) -> dict[tuple[Direction, str, str], _Pair]:
    """By direction, method and figure; those of which one half was not planned are left out."""
    pairs = {}
    for way in (THERE, BACK):
        labels = {method: [way.label(method, tuned) for tuned in (True, False)] for method in _METHODS}
        for name in way.figures:
            pick = figure(name, way.part)
            for method, two in labels.items():
                if all(label in groups for label in two):
                    tuned, scratch = (groups[label] for label in two)
                    less = _by_seed(scratch, pick)
                    ratios = [
                        value / base if value is not None and (base := less.get(seed) or 0) > 0 else None
                        for seed, value in _by_seed(tuned, pick).items()
                    ]
                    pair = _Pair(spread(tuned, pick), spread(scratch, pick), spread_of(ratios))
                    pairs[way, method, name] = pair
    return pairs


def goals(groups: Groups) -> Iterable[Block]:
    """A table of them, over the means of the seeds."""
    rows = []
    for (way, method, name), pair in _pairs(groups).items():
        what, both = f"{way.title}, {method}, {name}", (str(pair.tuned), str(pair.scratch))
        ratio = pair.tuned.mean / pair.scratch.mean if pair.scratch.mean > 0 else np.nan
        verdict = pair.verdict(ratio >= _RATIO)
        rows.append((what, f"{_RATIO:g} x scratch", *both, number(ratio), pair.ratios.each, verdict))
        if way is THERE:
            verdict = pair.verdict(pair.tuned.mean >= _BEYOND)
            rows.append((what, f"beyond: {_BEYOND:g}", *both, "", pair.tuned.each, verdict))
    yield Table(
        heads=(
            "direction, method, figure", "reach", "fine-tuned", "from scratch", "ratio", "each seed",
            "verdict",
        ),
        rows=rows,
        notes=("Hop: best of 16 episodes, as the paper's is the maximum; backflip: mean of 16. Ratio: of the "
               "means over seeds; of each seed beside it.",),
    )  # fmt: skip


def _papers_table(groups: Groups) -> Iterable[Block]:
    """The paper's Table 3, and the same of ours: the best episode, as the paper's is the maximum."""
    labels = {THERE.baseline: "TRPO"} | {
        THERE.label(method, tuned): "fine-tuned" if tuned else "from scratch"
        for method in _METHODS
        for tuned in (True, False)
    }
    rows = [
        (
            ours.removeprefix(f"{THERE.title}: "), 0 if theirs == "TRPO" else RATINGS, PAPER[theirs],
            *(str(spread(groups[ours], figure(name, "best"))) for name in THERE.figures),
        )
        for ours, theirs in labels.items()
        if ours in groups
    ]  # fmt: skip
    heads = ("", "ratings", "paper", "return until the fall, best of 16", "reward of 8 s, best of 16")
    yield Table(heads=heads, rows=rows, title="Table 3")


def _direction(
    way: Direction, heading: str, means: Mapping[str, Pick], seeds: Mapping[str, Pick],
    curve: tuple[str, str], *first: parts.Part,
) -> list[parts.Part]:  # fmt: skip
    """A section; the labels in it lack the direction."""

    def own(groups: Groups) -> Groups:
        return {label: group for label, group in groups.items() if label.startswith(way.title)}

    def short(groups: Groups) -> Groups:
        return {label.removeprefix(f"{way.title}: "): group for label, group in groups.items()}

    name, what = curve
    inner = [
        parts.Figures(means, parts.OVER_SEEDS),
        parts.Figures(seeds, "Each seed", parts.each),
        parts.Curves(way.figures[0], name, f"{what}, {way.title}", what),
    ]
    return [parts.Section(heading, [*first, parts.Section("", inner, short)], own)]


_COMMON = columns("similarity, aligned", "ratings", "minutes")
_HOPS = {
    **columns("return until the fall"),
    "best": figure("hop_return", "best"),
    **columns("upright, s", "reward of 8 s"),
    "its best": figure("hop_reward", "best"),
    **_COMMON,
}
_EACH_HOP = {
    "return until the fall, best of 16": figure("hop_return", "best"),
    "reward of 8 s, best of 16": figure("hop_reward", "best"),
    **columns("similarity, aligned"),
}
_FLIPS = {
    **columns("backflip reward"),
    "best": figure("backflip_reward", "best"),
    **columns("net turns"),
    "most": figure("net_turns", "best"),
    **_COMMON,
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
_ABOVE = "bove the demo, below {label}, seed {seed} (the median), at the same times"


def _strip(tuned: bool, name: str) -> Episode:
    """The paper's figure: the first two seconds of the hop, demo above robot."""
    label = THERE.label("onedemo", tuned)
    return Episode(label, name, f"a{_ABOVE}", f"A{_ABOVE}.", figure="hop_reward", part=(0.1, 0.35))


def _data(groups: Groups) -> dict[str, Any]:
    ratios = {
        f"{way.title}, {method}, {name}": pair.ratios.values
        for (way, method, name), pair in _pairs(groups).items()
    }
    return {"paper": PAPER, "ratios": ratios}


TABLE = parts.Experiment(
    title="onedemo: from one move to another", seeds=5, plan=plan, data=_data,
    parts=[
        Text(_INTRODUCTION),
        Heading("What should be reached"),
        goals,
        *_direction(
            THERE, "Hopping from a predictor of the backflip", _HOPS, _EACH_HOP,
            ("hop_curve", "hopping return"), _papers_table,
        ),
        *_direction(
            BACK, "A backflip from a predictor of the hop", _FLIPS, columns("backflip reward", "net turns"),
            ("backflip_curve", "backflip reward"),
        ),
        Text(_EXPLANATIONS),
        Heading("What it looks like"),
        _strip(True, "hop_fine_tuned.webp"),
        _strip(False, "hop_scratch.webp"),
        Episode(THERE.label("onedemo", True), "hop_transferred.webp", BESIDE),
    ],
)  # fmt: skip
