"""The figures of Table 1, what can be said of them, and what cannot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from onedemo.experiments.jobs.predictor_exam import ATTEMPTS, OTHERS, STANDING, WILD
from onedemo.experiments.predictor_scores import interval
from onedemo.experiments.report.blocks import number
from onedemo.experiments.runner import Outcome
from onedemo.experiments.statistics import Spread, spread

PAPER = {
    "random sampling": (54.22, 42.89, 13.46, 6.97),
    "sampling equally": (47.66, 39.28, 13.64, 18.81),
    "class weights": (52.05, 38.11, 14.14, 5.26),
    "equal + weights": (49.05, 38.16, 12.79, 4.66),
    "additional layer": (52.45, 41.67, 17.42, 22.68),
}
"""Of Gandhi et al., Table 1, %: validation, test, F1 of 3 to 5, F1 of 4 and 5."""
PAPERS_CHOICE, OURS = "additional layer", "metric"


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of one predictor."""

    head: str
    pick: Callable[[Mapping[str, Any]], float | None]
    """Takes it from the predictor's part of a result."""

    def of(self, outcomes: Sequence[Outcome], variant: str) -> Spread:
        """Over the seeds."""
        return spread(outcomes, lambda result: self.pick(result["variants"][variant]))

    def paired(self, outcomes: Sequence[Outcome], variant: str) -> list[float]:
        """Less that of the paper's choice, on the seeds that have both."""
        pairs = zip(self.of(outcomes, variant).values, self.of(outcomes, PAPERS_CHOICE).values, strict=True)
        return [a - b for a, b in pairs if a is not None and b is not None]

    def differs(self, outcomes: Sequence[Outcome], variant: str) -> bool:
        """Whether zero lies outside the 95 % interval of the difference, seed by seed."""
        low, high = interval(self.paired(outcomes, variant))
        return low > 0 or high < 0


def _percent(head: str, key: str) -> Figure:
    return Figure(head, lambda part: None if part[key] is None else 100 * part[key])


def rank(policy: str) -> Figure:
    """Rank correlation on clips of a policy."""
    return Figure(policy, lambda part: part["ranks"][policy])


TEST, F1, F1_HIGH = _percent("test", "test"), _percent("F1 of 3-5", "f1_3"), _percent("F1 of 4-5", "f1_4")
COUNTED = (
    _percent("validation", "validation"), TEST, F1, F1_HIGH, _percent("off by 3", "error_3"),
    _percent("off by 4", "error_4"),
)  # fmt: skip
BESIDES = (
    _percent("mean F1 of 3, 4, 5", "macro_3"), _percent("mean F1 of 4, 5", "macro_4"),
    _percent("calibration error", "calibration"), Figure("fit, s", lambda part: part["fit_s"]),
)  # fmt: skip
OWN = Figure("own states", lambda part: part["own"])
SHUFFLED = Figure("shuffled", lambda part: part["shuffled"])
CONTRAST = Figure("own less shuffled", lambda part: part["own"] - part["shuffled"])
PICKED = Figure("picked states", lambda part: part["picked"])
POLICIES = (STANDING, WILD, OTHERS, ATTEMPTS)
WORTH = (OWN, SHUFFLED, PICKED, *map(rank, POLICIES))


def findings(label: str, outcomes: Sequence[Outcome]) -> list[str]:
    """The outcome in sentences, the loudest where nothing can be told apart.

    Args:
        label: Which ratings.
        outcomes: Of these, one for each seed.
    """
    sentences = [_apart(f"**{label}, {figure.head}**", figure, outcomes) for figure in (TEST, F1, F1_HIGH)]
    paper, ours = (
        [figure.of(outcomes, name) for figure in (OWN, SHUFFLED, PICKED, rank(OTHERS))]
        for name in (PAPERS_CHOICE, OURS)
    )
    return [
        *sentences,
        f"**{label}, worth**: the demo's own states are rated **{ours[0]} by onedemo's metric** (shuffled "
        f"{ours[1]}) and {paper[0]} by the paper's network (shuffled {paper[1]}); the random states that "
        f"they pick have a true rating of **{ours[2]}** and {paper[2]}; their rank correlation with the "
        f"truth on other moves is **{ours[3]}** and {paper[3]}.",
    ]


def _apart(what: str, figure: Figure, outcomes: Sequence[Outcome]) -> str:
    """Whether the paper's five variants differ by more than seeds do."""
    five = [figure.of(outcomes, name) for name in PAPER]
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
    others = [name for name in PAPER if name != PAPERS_CHOICE and figure.differs(outcomes, name)]
    if not others:
        return f"{begin} **Seed by seed, none can be told from the additional layer.**"
    return f"{begin} Seed by seed, only these can be told from the additional layer: {', '.join(others)}."
