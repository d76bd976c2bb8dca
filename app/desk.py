"""What happens when somebody rates: the rules of the Rate tab, without any page.

Every press names the clip that was on screen. A press that names another clip, or comes sooner
after the clip than anybody can judge (a held key), changes nothing. A rating is committed before the
desk moves on; if the commit fails the clip stays.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable

from app.assignment import Assignment
from trainer.records import Rater
from trainer.store import Store

GUARD_SECONDS = 0.3
"""A clip lasts about 0.3 s: a rating that comes sooner was not made for it."""


class Desk:
    """One rater at one page.

    Args:
        store: Where ratings go.
        run: The run whose clips are rated.
        rater: Who rates.
        assignment: Shared by all pages of the run.
        holder: Names this page to the assignment.
        clock: Seconds; replaced in tests.
    """

    def __init__(
        self,
        store: Store,
        run: str,
        rater: Rater,
        assignment: Assignment,
        holder: Hashable,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._run = run
        self._rater = rater
        self._assignment = assignment
        self._holder = holder
        self._clock = clock
        self._lock = threading.RLock()
        self._done: list[int] = []
        self._shown_at = 0.0
        self.current: int | None = None
        """The clip on screen, None while there is none."""
        self.upcoming: int | None = None
        """The clip after it, to be fetched ahead."""

    @property
    def can_undo(self) -> bool:
        """Whether there is a rating or a skip of this page to take back."""
        return bool(self._done)

    def refill(self) -> bool:
        """Looks for clips if none is on screen or none is at hand; returns whether anything changed."""
        with self._lock:
            before = self.current, self.upcoming
            if self.current is None:
                self._advance()
            else:
                self._look_ahead()
            return before != (self.current, self.upcoming)

    def rate(self, clip: int, value: int) -> bool:
        """Commits a rating of the clip that was on screen and moves on.

        Returns:
            False if the press counts for nothing.

        Raises:
            sqlite3.Error: If it could not be committed; the clip stays.
        """
        with self._lock:
            if not self._accepts(clip):
                return False
            self._store.rate(clip, self._rater.id, value, self._latency_ms())
            self._done.append(clip)
            self._advance()
            return True

    def skip(self, clip: int) -> bool:
        """As ``rate``, but without a rating."""
        with self._lock:
            if not self._accepts(clip):
                return False
            self._store.skip(clip, self._rater.id, self._latency_ms())
            self._done.append(clip)
            self._advance()
            return True

    def undo(self) -> bool:
        """Takes the last rating or skip of this page back and shows its clip again.

        Returns:
            False if there is none.

        Raises:
            sqlite3.Error: If it could not be committed.
        """
        with self._lock:
            if not self._done:
                return False
            clip = self._done[-1]
            self._store.undo(clip, self._rater.id)
            self._done.pop()
            self.upcoming = self.current or self.upcoming
            self._show(clip)
            return True

    def close(self) -> None:
        """Frees the clips this page held."""
        self._assignment.release(self._holder)

    def _accepts(self, clip: int) -> bool:
        return clip == self.current and self._clock() - self._shown_at >= GUARD_SECONDS

    def _latency_ms(self) -> int:
        return round(1000 * (self._clock() - self._shown_at))

    def _take(self, count: int) -> list[int]:
        waiting = [clip.id for clip in self._store.waiting_clips(self._run)]
        return self._assignment.take(self._holder, waiting, now=self._clock(), avoid=self._done, count=count)

    def _advance(self) -> None:
        clips = self._take(2)
        self.upcoming = clips[1] if len(clips) > 1 else None
        self._show(clips[0] if clips else None)

    def _look_ahead(self) -> None:
        if self.upcoming is None:
            others = [clip for clip in self._take(2) if clip != self.current]
            self.upcoming = others[0] if others else None

    def _show(self, clip: int | None) -> None:
        self.current = clip
        self._shown_at = self._clock()
        if clip is not None:
            self._assignment.hold(self._holder, clip, now=self._shown_at)
