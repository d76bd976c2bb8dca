"""The curves of a run as the page draws them: columns of its iterations, what happened between, levels.

Pure but for reading the store. Figures that only grow smooth over many ratings (how right the predictor is
about ratings that it has not seen) are taken over the newest ``WINDOW`` of them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from onedemo.storage.store import Store

POINTS = 1500
"""A curve longer than this is thinned: a screen has no more columns."""
WINDOW = 50
"""Ratings over which accuracy and agreement are taken."""
LEAST = 10
"""Ratings without which there is no such figure."""
STORED = (
    "number", "env_steps", "snapshot", "predicted", "reference", "true_reward", "best", "kl", "std",
    "disagreement", "episode_seconds", "seconds_rollouts", "seconds_policy", "seconds_refit",
    "seconds_other",
)  # fmt: skip
"""Columns that are stored with each iteration."""
WORKED_OUT = ("agreement", "error", "accuracy", "confidence")
"""Columns that are worked out from ratings: ``agreements`` and ``accuracies``."""

T = TypeVar("T")


def curves(store: Store, run: str, after: int = 0) -> dict[str, Any]:
    """What the page needs of one run, for JSON.

    Args:
        store: Where it is.
        run: Its name.
        after: Number of the last iteration that the page has.

    Returns:
        ``last``, number of the newest iteration; ``columns``, lists of equal length of the iterations after
        ``after``, thinned to ``POINTS``, None where there is no value; ``marks``, what happened in between,
        [iteration it came after, kind, rater].
    """
    rows = thinned(store.runs.dated_iterations(run, after), POINTS)
    found: list[dict[str, Any]] = []
    if rows:
        agreed = agreements(store.runs.forecasts(run), [at for at, _ in rows])
        right = accuracies(store.runs.snapshots(run), [row["snapshot"] for _, row in rows])
        found = [_flat(row) | a | r for (_, row), a, r in zip(rows, agreed, right, strict=True)]
    return {
        "last": rows[-1][1]["number"] if rows else after,
        "columns": {name: [_plain(row.get(name)) for row in found] for name in (*STORED, *WORKED_OUT)},
        "marks": [list(mark) for mark in store.runs.marks(run)],
    }


def thinned(rows: Sequence[T], most: int) -> list[T]:
    """Every n-th row, and always the newest, so that there are no more than ``most``."""
    stride = max(1, -(-len(rows) // most))
    return list(rows[::-1][::stride][::-1])


def agreements(
    forecasts: Sequence[tuple[str, int, float]], times: Sequence[str]
) -> list[dict[str, float | None]]:
    """How like the ratings are what was predicted of them before.

    Args:
        forecasts: (time, rating, predicted rating), in order.
        times: When each iteration was recorded, in order.

    Returns:
        For each, over the newest ``WINDOW`` ratings by then: ``agreement``, the correlation of both, and
        ``error``, the mean distance between them in points; None where there are fewer than ``LEAST``, or
        where all are alike.
    """
    given = np.array([value for _, value, _ in forecasts], np.float64)
    predicted = np.array([value for _, _, value in forecasts], np.float64)
    known = [at for at, _, _ in forecasts]
    told: list[dict[str, float | None]] = []
    for at in times:
        stop = bisect_right(known, at)
        start = max(0, stop - WINDOW)
        if stop - start < LEAST:
            told.append({"agreement": None, "error": None})
            continue
        x, y = given[start:stop], predicted[start:stop]
        alike = x.std() < 1e-9 or y.std() < 1e-9
        told.append(
            {
                "agreement": None if alike else float(np.corrcoef(x, y)[0, 1]),
                "error": float(np.abs(x - y).mean()),
            }
        )
    return told


def accuracies(snapshots: Sequence[dict], numbers: Sequence[int]) -> list[dict[str, float | None]]:
    """How often the most probable rating was the one then given, and how sure the predictor was of it.

    Args:
        snapshots: Of a run, in order, with the sums of ``Learner.forecast`` where there are any.
        numbers: The snapshot that scored each iteration.

    Returns:
        For each, over the newest snapshots up to it with ``WINDOW`` new ratings between them: ``accuracy``
        and ``confidence``, 0..1; None where there are fewer than ``LEAST``. If they are alike, the
        predictor is calibrated.
    """
    sums = np.cumsum(
        [[0.0, 0.0, 0.0], *([s.get(k, 0) for k in ("new", "hits", "confidence")] for s in snapshots)], axis=0
    )
    known = [snapshot["number"] for snapshot in snapshots]
    told: list[dict[str, float | None]] = []
    for number in numbers:
        stop = bisect_right(known, number)
        start = max(0, int(np.searchsorted(sums[:, 0], sums[stop, 0] - WINDOW, side="right")) - 1)
        new, hits, confidence = (float(x) for x in sums[stop] - sums[start])
        enough = new >= LEAST
        told.append(
            {"accuracy": hits / new if enough else None, "confidence": confidence / new if enough else None}
        )
    return told


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    return row | {f"seconds_{part}": seconds for part, seconds in row.get("seconds", {}).items()}


def _plain(value: Any) -> float | int | None:
    """A number as JSON has it, with five digits; None for what is none."""
    if value is None or isinstance(value, int):
        return value
    return float(f"{value:.5g}") if math.isfinite(value) else None
