"""Humanoid: two legs, two arms, a waist. Defaults of gymnasium's Humanoid-v5, inertias and forces left out.

Humanoid-v5 also shows inertias, centre-of-mass velocities, actuator and contact forces, of the last stage of
its integrator: a state does not determine them, and here an observation is a function of the state.
"""

from __future__ import annotations

from onedemo.robots.robot import GYMNASIUM_ASSETS, Robot, Start, StockReward, Wild, build


def make() -> Robot:
    """The robot."""
    return build(
        "humanoid", GYMNASIUM_ASSETS / "humanoid.xml", frame_skip=5,
        feet=("right_foot", "left_foot"), start=Start(positions=1e-2, velocities=1e-2),
        wild=Wild(heights=(0.2, 2.0)),
        stock=StockReward(forward=1.25, healthy=5.0, control=0.1, healthy_height=(1.0, 2.0)),
    )  # fmt: skip
