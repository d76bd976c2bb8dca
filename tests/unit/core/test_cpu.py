"""Computing gives way to the page."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from onedemo.core.cpu import give_way


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has priorities of threads")
def test_thread_and_those_it_starts_give_way_and_no_other():
    def nice() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    def work() -> None:
        seen.append(nice())
        give_way()
        seen.append(nice())
        child = threading.Thread(target=lambda: seen.append(nice()))
        child.start()
        child.join()

    seen: list[int] = []
    before = nice()
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen[0] == before < seen[1] == seen[2] and nice() == before
