"""Who waits for whom when the processor is short: computing gives way to the page."""

from __future__ import annotations

import os
import sys
import threading

_STEPS = 10
"""On the scale of ``nice``: about a tenth of the time that a thread of the page would get beside it."""


def give_way() -> None:
    """Lowers the priority of the calling thread, and of all threads that it starts from now on.

    So called before MuJoCo and torch make their pools. Only Linux has priorities of single threads;
    elsewhere nothing happens.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + _STEPS)
