"""The processor: how many cores there are, and who waits when they are short (computing, for the page)."""

from __future__ import annotations

import os
import sys
import threading

_STEPS = 10
"""On the scale of ``nice``: about a tenth of the time that a thread of the page would get beside it."""


def cores() -> int:
    """Cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def give_way(steps: int = _STEPS) -> None:
    """Lowers the priority of the calling thread, and of all threads that it starts from now on.

    So called before MuJoCo and torch make their pools. Only Linux has priorities of single threads;
    elsewhere nothing happens.

    Args:
        steps: How far, on the scale of ``nice``.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + steps)
