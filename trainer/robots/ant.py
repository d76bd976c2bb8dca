"""Ant: four legs around a ball. Defaults of gymnasium's Ant-v5, contact forces left out.

Ant-v5 also shows contact forces, of the last stage of its integrator: a state does not determine them, and
here an observation is a function of the state.
"""

from __future__ import annotations

from onedemo.robots.robot import GYMNASIUM_ASSETS, Robot, Start, StockReward, Wild, build


def make() -> Robot:
    """The robot."""
    return build(
        "ant", GYMNASIUM_ASSETS / "ant.xml", frame_skip=5,
        start=Start(positions=0.1, velocities=0.1, normal=True), wild=Wild(heights=(0.2, 1.2)),
        stock=StockReward(healthy=1.0, control=0.5, healthy_height=(0.2, 1.0)),
    )  # fmt: skip
