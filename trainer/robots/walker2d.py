"""Walker2d: two legs in a plane. All defaults are those of gymnasium's Walker2d-v5."""

from __future__ import annotations

from onedemo.robots.robot import GYMNASIUM_ASSETS, Robot, StockReward, Wild, build


def make() -> Robot:
    """The robot."""
    return build(
        "walker2d", GYMNASIUM_ASSETS / "walker2d_v5.xml", frame_skip=4, velocity_limit=10.0,
        feet=("foot", "foot_left"), wild=Wild(heights=(0.05, 1.9)),
        stock=StockReward(healthy=1.0, control=1e-3, healthy_height=(0.8, 2.0), healthy_angle=(-1.0, 1.0)),
    )  # fmt: skip
