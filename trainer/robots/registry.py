"""Robots by name: those that come with the program, a person's own, and gymnasium's environments."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from onedemo.errors import UserError
from onedemo.robots import ant, gymnasium_robot, half_cheetah, hopper, humanoid, library, swimmer, walker2d
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

_data_dir: Path | None = None


def use(data_dir: Path | None) -> None:
    """From now on a person's own robots are those of that data directory; each command says it once."""
    global _data_dir
    _data_dir = data_dir
    _named.cache_clear()


def robot_named(name: str) -> Robot:
    """The robot of that name.

    Raises:
        UserError: If there is none; the message lists those there are.
    """
    return _named(name)


def names() -> list[str]:
    """The robots there are, those that come with the program first."""
    own = library.robots_in(_data_dir) if _data_dir is not None else []
    return sorted(BUILT_IN) + [name for name, _ in own]


@lru_cache(maxsize=64)
def _named(name: str) -> Robot:
    if name in BUILT_IN:
        return BUILT_IN[name]()
    if name.startswith(gymnasium_robot.PREFIX):
        return gymnasium_robot.make(name)
    own = library.own_robot(name, _data_dir) if _data_dir is not None else None
    if own is None:
        raise UserError(
            f"unknown robot {name!r}; choose one of: {', '.join(names())}, or one of gymnasium's by its "
            f"number, as {gymnasium_robot.PREFIX}Walker2d-v5"
        )
    return own
