"""The figures of Table 1, what can be said of them, and what cannot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from onedemo.experiments.jobs.predictor_exam import ATTEMPTS, OTHERS, STANDING, WILD
from onedemo.experiments.jobs.predictor_trial import VARIANTS
from onedemo.experiments.predictor_scores import interval
from onedemo.experiments.report.blocks import number
from onedemo.experiments.runner import Outcome
from onedemo.experiments.statistics import Spread, spread
from onedemo.experiments.tables.parts import Groups, Pick, Result

PAPER = {
    "random sampling": (54.22, 42.89, 13.46, 6.97),
    "sampling equally": (47.66, 39.28, 13.64, 18.81),
    "class weights": (52.05, 38.11, 14.14, 5.26),
    "equal + weights": (49.05, 38.16, 12.79, 4.66),
    "additional layer": (52.45, 41.67, 17.42, 22.68),
}
"""Of Gandhi et al., Table 1, %: validation, test, F1 of 3 to 5, F1 of 4 and 5."""
PAPERS_CHOICE, OURS = "additional layer", "metric"
POLICIES = (STANDING, WILD, OTHERS, ATTEMPTS)


def split(outcomes: Sequence[Outcome], key: str, names: Iterable[str]) -> Groups:
    """A group for each name, whose results have what belongs to that name alone under the key."""

    def one(outcome: Outcome, name: str) -> Outcome:
        result = outcome.result
        return replace(outcome, kept={"result": {**result, key: result[key][name]}}) if result else outcome

    return {name: [one(outcome, name) for outcome in outcomes] for name in names}


def by_variant(outcomes: Sequence[Outcome]) -> Groups:
    """A group for each predictor."""
    return split(outcomes, "variants", VARIANTS)


def _of(key: str) -> Pick:
    return lambda result: result["variants"][key]


def _percent(key: str) -> Pick:
    def pick(result: Result) -> float | None:
        share = result["variants"][key]
        return None if share is None else 100 * share

    return pick


def _rank(policy: str) -> Pick:
    return lambda result: result["variants"]["ranks"][policy]


COUNTED = {
    "validation": _percent("validation"), "test": _percent("test"), "F1 of 3-5": _percent("f1_3"),
    "F1 of 4-5": _percent("f1_4"), "off by 3": _percent("error_3"), "off by 4": _percent("error_4"),
}  # fmt: skip
BESIDES = {
    "mean F1 of 3, 4, 5": _percent("macro_3"), "mean F1 of 4, 5": _percent("macro_4"),
    "calibration error": _percent("calibration"), "fit, s": _of("fit_s"),
}  # fmt: skip
RATED = {"own states": _of("own"), "shuffled": _of("shuffled"), "picked states": _of("picked")}
RANKS = {policy: _rank(policy) for policy in POLICIES}
CONTRAST = {"own less shuffled": lambda result: result["variants"]["own"] - result["variants"]["shuffled"]}
FIGURES: Mapping[str, Pick] = {**COUNTED, **BESIDES, **RATED, **RANKS, **CONTRAST}


def named(*heads: str) -> dict[str, Pick]:
    """Figures by their heads."""
    return {head: FIGURES[head] for head in heads}


ACCURACY = named("test", "F1 of 3-5", "F1 of 4-5")


def paired(pick: Pick, one: Sequence[Outcome], other: Sequence[Outcome]) -> list[float]:
    """The figure of one predictor less that of another, on the seeds that have both."""
    pairs = zip(spread(one, pick).values, spread(other, pick).values, strict=True)
    return [a - b for a, b in pairs if a is not None and b is not None]


def differs(values: Sequence[float]) -> bool:
    """Whether zero lies outside the 95 % interval of their mean."""
    low, high = interval(values)
    return low > 0 or high < 0


def difference(pick: Pick, group: Sequence[Outcome], groups: Groups) -> str:
    """Mean and interval of what a predictor has more than the paper's choice."""
    values = paired(pick, group, groups[PAPERS_CHOICE])
    if len(values) < 2:
        return "–"
    if not np.any(values):
        return "the same"
    low, high = interval(values)
    text = f"{np.mean(values):+.2g} [{low:.2g}, {high:.2g}]"
    return f"**{text}**" if differs(values) else text


def always_the_same(outcomes: Sequence[Outcome], part: str) -> Spread:
    """Accuracy, %, of predicting the most frequent of the ratings that were fitted for all clips."""

    def pick(result: Mapping[str, Any]) -> float:
        counts = result["classes"][part]
        return 100 * counts[int(np.argmax(result["classes"]["fitted"]))] / sum(counts)

    return spread(outcomes, pick)


def findings(label: str, groups: Groups) -> list[str]:
    """The outcome in sentences, the loudest where nothing can be told apart.

    Args:
        label: Which ratings.
        groups: The outcomes of each predictor.
    """
    sentences = [_apart(f"**{label}, {head}**", pick, groups) for head, pick in ACCURACY.items()]
    paper, ours = (
        [spread(groups[name], pick) for pick in (*RATED.values(), RANKS[OTHERS])]
        for name in (PAPERS_CHOICE, OURS)
    )
    return [
        *sentences,
        f"**{label}, worth**: the demo's own states are rated **{ours[0]} by onedemo's metric** (shuffled "
        f"{ours[1]}) and {paper[0]} by the paper's network (shuffled {paper[1]}); the random states that "
        f"they pick have a true rating of **{ours[2]}** and {paper[2]}; their rank correlation with the "
        f"truth on other moves is **{ours[3]}** and {paper[3]}.",
    ]


def _apart(what: str, pick: Pick, groups: Groups) -> str:
    """Whether the paper's five variants differ by more than seeds do."""
    five = [spread(groups[name], pick) for name in PAPER]
    means = [s.mean for s in five if np.isfinite(s.mean)]
    if not means:
        return f"{what}: no clip has such a rating, given or predicted."
    apart, noise = max(means) - min(means), float(np.nanmean([s.deviation for s in five]))
    if apart == 0 and noise == 0:
        return f"{what}: **{number(means[0])} for all of the paper's five variants, on each seed**."
    begin = f"{what}: the means of the paper's five variants lie {apart:.1f} points apart"
    if max(len(s.values) - s.missing for s in five) < 2:
        return f"{begin}, **of one seed, which shows no spread: nothing can be said**."
    versus = f"than the spread of one variant over seeds, {noise:.1f} points"
    begin += f", **less {versus}**." if apart < noise else f", more {versus}."
    choice = groups[PAPERS_CHOICE]
    others = [n for n in PAPER if n != PAPERS_CHOICE and differs(paired(pick, groups[n], choice))]
    if not others:
        return f"{begin} **Seed by seed, none can be told from the additional layer.**"
    return f"{begin} Seed by seed, only these can be told from the additional layer: {', '.join(others)}."
