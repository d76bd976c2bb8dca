"""How good ratings are: agreement, steadiness, pace, drift, and who should be looked at. Pure.

Agreement is Krippendorff's alpha on the ordinal scale (Krippendorff 2011, "Computing Krippendorff's
alpha-reliability"): 1 is perfect, 0 is chance. Shapes: n ratings, u clips that several people rated.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

import krippendorff
import numpy as np

from onedemo.sim import vector_env
from onedemo.storage.store import Store

_CLASSES = 5
_RESAMPLES = 400
_LEAST = 20
"""Ratings, before anything is said of a rater's habits."""
_ALIKE = 0.95
"""Share of one class from which on a rater "always says the same"."""
_HASTY = 0.2
"""Share of answers sooner than the clip has played once from which on a rater is "too fast"."""


class RatingRow(NamedTuple):
    """One rating that holds."""

    clip: int
    rater: str
    value: int
    repeat: bool
    latency_ms: int
    predicted: float | None
    clip_ms: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """Krippendorff's alpha with its bootstrap interval."""

    alpha: float | None = None
    """None if it cannot be told: no clip with two raters, or all ratings of them the same."""
    low: float | None = None
    high: float | None = None
    """The middle 95 % over resampled clips."""
    clips: int = 0
    """u."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Quality:
    """What can be said of some ratings."""

    ratings: int
    shares: list[float]
    """Of the classes 1..5."""
    agreement: Agreement
    repeats: int
    """Clips rated a second time by the same person."""
    same: float | None
    """Share of these rated the same."""
    apart: float | None
    """Mean absolute difference between second and first opinion, points."""
    seconds: float | None
    """Median time from the clip on screen to the press."""
    drift: float | None
    """How much kinder the last third is than the first, beside what was predicted for them, points."""
    warnings: list[str] = field(default_factory=list)


def rating_rows(store: Store, run: str, most: int = 5000) -> list[RatingRow]:
    """The newest ratings of a run that hold, oldest first."""
    dt = vector_env.spec("hopper").dt
    columns = ("clip_id", "rater", "value", "repeat", "latency_ms", "predicted", "steps")
    rows = store.ratings.newest(run, most, columns)
    return [
        RatingRow(clip, rater, value, bool(repeat), latency, predicted, 1000 * dt * steps)
        for clip, rater, value, repeat, latency, predicted, steps in rows
    ]


def quality(rows: Sequence[RatingRow], *, seed: int = 0) -> Quality:
    """All figures of some ratings: of everybody.

    Args:
        rows: n ratings, oldest first.
        seed: Of the bootstrap.
    """
    return _figures(rows, agreement(rows, seed=seed), warnings=[])


def quality_by_rater(
    rows: Sequence[RatingRow], *, raters: Iterable[str] = (), seed: int = 0
) -> dict[str, Quality]:
    """The same of each rater. Agreement is that on the clips which this rater and others have rated.

    Args:
        rows: n ratings of everybody, oldest first.
        raters: More people, of whom there may be no rating.
        seed: Of the bootstrap.
    """
    answer = {}
    for rater in sorted({*raters, *(row.rater for row in rows)}):
        own = [row for row in rows if row.rater == rater]
        mine = {row.clip for row in own if not row.repeat}
        shared = agreement([row for row in rows if row.clip in mine], seed=seed)
        answer[rater] = _figures(own, shared, warnings=warnings(own))
    return answer


def agreement(rows: Sequence[RatingRow], *, seed: int = 0) -> Agreement:
    """Krippendorff's alpha, ordinal, over the clips with two first opinions or more."""
    counts: dict[int, np.ndarray] = {}
    for row in rows:
        if not row.repeat:
            counts.setdefault(row.clip, np.zeros(_CLASSES, int))[row.value - 1] += 1
    units = np.array([count for count in counts.values() if count.sum() > 1])
    if not len(units):
        return Agreement()
    rng = np.random.default_rng(seed)
    resampled = [_alpha(units[rng.integers(len(units), size=len(units))]) for _ in range(_RESAMPLES)]
    known = [alpha for alpha in resampled if alpha is not None]
    low, high = np.percentile(known, (2.5, 97.5)).tolist() if known else (None, None)
    return Agreement(alpha=_alpha(units), low=low, high=high, clips=len(units))


def warnings(rows: Sequence[RatingRow]) -> list[str]:
    """What a researcher should look at in one rater's ratings, oldest first."""
    if len(rows) < _LEAST:
        return []
    found = []
    values = [row.value for row in rows]
    most = max(set(values), key=values.count)
    if values.count(most) >= _ALIKE * len(values):
        found.append(f"nearly always says {most}")
    elif len(set(values[-_LEAST:])) == 1:
        found.append(f"the last {_LEAST} were all {values[-1]}")
    hasty = sum(row.latency_ms < row.clip_ms + _REACTION_MS for row in rows) / len(rows)
    if hasty >= _HASTY:
        found.append(f"{100 * hasty:.0f} % of the answers came before the clip had played once")
    return found


_REACTION_MS = 100
"""Nobody presses sooner after what was seen."""


def _figures(rows: Sequence[RatingRow], shared: Agreement, *, warnings: list[str]) -> Quality:
    values = np.array([row.value for row in rows], int)
    counts = np.bincount(values, minlength=_CLASSES + 1)[1:] if len(values) else np.zeros(_CLASSES)
    firsts = {(row.rater, row.clip): row.value for row in rows if not row.repeat}
    apart = [
        row.value - firsts[row.rater, row.clip]
        for row in rows
        if row.repeat and (row.rater, row.clip) in firsts
    ]
    return Quality(
        ratings=len(rows),
        shares=(counts / max(1, len(rows))).tolist(),
        agreement=shared,
        repeats=len(apart),
        same=float(np.mean(np.array(apart) == 0)) if apart else None,
        apart=float(np.abs(apart).mean()) if apart else None,
        seconds=median(row.latency_ms for row in rows) / 1000 if rows else None,
        drift=_drift([row.value - row.predicted for row in rows if row.predicted is not None]),
        warnings=warnings,
    )


def _drift(above: Sequence[float]) -> float | None:
    third = len(above) // 3
    return float(np.mean(above[-third:]) - np.mean(above[:third])) if third >= _LEAST else None


def _alpha(units: np.ndarray) -> float | None:
    if (units.sum(axis=0) > 0).sum() < 2:  # one class alone: agreement cannot be told from habit
        return None
    return float(krippendorff.alpha(value_counts=units, level_of_measurement="ordinal"))
