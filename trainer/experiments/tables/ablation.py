"""``onedemo bench ablation``: the method without each of its parts, and the paper's method with each.

A switch is one setting or a few in which the two methods differ (``config.METHODS``): off, they have the
paper's values; on, onedemo's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from onedemo.config import METHODS, RunConfig
from onedemo.experiments.jobs.method import method_job
from onedemo.experiments.report.blocks import Reference, number
from onedemo.experiments.runner import Job, Outcome
from onedemo.experiments.statistics import spread
from onedemo.experiments.tables import backflip, parts
from onedemo.experiments.tables.parts import Groups, Pick, columns, figure

STEPS = 500_000
"""Control steps of practice: fewer than in the other tables, where learning is steepest."""
RATINGS = 350
QUICK_STEPS, QUICK_RATINGS = backflip.QUICK_STEPS, backflip.QUICK_RATINGS

SWITCHES: Mapping[str, tuple[str, ...]] = {
    "clips from random states": ("ratings.starts",),
    "questions about any moment": ("ratings.pairing",),
    "chosen clips, in rounds": ("ratings.choice", "ratings.rounds"),
    "a pose estimator": ("predictor.appearance",),
    "a learned distance": ("predictor.kind",),
    "three predictors": ("predictor.members",),
    "an adaptive phase": ("practice.elastic",),
    "starts from a reset buffer": ("practice.bank_share",),
    "early termination": ("practice.give_up",),
    "a policy that sees the demo": ("policy.kind",),
    "a shrinking trust region": ("trpo.final_kl",),
}
"""What each is called, and its settings."""

ON: Mapping[str, tuple[str, ...]] = {
    **{name: keys for name, keys in SWITCHES.items() if name != "a pose estimator"},
    "principal components of the features": ("predictor.visual_dims",),
    "a learned distance and a pose estimator": ("predictor.kind", "predictor.appearance"),
}
"""The same for the paper's method, whose network makes nothing of a pose estimator alone; onedemo's distance
makes nothing of principal components."""

_OURS, _PAPER = "onedemo", "paper"
_QUICK = {_OURS: ("an adaptive phase", "early termination"), _PAPER: ("an adaptive phase",)}


def plan(seeds: tuple[int, ...], *, quick: bool) -> list[Job]:
    """Seed by seed: both methods, onedemo without each, paper with each."""
    sizes = (QUICK_RATINGS, QUICK_STEPS) if quick else (RATINGS, STEPS)
    return [job for seed in seeds for job in _of_seed(seed, *sizes, quick=quick)]


def _of_seed(seed: int, ratings: int, steps: int, *, quick: bool) -> list[Job]:
    jobs = [
        method_job(method, seed, method=method, ratings=ratings, steps=steps) for method in (_OURS, _PAPER)
    ]
    for method, sign, switches in ((_OURS, "without", SWITCHES), (_PAPER, "with", ON)):
        for name, keys in switches.items():
            if not quick or name in _QUICK[method]:
                values = off(keys) if method == _OURS else on(keys)
                label = f"{method} {sign} {name}"
                jobs.append(
                    method_job(label, seed, method=method, ratings=ratings, steps=steps, changes=values)
                )
    if not quick:  # tried for the paper's network; onedemo's distance knows the order of ratings anyway
        jobs.append(
            method_job(
                f"{_PAPER} with an ordinal loss", seed, method=_PAPER, ratings=ratings, steps=steps,
                changes={"predictor.ordinal": True},
            )
        )  # fmt: skip
    return jobs


def off(keys: Sequence[str]) -> dict[str, Any]:
    """Values of settings in the paper's method."""
    return {key: METHODS["paper"][key] for key in keys}


def on(keys: Sequence[str]) -> dict[str, Any]:
    """Values of settings in onedemo, the defaults."""
    values = {}
    for key in keys:
        value: Any = RunConfig()
        for part in key.split("."):
            value = getattr(value, part)
        values[key] = value
    return values


_TURNS = figure("net_turns")


def _part(method: str, sign: str, title: str) -> parts.Section:
    """Bars and a table of one method and its changes."""

    def of(groups: Groups) -> Groups:
        start = f"{method} "
        return {
            label.removeprefix(start): group
            for label, group in groups.items()
            if label == method or label.startswith(f"{start}{sign} ")
        }

    def change(pick: Pick, group: Sequence[Outcome], groups: Groups) -> str:
        less = spread(group, pick).mean - spread(groups[method], pick).mean
        return "" if group is groups[method] else f"{'+' if less > 0 else ''}{number(less)}"

    bars = parts.BarChart(
        pick=_TURNS, name=f"ablation_{method}", title=f"{title}: net turns", strong=(method,),
        x_label="turns, mean of 16 episodes", note="Bar: mean over seeds; dots: each.",
        reference=lambda groups: Reference(label=method, y=spread(groups[method], _TURNS).mean),
    )  # fmt: skip
    figures = {
        "net turns": _TURNS,
        "change": (_TURNS, change),
        "each seed": (_TURNS, parts.each),
        **columns("clean turns", "backflip reward", "similarity, aligned", "demo's own states", "shuffled"),
    }
    return parts.Section(title, [bars, parts.Figures(figures)], of)


def _facts(groups: Groups) -> dict[str, Any]:
    seeds = len(groups[_OURS])
    many = f"{seeds} {'seed' if seeds == 1 else 'seeds'}"
    return {**parts.settings(groups), "seeds": many, "others": backflip.STEPS}


TABLE = parts.Experiment(
    title="onedemo: what each part contributes", seeds=3, plan=plan,
    parts=[
        parts.Worded(
            "The tumbling demo of 8 s, {ratings} ratings of a rater without error. **{seeds} and {steps:,} "
            "control steps of practice**: fewer than in the table of methods (5 seeds, {others:,} steps). "
            "Figures are of 16 episodes of the final policy. With so few seeds, a difference within their "
            "spread is none.",
            _facts,
        ),
        _part(_OURS, "without", "onedemo without each part"),
        _part(_PAPER, "with", "The paper's method with each part"),
    ],
)  # fmt: skip
