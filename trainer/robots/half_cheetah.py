"""Half-cheetah: a torso on two legs that runs in a plane. Defaults of gymnasium's HalfCheetah-v5."""

from __future__ import annotations

from onedemo.robots.robot import GYMNASIUM_ASSETS, Robot, Start, StockReward, Wild, build


def make() -> Robot:
    """The robot."""
    return build(
        "half-cheetah", GYMNASIUM_ASSETS / "half_cheetah.xml", frame_skip=5, feet=("bfoot", "ffoot"),
        start=Start(positions=0.1, velocities=0.1, normal=True), wild=Wild(heights=(-0.6, 0.6)),
        stock=StockReward(control=0.1),
    )  # fmt: skip
