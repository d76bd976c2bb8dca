"""What happens when somebody rates: the rules of the Rate tab, without any page.

Every press names the clip that was on screen. A press that names another clip, or comes sooner
after the clip than anybody can judge (a held key), changes nothing. A rating is committed with its mark
before the page moves on; if the commit fails the clip stays. What may be taken back, the events tell.
"""

from __future__ import annotations

import logging
import random
import sqlite3
import threading
import time
from collections.abc import Callable, Hashable

import numpy as np

from onedemo.app.annotation.assignment import Ask, Assignment, Seat, to_repeat, to_share
from onedemo.reward.segment_marks import Mark, picture_of_step, pictures_of_steps, steps_of_pictures
from onedemo.storage.rating_records import AlreadyAnswered, LastAnswer
from onedemo.storage.store import Store
from onedemo.types import Demo, Rater

log = logging.getLogger("onedemo.page")

GUARD_SECONDS = 0.3
"""A clip lasts about 0.3 s: a rating that comes sooner was not made for it."""


class AnsweredElsewhere(Exception):
    """What was pressed at a page is answered already, by the same person at another page."""


class RatingSession:
    """One rater at one page.

    Args:
        store: Where ratings go.
        run: The run whose clips are rated.
        rater: Who rates.
        assignment: Shared by all pages of the run.
        holder: Names this page to the assignment.
        dt: Seconds of a control step.
        demo: What is beside the clips.
        guard_seconds: A press that comes sooner after the clip was not made for it.
        clock: Seconds; replaced in tests.
        rng: Draws which clips are asked again.
        wanted: How many more ratings are asked of everybody for now; None: no matter how many.
    """

    def __init__(
        self,
        store: Store,
        run: str,
        rater: Rater,
        assignment: Assignment,
        holder: Hashable,
        *,
        dt: float,
        demo: Demo,
        guard_seconds: float = GUARD_SECONDS,
        clock: Callable[[], float] = time.monotonic,
        rng: random.Random | None = None,
        wanted: Callable[[], int] | None = None,
    ) -> None:
        self._store = store
        self._run = run
        self.rater = rater
        self._assignment = assignment
        self._holder = Seat(rater.id, holder)
        self._dt, self._demo = dt, demo
        self._guard_seconds = guard_seconds
        self._clock = clock
        self._rng = rng or random.Random()
        self._wanted = wanted
        self._lock = threading.RLock()
        self._shown_at = 0.0
        self._kind = self._assignment.again.draw(self._rng)
        self._current: Ask | None = None
        self._upcoming: Ask | None = None
        self._skipped: Ask | None = None
        self.explained = False
        """Whether the reason of the last skip was said, until the next press."""
        self.taken = False
        """Whether there are clips, but others have them on their screens, so that none is here."""
        self.taken_back: LastAnswer | None = None
        """What was answered to the clip on screen before it was taken back."""

    @property
    def current(self) -> int | None:
        """The clip on screen, None while there is none."""
        return self._current.clip if self._current else None

    @property
    def upcoming(self) -> int | None:
        """The clip after it, to be fetched ahead."""
        return self._upcoming.clip if self._upcoming else None

    @property
    def skipped(self) -> int | None:
        """The clip that was skipped last, as long as its reason may still be said."""
        return self._skipped.clip if self._skipped else None

    @property
    def undoable(self) -> int | None:
        """The clip whose rating or skip may be taken back: the last one of this rater, at whatever page."""
        last = self._store.ratings.last_answer(self._run, self.rater.id)
        return last.clip if last else None

    @property
    def mark(self) -> Mark | None:
        """What was marked on the clip on screen before it was taken back, in pictures."""
        last = self.taken_back
        return pictures_of_steps(last.mark, self._pictures(last.clip)) if last and last.mark else None

    def refill(self) -> bool:
        """Looks for clips if none is on screen or none is at hand; returns whether anything changed."""
        with self._lock:
            before = self._current, self._upcoming
            if self._current is None:
                skipped, explained = self._skipped, self.explained
                self._advance()
                if self._current is None:  # the reason of the last skip may still be said
                    self._skipped, self.explained = skipped, explained
            elif self._upcoming is None:
                self._upcoming = self._pick(self._waiting())
            return before != (self._current, self._upcoming)

    def rate(self, clip: int, value: int, mark: Mark | None = None) -> bool:
        """Commits a rating of the clip that was on screen and moves on.

        Args:
            clip: What was on screen.
            value: 1 to 5.
            mark: Where it goes wrong: its first picture, and the picture after the last.

        Returns:
            False if the press counts for nothing.

        Raises:
            AnsweredElsewhere: If the same person has answered it at another page; the page has moved on.
            ValueError: If the mark is no stretch of the clip.
            sqlite3.Error: If it could not be committed; the clip stays.
        """

        def commit(ask: Ask) -> None:
            steps = steps_of_pictures(mark, self._pictures(clip)) if mark is not None else None
            self._store.ratings.rate(
                clip, self.rater.id, value, self._latency_ms(), mark=steps, repeat=ask.repeat
            )

        return self._answer(clip, commit) is not None

    def skip(self, clip: int) -> bool:
        """As ``rate``, but without a rating. ``explain`` may follow."""

        def commit(ask: Ask) -> None:
            self._store.ratings.skip(clip, self.rater.id, self._latency_ms(), repeat=ask.repeat)

        with self._lock:
            ask = self._answer(clip, commit)
            if ask is not None:
                self._skipped = ask
            return ask is not None

    def explain(self, clip: int, reason: str) -> bool:
        """Says why the clip skipped last was skipped; False if it is another one.

        Raises:
            ValueError: If the reason is too long, or cannot be added any more.
            sqlite3.Error: If it could not be committed.
        """
        with self._lock:
            if self._skipped is None or clip != self._skipped.clip:
                return False
            repeat = self._skipped.repeat
            if not self._store.ratings.holds(clip, self.rater.id, repeat=repeat):
                return False  # taken back at another page
            self._store.ratings.skip(clip, self.rater.id, 0, reason=reason, repeat=repeat)
            self._skipped, self.explained = None, True
            return True

    def undo(self, clip: int) -> bool:
        """Takes this rater's last rating or skip in the run back and shows its clip again.

        Returns:
            False if that is of another clip: it was taken back already, or something was said since.

        Raises:
            sqlite3.Error: If it could not be committed.
        """
        with self._lock:
            last = self._store.ratings.last_answer(self._run, self.rater.id)
            if last is None or last.clip != clip:
                return False
            self._store.ratings.undo(clip, self.rater.id, repeat=last.repeat)
            if self._upcoming is not None and self._current is not None:
                self._assignment.release(self._holder, self._upcoming.clip)
            self._upcoming = self._current or self._upcoming
            # It stays this rater's, whether or not others have rated it meanwhile.
            self._show(Ask(clip, "repeated" if last.repeat else "shared"))
            self.taken_back = last
            return True

    def close(self) -> None:
        """Frees the clips this page held."""
        self._assignment.release(self._holder)

    def _answer(self, clip: int, commit: Callable[[Ask], object]) -> Ask | None:
        """Commits an answer to the clip on screen and moves on; None if the press counts for nothing."""
        with self._lock:
            ask = self._current
            if ask is None or clip != ask.clip or self._clock() - self._shown_at < self._guard_seconds:
                return None
            back = self.taken_back
            try:
                commit(ask)
            except AlreadyAnswered:
                self._assignment.release(self._holder, clip)
                self._advance()
                raise AnsweredElsewhere(
                    "You have already rated that clip on another page; that answer counts."
                ) from None
            self._kind = self._assignment.again.draw(self._rng)
            self._assignment.release(self._holder, clip)
            self._current = None
            try:
                if ask.kind == "shared" and back is None:  # one more, and not instead of one taken back
                    self._make_up()
                self._advance()
            except sqlite3.Error:  # the answer is kept all the same; `refill` looks again
                log.exception("no next clip could be looked for")
            return ask

    def _latency_ms(self) -> int:
        return round(1000 * (self._clock() - self._shown_at))

    def _pictures(self, clip: int) -> np.ndarray:
        shown = self._store.clips.get(clip)
        assert shown is not None
        return picture_of_step(shown, self._dt, self._demo)

    def _advance(self) -> None:
        waiting = self._waiting()
        ask, self._current = self._upcoming, None
        if ask is None or not self._still_asked(ask, waiting):
            ask = self._pick(waiting)
        self._show(ask)
        self._upcoming = self._pick(waiting) if ask is not None else None

    def _still_asked(self, ask: Ask, waiting: list[int]) -> bool:
        """Whether a clip that was fetched ahead may still be shown: others may have taken it since."""
        asked = (
            ask.clip in waiting
            if ask.kind == "fresh"
            else not self._store.ratings.holds(ask.clip, self.rater.id, repeat=ask.repeat)
        )
        if ask.kind == "shared" and not self._room(more=0):
            self._assignment.release(self._holder, ask.clip)
            return False
        return asked and self._take([ask.clip]) is not None

    def _pick(self, waiting: list[int]) -> Ask | None:
        """The next clip; what kind it is was drawn by lot when the last one was answered.

        Nothing is asked again while nothing fresh waits: people would go on beyond what was asked for.
        """
        self.taken = False
        if not waiting:
            return None
        if self._kind != "fresh":
            kind, self._kind = self._kind, "fresh"
            mine = self._store.ratings.answered(self._run, rater_id=self.rater.id)
            clip = None
            if kind == "repeated":
                clip = self._take(to_repeat(mine, self.rater.id))
            elif self._room():
                clip = self._take(to_share([*mine, *self._store.ratings.answered(self._run)], self.rater.id))
            if clip is not None:
                return Ask(clip, kind)
        clip = self._take(waiting)
        self.taken = clip is None
        return Ask(clip) if clip is not None else None

    def _room(self, more: int = 1) -> bool:
        """Whether ratings of clips that others have rated are wanted beside those of all that wait.

        Args:
            more: How many, besides those that people have in hand.
        """
        if self._wanted is None:
            return True
        asked = {*self._waiting(), *self._waiting("cut")}
        return self._wanted() >= len(asked) + self._assignment.beside(asked, now=self._clock()) + more

    def _make_up(self) -> None:
        """Withdraws clips for which no rating is wanted any more, since one was rated once more."""
        if self._wanted is None:
            return
        ready = self._waiting()
        surplus = len(ready) + len(self._waiting("cut")) - self._wanted()
        if surplus > 0:  # the newest: nobody has those on screen yet
            self._store.clips.set_state(ready[-surplus:], "withdrawn")

    def _waiting(self, state: str = "ready") -> list[int]:
        return [clip.id for clip in self._store.clips.waiting(self._run, state)]

    def _take(self, clips: list[int]) -> int | None:
        avoid = () if self._current is None else (self._current.clip,)
        return self._assignment.take(self._holder, clips, now=self._clock(), avoid=avoid)

    def _show(self, ask: Ask | None) -> None:
        self._current = ask
        self._skipped, self.taken_back, self.explained = None, None, False
        self._shown_at = self._clock()
        if ask is not None:
            self._assignment.hold(self._holder, ask.clip, now=self._shown_at)
