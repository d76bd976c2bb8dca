"""Curves of a run, and its ratings by class."""

from __future__ import annotations

from typing import Any

import numpy as np

from app.words import ANSWERS

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
        self._rows: list[dict] = []
        blue, teal, amber = ("#8ab0ff", "#5fd0b8", "#f0b661") if dark else ("#2f5dc4", "#0d8a72", "#b26a00")
        self._curves = [
            _Curve(gui, "predicted", "Predicted rating", blue, dark, (1.0, 5.0)),
            _Curve(gui, "kl", "KL per policy step (nats)", teal, dark, None),
        ]
        if has_reward:
            self._curves.append(
                _Curve(gui, "true_reward", "True reward (never trained on)", amber, dark, None)
            )

    def extend(self, rows: list[dict]) -> None:
        """Adds iterations to the curves."""
        if not rows:
            return
        self._rows += rows
        self.last = rows[-1]["number"]
        for curve in self._curves:
            curve.draw(self._rows)


class _Curve:
    def __init__(
        self, gui: Any, key: str, title: str, colour: str, dark: bool, limits: tuple[float, float] | None
    ) -> None:
        self._key = key
        ink = "#9ba7b7" if dark else "#566173"
        grid = {"stroke": "rgba(255,255,255,.06)" if dark else "#e9ecf1", "width": 1}
        axis = {"stroke": ink, "grid": grid, "ticks": {"show": False}, "font": "11px system-ui, sans-serif"}
        scales: dict[str, Any] = {"x": {"time": False}}
        if limits:
            scales["y"] = {"range": list(limits)}
        self._handle = gui.add_uplot(
            data=(np.array([0.0]), np.array([np.nan])),
            series=(
                {"label": "iteration"},
                {"label": title, "stroke": colour, "width": 2, "points": {"show": False}, "spanGaps": True},
            ),
            title=title,
            scales=scales,
            axes=(axis | {"size": 30}, axis | {"size": 46}),
            legend={"show": False},
            cursor={"drag": {"x": True, "y": False}},
            height=190,
            padding=(10, 14, 0, 0),
        )

    def draw(self, rows: list[dict]) -> None:
        x, y = curve_points(rows, self._key)
        self._handle.data = (x, y)


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


def classes_html(counts: list[int]) -> str:
    """Ratings by class as bars."""
    most = max(1, *counts)
    total = sum(counts)
    rows = "".join(
        f'<li><span><b>{value}</b> {answer}</span><i><i style="width:{100 * count / most:.1f}%"></i></i>'
        f"<em>{count}</em></li>"
        for value, (answer, count) in enumerate(zip(ANSWERS, counts, strict=True), start=1)
    )
    heading = f"<h3>Ratings by class <small>{total} in all</small></h3>"
    return f'<section class="od-classes">{heading}<ul>{rows}</ul></section>'
