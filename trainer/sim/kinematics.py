"""The Hopper's body: joints, contact, and what a picture shows of it: height, directions and their rates.

Pure functions on arrays; no simulator runs here. Angles grow when the hopper leans forward.

Shapes: "..." any batch shape, o = 11 observations, q = 6 positions (x, z, angle of the torso, joints of
thigh, leg and foot), P = 9 numbers of a pose: the torso's height, and
sine and cosine of the directions of torso, thigh, leg and foot.
"""

from __future__ import annotations

import numpy as np

CONTACT_MARGIN = 0.002
"""Metres between a part and the ground at which MuJoCo's contact sets in: a part can lie on the
ground at rest without reaching it. Both geoms have a margin of 0.001 (hopper.xml); MuJoCo 4 adds
them up."""

# hopper.xml: length of each part along its own axis from joint to joint, metres.
_HALF_TORSO, _THIGH, _LEG = 0.2, 0.45, 0.5
_HEEL, _TOE = -0.13, 0.26  # ends of the foot, before and behind the ankle
_RADII = {"torso": 0.05, "thigh": 0.05, "leg": 0.04, "foot": 0.06}

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


def fallen(qpos: np.ndarray) -> np.ndarray:
    """Whether torso, thigh or leg touches the ground.

    Args:
        qpos: Positions, (..., q).

    Returns:
        True where one does, (...).
    """
    gaps = clearances(qpos)
    return np.minimum.reduce([gaps["torso"], gaps["thigh"], gaps["leg"]]) < CONTACT_MARGIN


def clearances(qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Distance of the ground from each part's capsule, negative inside it.

    Args:
        qpos: Positions, (..., q).

    Returns:
        Metres, (...), of "torso", "thigh", "leg" and "foot".
    """
    z = {name: point[..., 1] for name, point in joint_points(qpos).items()}
    ends = {
        "torso": (z["top"], z["hip"]),
        "thigh": (z["hip"], z["knee"]),
        "leg": (z["knee"], z["ankle"]),
        "foot": (z["heel"], z["toe"]),
    }
    return {part: np.minimum(a, b) - _RADII[part] for part, (a, b) in ends.items()}


def joint_points(qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Where the hopper's joints and ends are: forward kinematics in the plane.

    Args:
        qpos: Positions, (..., q).

    Returns:
        (x, z) in metres, (..., 2), of "top", "hip", "knee", "ankle", "heel" and "toe".
    """
    torso = qpos[..., 2]
    # Joint axes point the other way than the torso's, so joint angles are subtracted.
    thigh, leg, foot = (torso - qpos[..., 3 : 3 + n].sum(-1) for n in (1, 2, 3))
    centre = qpos[..., :2]
    hip = centre - _HALF_TORSO * _up(torso)
    knee = hip - _THIGH * _up(thigh)
    ankle = knee - _LEG * _up(leg)
    return {
        "top": centre + _HALF_TORSO * _up(torso),
        "hip": hip,
        "knee": knee,
        "ankle": ankle,
        "heel": ankle + _HEEL * _ahead(foot),
        "toe": ankle + _TOE * _ahead(foot),
    }


def _up(angle: np.ndarray) -> np.ndarray:
    """Unit vector (x, z) along a part that points up at angle 0."""
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def _ahead(angle: np.ndarray) -> np.ndarray:
    """Unit vector (x, z) along a part that points ahead at angle 0."""
    return np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
