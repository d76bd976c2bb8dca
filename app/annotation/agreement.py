"""How good ratings are: agreement, steadiness, pace, drift, and who should be looked at. Pure.

Agreement is Krippendorff's alpha on the ordinal scale (Krippendorff 2011, "Computing Krippendorff's
alpha-reliability"): 1 is perfect, 0 is chance. Shapes: n ratings, u clips that several people rated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from statistics import median
from typing import NamedTuple

import krippendorff
import numpy as np

from onedemo.storage.store import Store

_CLASSES = 5
_RESAMPLES = 400
_LEAST = 20
"""Ratings, before anything is said of a rater's habits."""
_ALIKE = 0.95
"""Share of one class from which on a rater "always says the same"."""
GOOD, FAIR = 0.8, 0.667
"""Alpha from which on ratings are reliable, and from which on they allow tentative conclusions: Krippendorff,
"Content Analysis", 2004, chapter 11."""
_PARTS = 12
"""In which a trend is told, at most."""
_LEAST_PART = 8
"""Ratings in a part of a trend; clips that several people rated, for its agreement."""
_LEAST_SHARED = 3
"""Clips that two people rated, before they are compared."""
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


@dataclass(frozen=True, kw_only=True, slots=True)
class Trend:
    """Figures of a rater's ratings, or of everybody's, in parts of equal length, oldest first."""

    means: list[float | None]
    """Mean rating."""
    seconds: list[float | None]
    """Median time from the clip on screen to the press."""
    alphas: list[float | None]
    """Agreement with others on the clips of the part; None where too few are shared."""


class Disputed(NamedTuple):
    """A clip that people rated differently."""

    clip: int
    apart: int
    """Points between the highest and the lowest rating."""
    opinions: list[tuple[str, int]]
    """(rater, rating), the highest first."""


class Difference(NamedTuple):
    """How far two people are from each other."""

    higher: str
    """Who of the two rates higher on average."""
    lower: str
    clips: int
    """That both rated."""
    apart: float
    """Mean absolute difference, points."""
    above: float
    """Mean difference, points, 0 or more."""


def verdict(alpha: float | None) -> str:
    """Alpha in a word: "good", "fair" or "poor"; "" if it cannot be told."""
    if alpha is None:
        return ""
    return "good" if alpha >= GOOD else "fair" if alpha >= FAIR else "poor"


def rating_rows(store: Store, run: str, most: int = 5000) -> list[RatingRow]:
    """The newest ratings of a run that hold, oldest first."""
    dt = next((entry["step_seconds"] for entry in store.runs.all() if entry["id"] == run), 0.0)
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
    rows: Sequence[RatingRow], *, raters: Iterable[str] = (), seed: int = 0, intervals: bool = True
) -> dict[str, Quality]:
    """The same of each rater. Agreement is that on the clips which this rater and others have rated.

    Args:
        rows: n ratings of everybody, oldest first.
        raters: More people, of whom there may be no rating.
        seed: Of the bootstrap.
        intervals: Whether to work out those of their agreement.
    """
    answer = {}
    for rater in sorted({*raters, *(row.rater for row in rows)}):
        own = [row for row in rows if row.rater == rater]
        mine = {row.clip for row in own if not row.repeat}
        shared = agreement([row for row in rows if row.clip in mine], seed=seed, interval=intervals)
        answer[rater] = _figures(own, shared, warnings=warnings(own))
    return answer


def agreement(rows: Sequence[RatingRow], *, seed: int = 0, interval: bool = True) -> Agreement:
    """Krippendorff's alpha, ordinal, over the clips with two first opinions or more.

    Args:
        rows: n ratings.
        seed: Of the bootstrap.
        interval: Whether to work it out.
    """
    units = np.array([count for count in _by_clip(rows).values() if count.sum() > 1])
    if not len(units):
        return Agreement()
    if not interval:
        return Agreement(alpha=_alpha(units), clips=len(units))
    rng = np.random.default_rng(seed)
    resampled = [_alpha(units[rng.integers(len(units), size=len(units))]) for _ in range(_RESAMPLES)]
    known = [alpha for alpha in resampled if alpha is not None]
    low, high = np.percentile(known, (2.5, 97.5)).tolist() if known else (None, None)
    return Agreement(alpha=_alpha(units), low=low, high=high, clips=len(units))


def trends(rows: Sequence[RatingRow]) -> dict[str, Trend]:
    """How figures went over the ratings given: "" for everybody, then each rater with enough ratings.

    Args:
        rows: n ratings of everybody, oldest first.
    """
    counts = _by_clip(rows)
    names = sorted({row.rater for row in rows})
    groups = {"": rows} | {name: [row for row in rows if row.rater == name] for name in names}
    found = {}
    for name, own in groups.items():
        own = [row for row in own if not row.repeat]
        parts = min(_PARTS, len(own) // _LEAST_PART)
        if parts < 2:
            continue
        cuts = [len(own) * part // parts for part in range(parts + 1)]
        pieces = [own[start:stop] for start, stop in pairwise(cuts)]
        found[name] = Trend(
            means=[float(np.mean([row.value for row in piece])) for piece in pieces],
            seconds=[median(row.latency_ms for row in piece) / 1000 for piece in pieces],
            alphas=[_alpha_of(counts, {row.clip for row in piece}) for piece in pieces],
        )
    return found


def disputed(rows: Sequence[RatingRow], most: int = 8) -> list[Disputed]:
    """The clips on which people are furthest apart, two points or more; of those the newest first.

    Args:
        rows: n ratings of everybody, oldest first.
        most: How many clips.
    """
    found = []
    for clip, opinions in _opinions(rows).items():
        apart = max(opinions.values()) - min(opinions.values())
        if apart >= 2:
            ordered = sorted(opinions.items(), key=lambda said: (-said[1], said[0]))
            found.append(Disputed(clip, apart, ordered))
    return sorted(found, key=lambda one: (-one.apart, -one.clip))[:most]


def differences(rows: Sequence[RatingRow], most: int = 6) -> list[Difference]:
    """Which two people are furthest apart on the clips that both rated.

    Args:
        rows: n ratings of everybody.
        most: How many pairs.
    """
    between: dict[tuple[str, str], list[int]] = {}
    for opinions in _opinions(rows).values():
        for one, other in combinations(sorted(opinions), 2):
            between.setdefault((one, other), []).append(opinions[one] - opinions[other])
    found = []
    for (one, other), gaps in between.items():
        if len(gaps) >= _LEAST_SHARED and any(gaps):
            above = float(np.mean(gaps))
            high, low = (one, other) if above >= 0 else (other, one)
            found.append(Difference(high, low, len(gaps), float(np.abs(gaps).mean()), abs(above)))
    return sorted(found, key=lambda pair: (-pair.apart, pair.higher, pair.lower))[:most]


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


def _by_clip(rows: Iterable[RatingRow]) -> dict[int, np.ndarray]:
    """How many first opinions of 1 to 5 each clip has."""
    counts: dict[int, np.ndarray] = {}
    for row in rows:
        if not row.repeat:
            counts.setdefault(row.clip, np.zeros(_CLASSES, int))[row.value - 1] += 1
    return counts


def _opinions(rows: Iterable[RatingRow]) -> dict[int, dict[str, int]]:
    """First opinions, by clip and rater, of the clips that several people rated."""
    said: dict[int, dict[str, int]] = {}
    for row in rows:
        if not row.repeat:
            said.setdefault(row.clip, {})[row.rater] = row.value
    return {clip: opinions for clip, opinions in said.items() if len(opinions) > 1}


def _alpha_of(counts: Mapping[int, np.ndarray], clips: set[int]) -> float | None:
    units = np.array([counts[clip] for clip in clips if counts[clip].sum() > 1])
    return _alpha(units) if len(units) >= _LEAST_PART else None


def _alpha(units: np.ndarray) -> float | None:
    if (units.sum(axis=0) > 0).sum() < 2:  # one class alone: agreement cannot be told from habit
        return None
    return float(krippendorff.alpha(value_counts=units, level_of_measurement="ordinal"))
