"""MuJoCo's own profiling, which costs a fifth of the physics' time and which nobody here reads.

MuJoCo asks a callback for the time at the start and end of each of its stages, hundreds of times in a
control step. The C library has none by default (``mjcb_time``, a documented global); the Python package
sets one, and its ``set_mjcb_time(None)`` leaves that in place. So the global itself is set, by ctypes.
Where it cannot be found nothing changes but the speed.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import mujoco


def switch_off() -> None:
    """No profiling in this process from now on. To be called before any thread steps physics."""
    callback, _ = _global()
    if callback is not None:
        callback.value = None


def switch_on() -> None:
    """Profiling as the Python package has it: for programs that onedemo is compared with."""
    callback, shipped = _global()
    if callback is not None:
        callback.value = shipped


@contextmanager
def as_shipped() -> Iterator[None]:
    """Profiling as the Python package has it, for a while."""
    switch_on()
    try:
        yield
    finally:
        switch_off()


@cache
def _global() -> tuple[ctypes.c_void_p | None, int | None]:
    """MuJoCo's global and the callback that it held at first; (None, None) where there is no such global."""
    package = Path(mujoco.__file__).parent
    for pattern in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll"):
        for library in sorted(package.glob(pattern)):
            try:
                callback = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mjcb_time")
            except (OSError, ValueError):
                continue
            return callback, callback.value
    return None, None
