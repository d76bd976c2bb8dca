"""Laying an episode along a demo: dynamic time warping.

A robot that is a tenth of a second late is not unlike the demo, only late. The path that costs least
says which moment of the episode goes with which moment of the demo.

Shapes: N episodes, F moments of the demo, E moments of an episode.
"""

from __future__ import annotations

import numpy as np

_MOVES = 4
"""An episode moves on by 0 to 3 moments for each of the demo's."""


def align(costs: np.ndarray, band: int) -> np.ndarray:
    """The moments of episodes that go with each moment of the demo, at the least total cost.

    Dynamic time warping in its one-sided form, so that every moment of the demo counts once, within a
    band about real time (Sakoe and Chiba 1978).

    Args:
        costs: Of each pair of moments, (N, F, E); E at least F - band.
        band: Moments by which the two may be apart.

    Returns:
        (N, F), ascending in F, int.

    Raises:
        ValueError: If the episodes are too short for the band.
    """
    episodes, moments, length = costs.shape
    if length < moments - band:
        raise ValueError(f"an episode of {length} moments cannot follow {moments} within {band}")
    apart = np.abs(np.arange(moments)[:, None] - np.arange(length)) > band
    costs = np.where(apart, np.inf, costs)
    total = costs[:, 0]
    moved = np.zeros((moments, episodes, length), np.int8)
    for f in range(1, moments):
        # before[m, n, e]: the least cost of being at e - m one moment of the demo ago
        before = np.full((_MOVES, episodes, length), np.inf)
        for m in range(min(_MOVES, length)):
            before[m, :, m:] = total[:, : length - m]
        moved[f] = before.argmin(axis=0)
        total = costs[:, f] + before.min(axis=0)
    path = np.empty((episodes, moments), int)
    path[:, -1] = total.argmin(axis=-1)
    for f in range(moments - 1, 0, -1):
        path[:, f - 1] = path[:, f] - moved[f, np.arange(episodes), path[:, f]]
    return path
