"""Locks between processes: who comes second is refused, or waits."""

import threading
import time

import pytest

from onedemo.core.files import hold
from onedemo.errors import UserError


def test_a_lock_that_is_held_is_refused_or_waited_for(tmp_path):
    lock, order = tmp_path / "deep" / "lock", []

    def second():
        with hold(lock, wait=True):
            order.append("second")

    with hold(lock):
        with pytest.raises(UserError, match="another onedemo is working on"), hold(lock):
            pass
        waiting = threading.Thread(target=second)
        waiting.start()
        time.sleep(0.2)
        order.append("first")
    waiting.join(10)
    assert order == ["first", "second"]
    with hold(lock):
        pass
