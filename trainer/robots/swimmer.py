"""Swimmer: three links in a fluid, seen from above. Defaults of gymnasium's Swimmer-v5."""

from __future__ import annotations

from onedemo.robots.robot import GYMNASIUM_ASSETS, Robot, Start, StockReward, Wild, build


def make() -> Robot:
    """The robot."""
    return build(
        "swimmer", GYMNASIUM_ASSETS / "swimmer.xml", frame_skip=4,
        start=Start(positions=0.1, velocities=0.1), wild=Wild(heights=(-0.5, 0.5)),
        stock=StockReward(control=1e-4),
    )  # fmt: skip
