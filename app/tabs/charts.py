"""Curves of a run, and of several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_TRUE_REWARD = "True reward (points; never trained on)"
_POINTS = 1500
"""A curve longer than this is thinned: a screen has no more columns."""


class Charts:
    """The three curves of one session.

    Args:
        gui: The client's.
        has_reward: Whether the demo's move has a hand-coded reward.
        dark: Whether the page is dark.
    """

    def __init__(self, gui: Any, *, has_reward: bool, dark: bool) -> None:
        self.last = 0
        """Newest iteration that is drawn."""
        self.rows: list[dict] = []
        """All iterations so far."""
        blue, teal, amber = ("#8ab0ff", "#5fd0b8", "#f0b661") if dark else ("#2f5dc4", "#0d8a72", "#b26a00")
        self._curves = [
            _Curve(gui, "predicted", "Predicted rating (1 to 5)", blue, dark, (1.0, 5.0)),
            _Curve(gui, "kl", "KL per policy step (nats)", teal, dark, None),
        ]
        if has_reward:
            self._curves.append(_Curve(gui, "true_reward", _TRUE_REWARD, amber, dark, None))

    def extend(self, rows: list[dict]) -> None:
        """Adds iterations to the curves."""
        if not rows:
            return
        self.rows += rows
        self.last = rows[-1]["number"]
        for curve in self._curves:
            curve.draw(self.rows)


class Comparison:
    """One figure of several runs over their control steps.

    Args:
        gui: The client's.
        key: Which figure of an iteration.
        title: Of the chart.
        dark: Whether the page is dark.
    """

    def __init__(self, gui: Any, key: str, title: str, *, dark: bool) -> None:
        self._key, self._limited = key, key == "predicted"
        self._colours = _DARK_SERIES if dark else _SERIES
        self._handle = gui.add_uplot(
            data=(np.array([0.0]), np.array([np.nan])),
            series=self._series([""]),
            legend={"show": True},
            **_plot(title, "control steps", dark, (1.0, 5.0) if self._limited else (0.0, 1.0)),
        )

    def draw(self, rows_of: Mapping[str, Sequence[dict]]) -> None:
        """Draws the curves of some runs, by name."""
        runs = list(rows_of) or [""]
        x, *curves = compared(rows_of, runs, self._key)
        if not self._limited:
            self._handle.scales = _scales(limits_of(np.concatenate(curves)))
        self._handle.series = self._series(runs)
        self._handle.data = (x, *curves)

    def _series(self, runs: Sequence[str]) -> tuple[dict[str, Any], ...]:
        lines = (
            _line(run, self._colours[k % len(self._colours)], points=False)
            # The second time round a colour is dashed.
            | ({"dash": [6, 4]} if k >= len(self._colours) else {})
            for k, run in enumerate(runs)
        )
        return {"label": "control steps"}, *lines


class _Curve:
    def __init__(
        self, gui: Any, key: str, title: str, colour: str, dark: bool, limits: tuple[float, float] | None
    ) -> None:
        self._key, self._limited = key, limits is not None
        self._handle = gui.add_uplot(
            data=(np.array([0.0]), np.array([np.nan])),
            series=({"label": "iteration"}, _line(title, colour, points=False)),
            legend={"show": False},
            **_plot(title, "iteration", dark, limits or (0.0, 1.0)),
        )

    def draw(self, rows: list[dict]) -> None:
        x, y = curve_points(rows, self._key)
        if not self._limited:
            self._handle.scales = _scales(limits_of(y))
        self._handle.data = (x, y)


_SERIES = ("#2f5dc4", "#b26a00", "#0d8a72", "#a23b8f", "#5b6472", "#c0392b")
_DARK_SERIES = ("#8ab0ff", "#f0b661", "#5fd0b8", "#e58fd4", "#aab4c2", "#ff9c94")


def _line(label: str, colour: str, *, points: bool) -> dict[str, Any]:
    return {"label": label, "stroke": colour, "width": 2, "points": {"show": points}, "spanGaps": True}


def limits_of(values: np.ndarray) -> tuple[float, float]:
    """Limits of an axis for values, (n,), nan where there is none: uPlot finds none if all are."""
    known = values[np.isfinite(values)]
    low, high = (known.min(), known.max()) if len(known) else (0.0, 1.0)
    margin = 0.05 * max(high - low, 0.1 * abs(high), 1e-9)
    return float(low - margin), float(high + margin)


def _scales(limits: tuple[float, float]) -> dict[str, Any]:
    return {"x": {"time": False}, "y": {"range": list(limits)}}


def _plot(title: str, along: str, dark: bool, limits: tuple[float, float]) -> dict[str, Any]:
    """What all charts look like."""
    ink = "#9ba7b7" if dark else "#566173"
    grid = {"stroke": "rgba(255,255,255,.06)" if dark else "#e9ecf1", "width": 1}
    axis = {"stroke": ink, "grid": grid, "ticks": {"show": False}, "font": "11px system-ui, sans-serif"}
    below = axis | {"size": 26, "label": along, "labelSize": 16, "labelFont": "11px system-ui, sans-serif"}
    return {
        "title": title, "scales": _scales(limits), "axes": (below, axis | {"size": 46}),
        "cursor": {"drag": {"x": True, "y": False}}, "height": 190, "padding": (10, 14, 0, 0),
    }  # fmt: skip


def compared(
    rows_of: Mapping[str, Sequence[dict]], runs: Sequence[str], key: str, most: int = _POINTS
) -> tuple[np.ndarray, ...]:
    """Curves of several runs over one axis.

    Args:
        rows_of: Iterations of the runs that are drawn, by name.
        runs: All runs, in the order of the curves.
        key: Which figure.
        most: Points of one curve at most.

    Returns:
        Control steps, ascending, (n,), and for each run its figure there, (n,): nan where it has none.
    """
    curves = {}
    for run, rows in rows_of.items():
        points = {row["env_steps"]: row[key] for row in rows if row.get(key) is not None}
        stride = max(1, -(-len(points) // most))
        curves[run] = dict(list(points.items())[::-1][::stride])
    x = np.array(sorted({step for curve in curves.values() for step in curve}) or [0], np.float64)
    return x, *[np.array([curves.get(run, {}).get(step, np.nan) for step in x], np.float64) for run in runs]


def curve_points(rows: list[dict], key: str, most: int = _POINTS) -> tuple[np.ndarray, np.ndarray]:
    """A curve over the iterations.

    Args:
        rows: Iterations in order.
        key: Which of their figures; iterations without it are left out.
        most: Points at most; beyond that every n-th is kept, and always the newest.

    Returns:
        Iteration numbers and values, of equal length, at least one (nan where there is nothing).
    """
    points = [(row["number"], row[key]) for row in rows if row.get(key) is not None]
    if not points:
        return np.array([0.0]), np.array([np.nan])
    stride = -(-len(points) // most)
    kept = points[::-1][::stride][::-1]
    x, y = zip(*kept, strict=True)
    return np.array(x, np.float64), np.array(y, np.float64)
