"""A program that was told to end does, whatever its threads are doing."""

from __future__ import annotations

import subprocess
import sys
import time

_STUCK = """
import threading, time
from concurrent.futures import ThreadPoolExecutor
from onedemo.core.process import end_within
ThreadPoolExecutor().submit(time.sleep, 600)
threading.Thread(target=time.sleep, args=(600,)).start()
print("told to end")
end_within(0.2)
"""


def test_a_program_ends_in_time_whatever_its_threads_do():
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-c", _STUCK], capture_output=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, b"told to end\n")
    assert time.monotonic() - began < 60
