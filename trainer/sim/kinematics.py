"""The Hopper's body as a picture shows it: height, direction of each part, and how fast both change.

Shapes: "..." any batch shape, o = 11 observations, P = 9 numbers of a pose: the torso's height, and
sine and cosine of the directions of torso, thigh, leg and foot.
"""

from __future__ import annotations

import numpy as np

POSE = 9
HEIGHT_SCALE = 1.5
"""A metre of height counts as this many units of the pose, beside sines that reach from -1 to 1."""
MOTION_SCALE = 0.15
"""Seconds: motion is the change of the pose within this time, of the size of the pose itself."""
_MOTION_LIMIT = 12.0  # pose units per second


def pose(obs: np.ndarray) -> np.ndarray:
    """Height and directions of the parts.

    Args:
        obs: Observations, (..., o).

    Returns:
        (..., P).
    """
    return pose_of(obs[..., 0], directions(obs))


def motion(obs: np.ndarray) -> np.ndarray:
    """Change of the pose per ``MOTION_SCALE`` seconds, limited: (..., o) to (..., P)."""
    return motion_of(obs[..., 6], directions(obs), _summed(obs[..., 7:11]))


def pose_of(height: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """The pose of a height (...), metres, and directions of the parts (..., 4), radians: (..., P)."""
    waves = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    return np.concatenate([HEIGHT_SCALE * height[..., None], waves.reshape(*angles.shape[:-1], -1)], axis=-1)


def motion_of(climb: np.ndarray, angles: np.ndarray, spins: np.ndarray) -> np.ndarray:
    """The motion of a climb (...), m/s, and parts at ``angles`` (..., 4) that turn at ``spins``, rad/s."""
    waves = np.stack([np.cos(angles) * spins, -np.sin(angles) * spins], axis=-1)
    rates = [HEIGHT_SCALE * climb[..., None], waves.reshape(*angles.shape[:-1], -1)]
    return MOTION_SCALE * np.clip(np.concatenate(rates, axis=-1), -_MOTION_LIMIT, _MOTION_LIMIT)


def directions(obs: np.ndarray) -> np.ndarray:
    """Absolute directions of torso, thigh, leg and foot, radians: (..., o) to (..., 4)."""
    return _summed(obs[..., 1:5])


def _summed(joints: np.ndarray) -> np.ndarray:
    """From the torso outwards; the joints' axes point the other way than the torso's."""
    return joints[..., :1] - np.concatenate(
        [np.zeros_like(joints[..., :1]), np.cumsum(joints[..., 1:], axis=-1)], axis=-1
    )
