"""``onedemo bench speed``: everything that is measured of speed, memory and waiting, part by part."""

from __future__ import annotations

import importlib
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

from onedemo.experiments.speed.figures import Result, Skipped
from onedemo.experiments.speed.physics import MISSING
from onedemo.sim import physics_profiling

PARTS = ("physics", "training", "sb3", "fitting", "pictures", "warp")
"""Modules of ``onedemo.experiments.speed``; each has ``measure(quick) -> list[Result]``. A dotted name
stands for any module that has: those of the server are in ``tests/load``."""


_PEERS = ("sb3_contrib", "stable_baselines3")
log = logging.getLogger("onedemo")


def find_part(name: str) -> Any:
    """The module of a part."""
    return importlib.import_module(name if "." in name else f"onedemo.experiments.speed.{name}")


def measure(
    *, quick: bool, parts: Sequence[str] = PARTS, tell: Callable[[str], None] = lambda _: None
) -> list[Result]:
    """Measures all parts, one after the other, so that none disturbs another.

    A part that fails is logged and reported with its error, and the others go on: hours of measuring
    are not lost to the last of them.

    Args:
        quick: Few repetitions and small sizes: under 2 minutes in all, and a wide spread.
        parts: Some of ``PARTS``, or dotted names of modules.
        tell: Is told what is being measured.

    Returns:
        The results of all parts, in order.
    """
    physics_profiling.switch_off()  # on both sides, but where "as shipped" is said
    results: list[Result] = []
    for part in parts:
        began = time.monotonic()
        try:
            results += find_part(part).measure(quick)
        except Exception as error:
            if isinstance(error, ImportError) and (error.name or "").split(".")[0] in _PEERS:
                results.append(Skipped(name=part, reason=MISSING.format(error.name)))
            else:
                log.exception("bench speed: part %s failed", part)
                results.append(Skipped(name=part, reason=f"{type(error).__name__}: {error}", failed=True))
        tell(f"{part}: {time.monotonic() - began:.0f} s")
    return results
