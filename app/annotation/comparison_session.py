"""What happens when somebody compares: the rules of the Compare tab, without any page.

As ``onedemo.app.annotation.rating_session``.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Hashable

from onedemo.app.annotation.assignment import Assignment, Seat
from onedemo.app.annotation.rating_session import GUARD_SECONDS, AnsweredElsewhere
from onedemo.storage.rating_records import AlreadyAnswered
from onedemo.storage.store import Store
from onedemo.types import Rater

log = logging.getLogger("onedemo.page")


class ComparisonSession:
    """One rater before pairs.

    Args:
        store: Where answers go.
        run: The run whose pairs are compared.
        rater: Who compares.
        assignment: Shared by all pages of the run; of pairs alone.
        holder: Names this page to the assignment.
        guard_seconds: A press that comes sooner after the pair was not made for it.
        clock: Seconds; replaced in tests.
    """

    def __init__(
        self, store: Store, run: str, rater: Rater, assignment: Assignment, holder: Hashable, *,
        guard_seconds: float = GUARD_SECONDS, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._store, self._run, self._rater = store, run, rater
        self._assignment, self._guard_seconds, self._clock = assignment, guard_seconds, clock
        self._holder = Seat(rater.id, holder)
        self._lock = threading.RLock()
        self._shown_at = 0.0
        self.current: int | None = None
        """The pair on screen, None while there is none."""
        self.upcoming: int | None = None
        """The pair after it, to be fetched ahead."""
        self.skipped: int | None = None
        """The pair that was skipped last, as long as its reason may still be said."""
        self.explained = False
        """Whether the reason of the last skip was said, until the next press."""
        self.taken_back: str | None = None
        """What was said of the pair on screen before it was taken back."""

    @property
    def undoable(self) -> int | None:
        """The pair whose answer may be taken back: the last one of this rater, at whatever page."""
        last = self._store.comparisons.last_compared(self._run, self._rater.id)
        return last[0] if last else None

    def refill(self) -> bool:
        """Looks for pairs if none is on screen or at hand; returns whether anything changed."""
        with self._lock:
            before = self.current, self.upcoming
            if self.current is None:
                skipped, explained = self.skipped, self.explained
                self._advance()
                if self.current is None:  # the reason of the last skip may still be said
                    self.skipped, self.explained = skipped, explained
            elif self.upcoming is None:
                self.upcoming = self._pick()
            return before != (self.current, self.upcoming)

    def answer(self, pair: int, answer: str) -> bool:
        """Commits what is said of the pair that was on screen and moves on.

        Returns:
            False if the press counts for nothing.

        Raises:
            AnsweredElsewhere: If the same person has answered it at another page; the page has moved on.
            sqlite3.Error: If it could not be committed; the pair stays.
        """
        with self._lock:
            seconds = self._clock() - self._shown_at
            if pair != self.current or seconds < self._guard_seconds:
                return False
            try:
                self._store.comparisons.compare(pair, self._rater.id, answer, round(1000 * seconds))
            except AlreadyAnswered:
                self._assignment.release(self._holder, pair)
                self._advance()
                raise AnsweredElsewhere(
                    "You have already compared that pair on another page; that answer counts."
                ) from None
            self._assignment.release(self._holder, pair)
            self.current = None
            try:
                self._advance()
            except sqlite3.Error:  # the answer is kept all the same; `refill` looks again
                log.exception("no next pair could be looked for")
            self.skipped = pair if answer == "skip" else None
            return True

    def explain(self, pair: int, reason: str) -> bool:
        """Says why the pair skipped last was skipped; False if it is another one, or was taken back.

        Raises:
            ValueError: If the reason is too long.
            sqlite3.Error: If it could not be committed.
        """
        with self._lock:
            last = self._store.comparisons.last_compared(self._run, self._rater.id)
            if pair != self.skipped or last != (pair, "skip"):
                return False
            self._store.comparisons.compare(pair, self._rater.id, "skip", 0, reason=reason)
            self.skipped, self.explained = None, True
            return True

    def undo(self, pair: int) -> bool:
        """Takes this rater's last answer back and shows its pair again; False if that is of another pair.

        Raises:
            sqlite3.Error: If it could not be committed.
        """
        with self._lock:
            last = self._store.comparisons.last_compared(self._run, self._rater.id)
            if last is None or last[0] != pair:
                return False
            self._store.comparisons.compare(pair, self._rater.id, "undo", 0)
            if self.upcoming is not None and self.current is not None:
                self._assignment.release(self._holder, self.upcoming)
            self.upcoming = self.current or self.upcoming
            self._show(pair)
            self.taken_back = last[1]
            return True

    def close(self) -> None:
        """Frees the pairs this page held."""
        self._assignment.release(self._holder)

    def _advance(self) -> None:
        ahead, self.current = self.upcoming, None
        # What was fetched ahead is asked for again: others may have taken or answered it since.
        self._show(self._pick(only=ahead) or self._pick())
        self.upcoming = self._pick() if self.current is not None else None

    def _pick(self, only: int | None = None) -> int | None:
        waiting = [
            pair.id for pair in self._store.comparisons.waiting_pairs(self._run) if only in (None, pair.id)
        ]
        avoid = () if self.current is None else (self.current,)
        return self._assignment.take(self._holder, waiting, now=self._clock(), avoid=avoid)

    def _show(self, pair: int | None) -> None:
        self.current, self._shown_at = pair, self._clock()
        self.skipped, self.taken_back, self.explained = None, None, False
        if pair is not None:
            self._assignment.hold(self._holder, pair, now=self._shown_at)
