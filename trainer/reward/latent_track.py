"""A demo's track that nobody can see, as a function of how its frames look: to be fitted to ratings.

Without a model of the robot's looks, or where the demo shows another body, only the ratings say which
pose of the robot a frame is like. Each rating is a distance to one known motion of the robot; many of
them locate the frame among the robot's poses, as distances to masts locate a receiver. Frames that look
alike, or follow each other, are taken to be alike: the track is a Gaussian process over the demo's frames
(Rasmussen and Williams 2006, section 2.1, in its weight-space view), and its motion is its own change.

Shapes: F demo frames, R basis functions, A axes and K ends that are compared, P = 1 + 2 A + 2 K numbers of a
pose, B = 2 P with the motion.
"""

from __future__ import annotations

import numpy as np
import torch

from onedemo.reward.model import visual_inputs
from onedemo.sim.kinematics import MOTION_SCALE, Body

_DIMS = 8
"""Principal components of the frame features that say how alike two frames look."""
_LOOK_SCALE = 1.5
"""Length scale of the kernel on looks, in deviations of the first component."""
_CHANGE_WEIGHT = 0.7
"""Weight of how looks change, beside how they are."""
_TIME_SECONDS = 0.1
"""Length scale of the kernel on time."""
_TIME_SHARE = 0.5
"""Of its variance, beside that of looks."""
_BASIS = 40
_SMOOTH = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9
_AROUND = 2
"""Frames before and after over which a motion is taken."""
_HEIGHT = 1.0
"""Pose units (``kinematics.HEIGHT_SCALE``) about which heights vary."""
_SOFT = 0.05
"""Sines and cosines lie within a circle, on it unless both are small."""


def track_basis(features: np.ndarray, fps: float) -> np.ndarray:
    """Functions of a demo's frames, of which tracks are sums: eigenvectors of a kernel, and a constant.

    Args:
        features: Frame features, (F, D).
        fps: Frames per second.

    Returns:
        (F, R + 1), float32. With standard normal weights their sums have the kernel's covariance.
    """
    looks = visual_inputs(features, _DIMS).astype(np.float64)
    reach = len(_SMOOTH) // 2
    padded = np.pad(looks, ((reach, reach), (0, 0)), "edge")
    looks = np.sum([w * padded[i : i + len(looks)] for i, w in enumerate(_SMOOTH)], axis=0)
    wide = np.pad(looks, ((3, 3), (0, 0)), "edge")
    points = np.concatenate([looks, _CHANGE_WEIGHT * (wide[6:] - wide[:-6])], axis=1) / _LOOK_SCALE
    times = np.arange(len(looks))[:, None] / fps / _TIME_SECONDS
    kernel = _gaussian(points) + _TIME_SHARE * _gaussian(times)
    squares, vectors = np.linalg.eigh(kernel)
    basis = vectors[:, -_BASIS:] * np.sqrt(np.maximum(squares[-_BASIS:], 0.0))
    return np.concatenate([basis, np.ones((len(basis), 1))], axis=1).astype(np.float32)


def track_of(basis: torch.Tensor, weights: torch.Tensor, fps: float, body: Body) -> torch.Tensor:
    """Pose and motion at each frame, (F, B), from a basis (F, R + 1) and weights (R + 1, P)."""
    free = basis @ weights
    axes = 1 + 2 * len(body.weights)
    waves = free[:, 1:axes].reshape(len(free), -1, 2)
    # Seen from the side an axis in space is as long as it is turned away; one in the plane is whole.
    waves = waves / (waves.square().sum(-1, keepdim=True) + (_SOFT if body.planar else 1.0)).sqrt()
    poses = torch.cat([free[:, :1] + _HEIGHT, waves.reshape(len(free), -1), free[:, axes:]], dim=1)
    frames = torch.arange(len(poses))
    before, after = (frames - _AROUND).clamp(min=0), (frames + _AROUND).clamp(max=len(poses) - 1)
    seconds = ((after - before).clamp(min=1) / fps)[:, None]
    return torch.cat([poses, MOTION_SCALE * (poses[after] - poses[before]) / seconds], dim=1)


def _gaussian(points: np.ndarray) -> np.ndarray:
    """Gaussian kernel of points (F, d) in length scales: (F, F)."""
    squares = np.square(points).sum(axis=1)
    return np.exp(-0.5 * np.maximum(squares[:, None] + squares - 2 * points @ points.T, 0.0))
