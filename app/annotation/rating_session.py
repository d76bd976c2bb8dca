"""What happens when somebody rates: the rules of the Rate tab, without any page.

Every press names the clip that was on screen. A press that names another clip, or comes sooner
after the clip than anybody can judge (a held key), changes nothing. A rating is committed before the
desk moves on; if the commit fails the clip stays.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import replace

from onedemo.app.annotation.assignment import Ask, Assignment, Seat, to_repeat, to_share
from onedemo.reward.segment_marks import seconds_of_pictures
from onedemo.storage.store import Store
from onedemo.types import Rater

GUARD_SECONDS = 0.3
"""A clip lasts about 0.3 s: a rating that comes sooner was not made for it."""


class AnsweredElsewhere(Exception):
    """What was pressed at a page is answered already, by the same person at another page."""


Mark = tuple[float, float]
"""Where a clip goes wrong: its first picture, and the picture after the last; whole numbers."""


class Desk:
    """One rater at one page.

    Args:
        store: Where ratings go.
        run: The run whose clips are rated.
        rater: Who rates.
        assignment: Shared by all pages of the run.
        holder: Names this page to the assignment.
        dt: Seconds of a control step.
        fps: Pictures per second of the demo.
        frames: Pictures of the demo.
        done: What was rated or skipped here before, to be taken back: a page that is loaded again goes on.
        clock: Seconds; replaced in tests.
        rng: Draws which clips are asked again.
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
        fps: float,
        frames: int,
        done: list[Ask] | None = None,
        clock: Callable[[], float] = time.monotonic,
        rng: random.Random | None = None,
    ) -> None:
        self._store = store
        self._run = run
        self.rater = rater
        self._assignment = assignment
        self._holder = Seat(rater.id, holder)
        self._dt, self._fps, self._frames = dt, fps, frames
        self._clock = clock
        self._rng = rng or random.Random()
        self._lock = threading.RLock()
        self._done = done if done is not None else []
        self._shown_at = 0.0
        self._kind = self._assignment.again.draw(self._rng)
        self._current: Ask | None = None
        self._upcoming: Ask | None = None
        self.mark: tuple[int, int] | None = None
        """Where the clip on screen goes wrong, as far as said."""
        self.skipped: int | None = None
        """The clip that was skipped last, as long as its reason may still be said."""
        self.explained = False
        """Whether its reason was said, until the next press."""
        self.taken_back: Ask | None = None
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
    def can_undo(self) -> bool:
        """Whether there is a rating or a skip to take back."""
        return bool(self._done)

    def refill(self) -> bool:
        """Looks for clips if none is on screen or none is at hand; returns whether anything changed."""
        with self._lock:
            before = self._current, self._upcoming
            if self._current is None:
                self._advance()
            elif self._upcoming is None:
                self._upcoming = self._pick(self._waiting())
            return before != (self._current, self._upcoming)

    def rate(self, clip: int, value: int) -> bool:
        """Commits a rating of the clip that was on screen and moves on.

        Returns:
            False if the press counts for nothing.

        Raises:
            AnsweredElsewhere: If the same person has answered it at another page; the desk has moved on.
            sqlite3.Error: If it could not be committed; the clip stays.
        """
        with self._lock:
            ask = self._accepted(clip)
            if ask is None:
                return False
            seconds = self._seconds(clip, self.mark) if self.mark is not None else None
            self._store.ratings.rate(
                clip, self.rater.id, value, self._latency_ms(), mark=seconds, repeat=ask.repeat
            )
            self._leave(replace(ask, mark=self.mark, value=value))
            return True

    def skip(self, clip: int) -> bool:
        """As ``rate``, but without a rating. ``explain`` may follow."""
        with self._lock:
            ask = self._accepted(clip)
            if ask is None:
                return False
            self._store.ratings.skip(clip, self.rater.id, self._latency_ms(), repeat=ask.repeat)
            self._leave(ask)
            self.skipped = clip
            return True

    def explain(self, clip: int, reason: str) -> bool:
        """Says why the clip skipped last was skipped; False if it is another one.

        Raises:
            ValueError: If the reason is too long, or cannot be added any more.
            sqlite3.Error: If it could not be committed.
        """
        with self._lock:
            if clip != self.skipped:
                return False
            self._store.ratings.skip(clip, self.rater.id, 0, reason=reason, repeat=self._done[-1].repeat)
            self.skipped, self.explained = None, True
            return True

    def set_mark(self, clip: int, mark: Mark | None) -> bool:
        """Notes where the clip on screen goes wrong, or that nothing is said of it; it goes with the rating.

        Returns:
            False if another clip is on screen.

        Raises:
            ValueError: If the mark is no stretch of the clip.
        """
        with self._lock:
            if clip != self.current:
                return False
            if mark is None:
                self.mark = None
                return True
            self._seconds(clip, mark)  # or it is no stretch of this clip
            self.mark = int(mark[0]), int(mark[1])
            return True

    def _seconds(self, clip: int, mark: Mark) -> tuple[float, float]:
        shown = self._store.clips.get(clip)
        if shown is None:
            raise ValueError(f"no clip {clip}")
        return seconds_of_pictures(
            mark, shown.demo_step, shown.steps, dt=self._dt, fps=self._fps, frames=self._frames
        )

    def undo(self) -> bool:
        """Takes the last rating or skip back and shows its clip again.

        Returns:
            False if there is none.

        Raises:
            sqlite3.Error: If it could not be committed.
        """
        with self._lock:
            if not self._done:
                return False
            ask = self._done[-1]
            self._store.ratings.undo(ask.clip, self.rater.id, repeat=ask.repeat)
            self._done.pop()
            if self._upcoming is not None and self._current is not None:
                self._assignment.release(self._holder, self._upcoming.clip)
            self._upcoming = self._current or self._upcoming
            self._show(Ask(ask.clip, ask.kind))
            self.taken_back = ask
            self.mark = ask.mark  # it is seen again, and goes with the next rating unless it is cleared
            return True

    def close(self) -> None:
        """Frees the clips this page held."""
        self._assignment.release(self._holder)

    def _accepted(self, clip: int) -> Ask | None:
        in_time = self._clock() - self._shown_at >= GUARD_SECONDS
        ask = self._current if clip == self.current and in_time else None
        if ask is not None and self._store.ratings.holds(ask.clip, self.rater.id, repeat=ask.repeat):
            self._assignment.release(self._holder, ask.clip)
            self._advance()
            raise AnsweredElsewhere("You had rated that clip at another page of yours: that answer stands.")
        return ask

    def _latency_ms(self) -> int:
        return round(1000 * (self._clock() - self._shown_at))

    def _leave(self, ask: Ask) -> None:
        self._done.append(ask)
        self._kind = self._assignment.again.draw(self._rng)
        self._assignment.release(self._holder, ask.clip)
        self._advance()

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
        return asked and self._take([ask.clip]) is not None

    def _pick(self, waiting: list[int]) -> Ask | None:
        """The next clip; what kind it is was drawn by lot when the last one was answered.

        Nothing is asked again while nothing fresh waits: people would go on beyond what was asked for.
        """
        if not waiting:
            return None
        if self._kind != "fresh":
            kind, self._kind = self._kind, "fresh"
            mine = self._store.ratings.answered(self._run, rater_id=self.rater.id)
            if kind == "repeated":
                clip = self._take(to_repeat(mine, self.rater.id))
            else:
                clip = self._take(to_share([*mine, *self._store.ratings.answered(self._run)], self.rater.id))
            if clip is not None:
                return Ask(clip, kind)
        clip = self._take(waiting)
        return Ask(clip) if clip is not None else None

    def _waiting(self) -> list[int]:
        return [clip.id for clip in self._store.clips.waiting(self._run)]

    def _take(self, clips: list[int]) -> int | None:
        avoid = () if self._current is None else (self._current.clip,)
        return self._assignment.take(self._holder, clips, now=self._clock(), avoid=avoid)

    def _show(self, ask: Ask | None) -> None:
        self._current = ask
        self.mark = self.skipped = self.taken_back = None
        self.explained = False
        self._shown_at = self._clock()
        if ask is not None:
            self._assignment.hold(self._holder, ask.clip, now=self._shown_at)
