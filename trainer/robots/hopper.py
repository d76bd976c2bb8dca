"""Hopper: one leg that hops in a plane. All defaults are those of gymnasium's Hopper-v5.

Shapes: "..." any batch shape, q = 6 positions (x, z, angle of the torso, joints of thigh, leg and foot).
Angles grow when the hopper leans forward.
"""

from __future__ import annotations

import numpy as np

from onedemo.robots.robot import CONTACT_MARGIN, GYMNASIUM_ASSETS, Camera, Robot, StockReward, Wild, build

# hopper.xml: length of each part along its own axis from joint to joint, metres.
_HALF_TORSO, _THIGH, _LEG = 0.2, 0.45, 0.5
_HEEL, _TOE = -0.13, 0.26  # ends of the foot, before and behind the ankle
_RADII = {"torso": 0.05, "thigh": 0.05, "leg": 0.04, "foot": 0.06}


def make() -> Robot:
    """The robot."""
    return build(
        "hopper", GYMNASIUM_ASSETS / "hopper.xml", frame_skip=4, velocity_limit=10.0, feet=("foot",),
        camera=Camera(distance=3.0, height=0.88),
        # Joint ranges of the model, whose stops are soft.
        wild=Wild(
            heights=(0.05, 1.9), joints=((-2.6, 0.05), (-2.6, 0.05), (-0.78, 0.78)),
            speeds=(1.5, 2.0, 6.0, 4.0, 4.0, 4.0),
        ),
        stock=StockReward(
            healthy=1.0, control=1e-3, healthy_height=(0.7, float("inf")), healthy_angle=(-0.2, 0.2),
            healthy_state=100.0,
        ),
    )  # fmt: skip


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
