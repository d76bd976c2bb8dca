"""Statistics over seeds. A seed without a result is kept as None, and counted, never dropped."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from onedemo.experiments.report.blocks import Line, number
from onedemo.experiments.runner import Outcome


@dataclass(frozen=True, kw_only=True, slots=True)
class Spread:
    """One figure over seeds. Statistics are of the seeds that have one; nan where none has."""

    values: tuple[float | None, ...]
    """Of each seed; None where there is no result."""
    mean: float
    deviation: float
    """Standard deviation of the sample (n - 1); 0 with one seed."""
    low: float
    high: float

    @property
    def missing(self) -> int:
        """Seeds without a figure."""
        return sum(value is None for value in self.values)

    def count(self, least: float) -> int:
        """Seeds whose figure is at least so much; one without a result does not count."""
        return sum(value is not None and value >= least for value in self.values)

    def __str__(self) -> str:
        """Mean ± deviation and how many seeds are missing; "not run" if all are."""
        seeds = len(self.values)
        if self.missing == seeds:
            return "not run"
        text = number(self.mean) if seeds == 1 else f"{number(self.mean)} ± {number(self.deviation)}"
        return f"{text} ({seeds - self.missing} of {seeds} seeds)" if self.missing else text

    @property
    def each(self) -> str:
        """The figure of each seed in order, a dash where there is none."""
        return ", ".join("–" if value is None else number(value) for value in self.values)


def spread(outcomes: Sequence[Outcome], figure: Callable[[Mapping[str, Any]], float | None]) -> Spread:
    """One figure over the seeds of one experiment.

    Args:
        outcomes: One for each seed.
        figure: Picks it from a result; None if the result has none.
    """
    return spread_of([None if o.result is None else figure(o.result) for o in outcomes])


def spread_of(values: Sequence[float | None]) -> Spread:
    """The same from the figures themselves."""
    there = np.array([value for value in values if value is not None], np.float64)
    mean, low, high = (float(f(there)) if there.size else np.nan for f in (np.mean, np.min, np.max))
    deviation = float(np.std(there, ddof=1)) if there.size > 1 else 0.0 if there.size else np.nan
    return Spread(
        values=tuple(None if value is None else float(value) for value in values),
        mean=mean, deviation=deviation, low=low, high=high,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Band:
    """Curves of S seeds on one grid of P points."""

    x: np.ndarray
    """(P,), where all curves have values."""
    lines: np.ndarray
    """(S, P)"""

    @property
    def mean(self) -> np.ndarray:
        """Over seeds, (P,)."""
        return self.lines.mean(axis=0)

    def line(self, label: str, **style: Any) -> Line:
        """As a line of a chart: the mean, a band from the least to the most of the seeds, and each seed."""
        return Line(
            label=label, x=self.x, y=self.mean, low=self.lines.min(axis=0), high=self.lines.max(axis=0),
            each=self.lines, **style,
        )  # fmt: skip


def band(curves: Sequence[tuple[Sequence[float], Sequence[float | None]]], points: int = 200) -> Band:
    """Curves of several seeds, interpolated linearly onto one grid over the range that all of them have.

    Args:
        curves: x (ascending, such as environment steps) and y of each seed; None is left out.
        points: Of the grid.

    Raises:
        ValueError: If there is no curve, one is empty, or they have no common range.
    """
    kept = []
    for x, y in curves:
        pairs = [(a, b) for a, b in zip(x, y, strict=True) if b is not None]
        kept.append(np.array(pairs, np.float64).reshape(-1, 2).T)
    if not kept or any(curve.shape[1] == 0 for curve in kept):
        raise ValueError(f"no points in {'one' if kept else 'any'} of {len(kept)} curves")
    first, last = max(curve[0, 0] for curve in kept), min(curve[0, -1] for curve in kept)
    if first > last:
        raise ValueError(f"the curves have no common range: one begins at {first:g}, one ends at {last:g}")
    grid = np.linspace(first, last, points)
    return Band(x=grid, lines=np.array([np.interp(grid, *curve) for curve in kept]))
