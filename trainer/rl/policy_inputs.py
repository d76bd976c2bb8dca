"""What the policy sees: features of a state and of a demo time, before they are normalised.

Shapes: "..." any batch shape, o observations, f features, H demo steps (horizon), k features of a time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from onedemo.rl.settings import KINDS

HARMONICS = (1, 2, 4, 8, 16)


def policy_inputs(
    obs: np.ndarray,
    clock: np.ndarray,
    horizon: int,
    kind: str,
    table: np.ndarray | None = None,
    *,
    angles: Sequence[int] = (1,),
) -> np.ndarray:
    """Features of a state and a demo time, not normalised.

    Args:
        obs: Observations, (..., o).
        clock: Demo step of each, (...), 0 to horizon; later counts as horizon.
        horizon: Demo steps in an episode.
        kind: One of ``KINDS``.
        table: For "table": what to show at each demo step, (H, k).
        angles: Which observations are angles without end, ascending.

    Returns:
        Features, (..., f), float64: those of the state, then those of the time.

    Raises:
        ValueError: If the kind is unknown, or is "table" without one.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    state, time = state_features(obs, kind, angles), time_features(horizon, kind, table)
    if time is None:
        return state
    return np.concatenate([state, time[rows_of(clock, time)]], axis=-1)


def state_features(obs: np.ndarray, kind: str, angles: Sequence[int] = (1,)) -> np.ndarray:
    """Features of a state alone.

    An angle without end counts turns, so every kind but "raw" shows it as sine and cosine: the second
    flip then looks like the first.

    Args:
        obs: Observations, (..., o).
        kind: One of ``KINDS``.
        angles: Which observations are angles without end, ascending: of a hopper the torso's.

    Returns:
        (..., o) for "raw", else a number more for each of the angles, float64.
    """
    if kind == "raw":
        return np.asarray(obs, np.float64)
    pieces, after = [], 0
    for at in angles:
        angle = obs[..., at : at + 1]
        pieces += [obs[..., after:at], np.sin(angle), np.cos(angle)]
        after = at + 1
    return np.concatenate([*pieces, obs[..., after:]], axis=-1)


def time_features(horizon: int, kind: str, table: np.ndarray | None = None) -> np.ndarray | None:
    """Features of every demo step, one row each; None for kinds without time.

    Raises:
        ValueError: If the kind is "table" and there is none.
    """
    if kind == "clock":
        u = np.arange(horizon + 1)[:, None] / horizon
        phase = 2 * np.pi * u * np.asarray(HARMONICS)
        return np.concatenate([2 * u - 1, np.sin(phase), np.cos(phase)], axis=1)
    if kind == "table" and table is None:
        raise ValueError('kind "table" needs a table (horizon, k)')
    return table if kind == "table" else None


def rows_of(clock: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Rows of ``time_features`` for demo steps; what lies outside counts as the first or the last."""
    return np.clip(clock, 0, len(time) - 1)


def feature_size(obs_size: int, kind: str, table_width: int = 0, angles: int = 1) -> int:
    """How many features ``policy_inputs`` gives."""
    extra = {
        "clock": angles + 1 + 2 * len(HARMONICS),
        "table": angles + table_width,
        "pose": angles,
        "raw": 0,
    }
    return obs_size + extra[kind]
