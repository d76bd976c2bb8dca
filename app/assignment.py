"""Which clip next, and for whom. Pure: time and the list of waiting clips come from outside.

A clip is leased to one page at a time, so that two people do not spend their time on the same one.
A lease ends after two minutes without a sign of life, or when the page closes.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass, field

LEASE_SECONDS = 120.0


@dataclass(frozen=True, slots=True)
class Lease:
    """Whose a clip is, and until when."""

    holder: Hashable
    until: float
    """Seconds, on the caller's clock."""


def choose(
    waiting: Sequence[int],
    leases: dict[int, Lease],
    *,
    holder: Hashable,
    now: float,
    avoid: Collection[int] = (),
    count: int = 2,
) -> list[int]:
    """The clips for one page: those it holds already, then the oldest that are free.

    Args:
        waiting: Clips that nobody has rated, oldest first.
        leases: Who holds what.
        holder: The page that asks.
        now: Seconds, on the clock of the leases.
        avoid: Clips this rater has dealt with already.
        count: How many to return at most: the one on screen and those fetched ahead.

    Returns:
        Clip numbers; shorter than ``count`` if there are not enough.
    """
    free = [clip for clip in waiting if clip not in avoid]
    mine = [clip for clip in free if clip in leases and leases[clip].holder == holder]
    others = [clip for clip in free if clip not in leases or leases[clip].until <= now]
    return (mine + [clip for clip in others if clip not in mine])[:count]


@dataclass
class Assignment:
    """The leases of one run, safe to use from many threads."""

    lease_seconds: float = LEASE_SECONDS
    """How long a clip stays with a page that shows no sign of life, seconds."""
    _leases: dict[int, Lease] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def take(
        self,
        holder: Hashable,
        waiting: Sequence[int],
        *,
        now: float,
        avoid: Collection[int] = (),
        count: int = 2,
    ) -> list[int]:
        """Leases clips to a page and returns them, as ``choose``.

        A lease that the page has already runs on as it was, so an open page that nobody sits at
        does not keep a clip from others; what it held beyond the chosen ones lapses.
        """
        with self._lock:
            chosen = choose(waiting, self._leases, holder=holder, now=now, avoid=avoid, count=count)
            held = {clip: lease for clip, lease in self._leases.items() if lease.holder == holder}
            self._drop(holder)
            for clip in chosen:
                self._leases[clip] = held.get(clip) or Lease(holder, now + self.lease_seconds)
            return chosen

    def hold(self, holder: Hashable, clip: int, *, now: float) -> None:
        """Leases a clip to a page from now on, whoever held it: it is on that page's screen now."""
        with self._lock:
            self._leases[clip] = Lease(holder, now + self.lease_seconds)

    def release(self, holder: Hashable) -> None:
        """Frees all clips of a page that has closed."""
        with self._lock:
            self._drop(holder)

    def _drop(self, holder: Hashable) -> None:
        for clip in [clip for clip, lease in self._leases.items() if lease.holder == holder]:
            del self._leases[clip]
