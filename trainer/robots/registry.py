"""Robots by name."""

from __future__ import annotations

from functools import lru_cache

from onedemo.errors import UserError
from onedemo.robots import ant, half_cheetah, hopper, humanoid, swimmer, walker2d
from onedemo.robots.robot import Robot

BUILT_IN = {
    "hopper": hopper.make,
    "walker2d": walker2d.make,
    "half-cheetah": half_cheetah.make,
    "swimmer": swimmer.make,
    "ant": ant.make,
    "humanoid": humanoid.make,
}
"""Robots that come with the program; each is read from its model when it is first asked for."""


DEFAULT = "hopper"
"""The robot where none is named."""


def names() -> list[str]:
    """The robots there are."""
    return sorted(BUILT_IN)


@lru_cache(maxsize=64)
def robot_named(name: str) -> Robot:
    """The robot of that name.

    Raises:
        UserError: If there is none; the message lists those there are.
    """
    if name not in BUILT_IN:
        raise UserError(f"unknown robot {name!r}; choose one of: {', '.join(sorted(BUILT_IN))}")
    return BUILT_IN[name]()
