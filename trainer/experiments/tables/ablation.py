"""``onedemo bench ablation``: the method without each of its parts, and the paper's method with each.

A switch is one setting or a few in which the two methods differ (``config.METHODS``): off, they have the
paper's values; on, onedemo's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from onedemo.config import METHODS, RunConfig
from onedemo.experiments.jobs.method import method_job
from onedemo.experiments.report.blocks import (
    Bars,
    Block,
    Cell,
    Document,
    Heading,
    Reference,
    Table,
    Text,
    number,
)
from onedemo.experiments.runner import Job, Outcome, by_label
from onedemo.experiments.statistics import spread
from onedemo.experiments.tables import backflip
from onedemo.experiments.tables.summary import Groups, figure

TITLE = "onedemo: what each part contributes"
SEEDS = 3
STEPS = 500_000
"""Control steps of practice: fewer than in the other tables, where learning is steepest."""
RATINGS = 350
QUICK_STEPS, QUICK_RATINGS = backflip.QUICK_STEPS, backflip.QUICK_RATINGS

SWITCHES: Mapping[str, tuple[str, ...]] = {
    "clips from random states": ("ratings.starts",),
    "questions about any moment": ("ratings.pairing",),
    "chosen clips, in rounds": ("ratings.choice", "ratings.rounds"),
    "appearance": ("predictor.appearance",),
    "a learned distance": ("predictor.kind",),
    "three predictors": ("predictor.members",),
    "an elastic clock": ("practice.elastic",),
    "starts from a bank": ("practice.bank_share",),
    "giving up": ("practice.give_up",),
    "a policy that sees the demo": ("policy.kind",),
    "a shrinking trust region": ("trpo.final_kl",),
}
"""What each is called, and its settings."""

ON: Mapping[str, tuple[str, ...]] = {
    **{name: keys for name, keys in SWITCHES.items() if name != "appearance"},
    "principal components of the features": ("predictor.visual_dims",),
    "a learned distance and appearance": (*SWITCHES["a learned distance"], *SWITCHES["appearance"]),
}
"""The same for the paper's method, whose network makes nothing of appearance alone; onedemo's distance
makes nothing of principal components."""

_OURS, _PAPER = "onedemo", "paper"
_QUICK = {_OURS: ("an elastic clock", "giving up"), _PAPER: ("an elastic clock",)}


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


def report(outcomes: Sequence[Outcome], *, quick: bool) -> Document:
    """What is lost without each part, and what each gives to the paper's method."""
    groups = by_label(outcomes)
    settings = outcomes[0].job.settings
    seeds = len(groups[_OURS])
    blocks: list[Block] = [
        Text(
            f"The tumbling demo of 8 s, {settings['ratings']} ratings of a rater without error. **{seeds} "
            f"{'seed' if seeds == 1 else 'seeds'} and {settings['steps']:,} control steps of practice**: "
            f"fewer than in the table of methods (5 seeds, {backflip.STEPS:,} steps). Figures are of "
            "16 episodes of the final policy. With so few seeds, a difference within their spread is none."
        ),
        *_part(groups, _OURS, "without", "onedemo without each part"),
        *_part(groups, _PAPER, "with", "The paper's method with each part"),
    ]
    return Document(title=TITLE, blocks=blocks)


def _part(groups: Groups, method: str, sign: str, title: str) -> list[Block]:
    """Bars and a table of one method and its changes."""
    start = f"{method} {sign} "
    chosen = {label: group for label, group in groups.items() if label == method or label.startswith(start)}
    whole = spread(chosen[method], figure("net_turns"))
    turns = {label: spread(group, figure("net_turns")) for label, group in chosen.items()}
    rows: list[tuple[Cell, ...]] = []
    for label, group in chosen.items():
        change = turns[label].mean - whole.mean
        rows.append(
            (
                label.removeprefix(f"{method} "),
                str(turns[label]),
                "" if label == method else f"{'+' if change > 0 else ''}{number(change)}",
                turns[label].each,
                *(str(spread(group, figure(name))) for name in _MORE.values()),
                str(spread(group, lambda result: result["demo_rated"])),
                str(spread(group, lambda result: result["demo_shuffled"])),
            )
        )
    heads = ("", "net turns", "change", "each seed", *_MORE, "demo's own states", "shuffled")
    there = {label: figures for label, figures in turns.items() if figures.missing < len(figures.values)}
    bars = Bars(
        name=f"ablation_{method}", title=f"{title}: net turns", x_label="turns, mean of 16 episodes",
        labels=[label.removeprefix(f"{method} ") for label in turns],
        values=[figures.mean if label in there else None for label, figures in turns.items()],
        each=[[value for value in figures.values if value is not None] for figures in turns.values()],
        reference=Reference(label=method, y=whole.mean) if method in there else None, strong=(method,),
        note="Bar: mean over seeds; dots: each.",
    )  # fmt: skip
    return [Heading(title), *([bars] if there else []), Table(heads=heads, rows=rows)]


_MORE = {
    "clean turns": "clean_turns",
    "backflip reward": "backflip_reward",
    "similarity, aligned": "aligned_similarity",
}
