"""How much one person, one address or one page may ask for: what is refused, the others keep.

Nothing here waits or locks: it is used by the one event loop of the front.
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

MOST_PAGES = 300
"""Open pages of all people together."""
MOST_PAGES_EACH = 20
"""Open pages of one person."""
MESSAGES_PER_S, MESSAGES_AT_ONCE = 120.0, 600
"""Of one page. Turning the robot in 3-D sends up to 60 a second."""
BYTES_PER_S, BYTES_AT_ONCE = 100_000.0, 1_000_000
"""Of one page; a press is 60 bytes, a camera 300."""
LARGEST_MESSAGE = 1 << 16
"""Bytes; what the page needs is a few hundred."""
WRONG_LINKS_PER_S, WRONG_LINKS_AT_ONCE = 1 / 6, 20
"""Of one sender: wrong links, and requests that no browser sends."""
STRANGERS_PER_S, STRANGERS_AT_ONCE = 20.0, 300
"""Requests of one sender that show no session. A class behind one address opens its links at once."""
PRESSES_PER_S, PRESSES_AT_ONCE = 20.0, 100
"""Of one person."""
PRESSES_WAITING, PRESSES_WAITING_EACH = 256, 4
"""Presses that are being carried out, of all people and of one."""
ACTIONS_WAITING = 4
"""Actions of researchers that are being carried out, one after the other."""
_MOST_KEYS = 10_000


class Bucket:
    """A token bucket: so much at once, so much a second.

    Args:
        per_s: What flows in, each second.
        at_once: What it holds; it begins full.
        clock: Seconds that only go forward.
    """

    def __init__(self, per_s: float, at_once: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._at_once, self._clock = per_s, at_once, clock
        self._left, self._at = float(at_once), clock()

    def take(self, amount: float = 1.0) -> bool:
        """Takes so much if it is there; whether it was."""
        now = self._clock()
        self._left = min(self._at_once, self._left + (now - self._at) * self._per_s)
        self._at = now
        if amount > self._left:
            return False
        self._left -= amount
        return True

    @property
    def empty(self) -> bool:
        """Whether nothing can be taken now; takes nothing."""
        return min(self._at_once, self._left + (self._clock() - self._at) * self._per_s) < 1


class Buckets:
    """A bucket for each key, such as an address. Of very many, those longest unused are forgotten."""

    def __init__(self, per_s: float, at_once: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._new = lambda: Bucket(per_s, at_once, clock)
        self._buckets: OrderedDict[str, Bucket] = OrderedDict()

    def __getitem__(self, key: str) -> Bucket:
        bucket = self._buckets.pop(key, None) or self._new()
        self._buckets[key] = bucket
        if len(self._buckets) > _MOST_KEYS:
            self._buckets.popitem(last=False)
        return bucket


class Places:
    """So many places in all, and so many for each.

    Args:
        most: In all.
        most_each: For one key.
    """

    def __init__(self, most: int, most_each: int) -> None:
        self._most, self._most_each = most, most_each
        self._taken: Counter[int] = Counter()

    @contextmanager
    def one(self, key: int) -> Iterator[bool]:
        """Takes a place while the block lasts; gives whether there was one."""
        free = self._taken.total() < self._most and self._taken[key] < self._most_each
        self._taken[key] += free
        try:
            yield free
        finally:
            self._taken[key] -= free
            self._taken += Counter()  # drops those with none
