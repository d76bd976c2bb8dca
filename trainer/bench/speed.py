"""``onedemo bench speed``: everything that is measured of speed, memory and waiting, part by part."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence

from trainer.bench.figures import Result, Skipped
from trainer.bench.physics import MISSING

PARTS = ("physics", "training", "sb3", "fitting", "pictures", "data", "product", "warp")
"""Modules of ``trainer.bench``; each has ``measure(quick) -> list[Result]``."""


def measure(
    *, quick: bool, parts: Sequence[str] = PARTS, tell: Callable[[str], None] = lambda _: None
) -> list[Result]:
    """Measures all parts, one after the other, so that none disturbs another.

    A part that fails is reported as skipped with its error, and the others go on: hours of measuring
    are not lost to the last of them.

    Args:
        quick: Few repetitions and small sizes: under 2 minutes in all, and a wide spread.
        parts: Some of ``PARTS``.
        tell: Is told what is being measured.

    Returns:
        The results of all parts, in order.
    """
    results: list[Result] = []
    for part in parts:
        began = time.monotonic()
        try:
            results += importlib.import_module(f"trainer.bench.{part}").measure(quick)
        except ImportError as error:
            results.append(Skipped(name=part, reason=MISSING.format(error.name)))
        except Exception as error:
            results.append(Skipped(name=part, reason=f"it failed: {type(error).__name__}: {error}"))
        tell(f"{part}: {time.monotonic() - began:.0f} s")
    return results
