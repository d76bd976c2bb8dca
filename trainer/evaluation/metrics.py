"""What a move was worth, from stored positions: net turns, clean turns, landings.

Pure functions on arrays. The torso angle grows when the hopper leans forward, so a backflip turns it by
-2 pi.

Shapes: T states along the last time axis, "..." any lanes before it, q = 6 positions.
"""

from __future__ import annotations

import numpy as np

from onedemo.robots.hopper import CONTACT_MARGIN, clearances, fallen

LANDED_LEAN = 0.5
"""Radians, 29 degrees: a torso no further from upright stands."""
LANDED_WITHIN_S = 0.5
"""Seconds after a turn by which the robot must stand."""
LANDED_FOR_S = 0.2
"""Seconds that it must stand: a robot that rolls on at a turn a second is upright for 0.16 s."""


def net_turns(torso_angle: np.ndarray) -> np.ndarray:
    """Backward turns from the first state to the last, forward turns counted against them.

    Rounded towards zero: a slight forward lean must not read as -1.

    Args:
        torso_angle: Radians, (..., T); wrapped angles are unwrapped.

    Returns:
        Whole turns, (...), int.
    """
    angle = np.unwrap(torso_angle, axis=-1)
    return np.trunc((angle[..., 0] - angle[..., -1]) / (2 * np.pi)).astype(int)


def turned(torso_angle: np.ndarray) -> np.ndarray:
    """Backward rotation from the first state to the last in turns, (..., T) radians to (...), not rounded."""
    angle = np.unwrap(torso_angle, axis=-1)
    return (angle[..., 0] - angle[..., -1]) / (2 * np.pi)


def farthest_turn(torso_angle: np.ndarray) -> np.ndarray:
    """The farthest backward rotation between any two states in order, turns: (..., T) radians to (...).

    A flip that starts from a forward lean, or after which the robot falls on its face, is seen whole.
    """
    angle = np.unwrap(torso_angle, axis=-1)
    return (np.maximum.accumulate(angle, axis=-1) - angle).max(axis=-1) / (2 * np.pi)


def clean_turns(qpos: np.ndarray) -> np.ndarray:
    """Backward turns made without any part but the foot touching the ground.

    Over each longest stretch of time in which nothing but the foot touches the ground, the net
    backward rotation is rounded towards zero to whole turns; the stretches are summed. Rolling
    over the torso therefore counts nothing, however fast.

    Args:
        qpos: Positions, (..., T, q).

    Returns:
        Whole turns, (...), int.
    """
    lanes = qpos.reshape(-1, *qpos.shape[-2:])
    turns = [_clean_turns(q[:, 2], ~touch) for q, touch in zip(lanes, fallen(lanes), strict=True)]
    return np.array(turns, int).reshape(qpos.shape[:-2])


def landings(qpos: np.ndarray, dt: float) -> np.ndarray:
    """Backward turns after which the robot stands.

    A turn is over when the torso first comes within ``LANDED_LEAN`` of the upright after it. It is landed
    if within ``LANDED_WITHIN_S`` the robot stands on its foot alone, and stays so for ``LANDED_FOR_S``:
    the torso within ``LANDED_LEAN`` of *that* upright, neither torso nor thigh nor leg on the ground,
    and the foot on it at the beginning. How the turn was made does not matter: see ``clean_turns``.

    Args:
        qpos: Positions, (..., T, q), the first of them about upright.
        dt: Seconds between them.

    Returns:
        Turns landed, (...), int; each counts once.
    """
    lanes = qpos.reshape(-1, *qpos.shape[-2:])
    grounded = clearances(lanes)["foot"] < CONTACT_MARGIN
    within, stay = round(LANDED_WITHIN_S / dt), round(LANDED_FOR_S / dt)
    landed = [
        _landings(np.unwrap(q[:, 2]), on_foot, touch, within, stay)
        for q, on_foot, touch in zip(lanes, grounded, fallen(lanes), strict=True)
    ]
    return np.array(landed, int).reshape(qpos.shape[:-2])


def _clean_turns(angle_T: np.ndarray, clean_T: np.ndarray) -> int:
    edges = np.diff(np.concatenate([[False], clean_T, [False]]).astype(int))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    angle_T = np.unwrap(angle_T)
    return int(np.trunc((angle_T[first] - angle_T[last]) / (2 * np.pi)).sum())


def _landings(
    angle_T: np.ndarray, on_foot_T: np.ndarray, fallen_T: np.ndarray, within: int, stay: int
) -> int:
    landed, turn = 0, 1
    while (over_T := angle_T <= LANDED_LEAN - 2 * np.pi * turn).any():
        first = int(over_T.argmax())
        upright_T = (np.abs(angle_T + 2 * np.pi * turn) <= LANDED_LEAN) & ~fallen_T
        tries = [t for t in range(first, first + within + 1) if t + stay <= len(angle_T)]
        landed += any(on_foot_T[t] and upright_T[t : t + stay].all() for t in tries)
        turn += 1
    return landed
