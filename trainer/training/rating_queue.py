"""Which clips people have before them: cut from the newest rollouts, rated, or expired.

A simulated rater answers at once, in the trainer's thread; people rate through the store.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from onedemo.config import RunConfig
from onedemo.errors import UserError
from onedemo.reward.model import Snapshot
from onedemo.storage.clips import NewClip
from onedemo.storage.store import Store
from onedemo.training.clip_worker import ClipMaker
from onedemo.training.learner import Learner
from onedemo.types import Clip, Rollouts, Segment

_FULL = 2 / 3
"""Share of the queue that waits before it is filled up for people."""
_MOST_DECLINED = 100
"""After so many declined clips in a row, a simulated rater is asked again when there are new rollouts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Simulated:
    """A rater that answers at once, in the trainer thread. People rate through the store instead."""

    name: str
    """In the store."""
    rate: Callable[[Segment, int], int | None]
    """(segment, demo step) to a rating, 1..5, or None: declined, another clip is asked instead."""
    mark: Callable[[Segment, int], tuple[int, int] | None] | None = None
    """The same to where it goes wrong, as steps from the clip's start; None: it does not mark."""


def due_in_round(number: int, rounds: int, total: int) -> int:
    """Ratings asked for by the end of a round before practice: at least one more in each, at most all.

    Args:
        number: Of the round, 1, 2, ...
        rounds: How many there are.
        total: Ratings in all of them.
    """
    return min(total, max(number, round(total * number / rounds)))


class RatingQueue:
    """The queue of one run.

    Args:
        store: Holds clips and ratings.
        run: Name of the run.
        config: Its settings.
        simulated: Answers in place of people; None for people.
    """

    def __init__(self, store: Store, run: str, config: RunConfig, simulated: Simulated | None) -> None:
        self._store, self._run, self._config, self._simulated = store, run, config, simulated
        self._declined = 0
        self._seen = (-2, 0)
        self._pace = 0
        self.clips: ClipMaker | None = None
        """Draws clips for people; None if nobody looks."""

    @property
    def target(self) -> int:
        """Ratings asked for in all."""
        return self._config.ratings.pretrain + self._config.ratings.online

    def given(self) -> int:
        """Valid ratings that are used for training."""
        return self._store.ratings.count_for_training(self._run)

    def asked(self, iteration: int) -> int:
        """Ratings that people are asked for so far, in all, after so many iterations.

        Those that are about the policy wait until there are clips of it: the first iteration makes them.
        """
        return self.target if iteration else self._config.ratings.pretrain

    def fill(self, learner: Learner, pool: Rollouts | None, snapshot: Snapshot | None) -> None:
        """Cuts clips; in place of those that a simulated rater declines it cuts others.

        Args:
            learner: Chooses.
            pool: What clips are cut from; None if none are at hand (a run that went on with all its
                questions answered).
            snapshot: Predicts; None before the first fit.

        Raises:
            UserError: If a simulated rater declines whatever the random policy does.
        """
        self._declined = 0
        if self._simulated is not None:
            # A process before this one may have died between its questions and the answers.
            asked = [c for s in ("cut", "ready") for c in self._store.clips.waiting(self._run, s)]
            self._answer(self._simulated, asked, [self._store.clips.segment(c.id) for c in asked])
        while self._fill_once(learner, pool, snapshot):
            if self._declined >= _MOST_DECLINED:
                if learner.iteration == 0 and self._simulated is not None:
                    raise UserError(
                        f"rater {self._simulated.name} declined {self._declined} clips in a row; "
                        "without ratings there is nothing to learn from"
                    )
                return

    def predict_waiting(self, learner: Learner, snapshot: Snapshot) -> None:
        """Notes what a new snapshot predicts for the clips that wait."""
        waiting = self._store.clips.waiting(self._run)
        segments = [(clip, self._store.clips.segment(clip.id)) for clip in waiting]
        predicted = {c.id: learner.predict(snapshot, segment, c.demo_step) for c, segment in segments}
        self._store.clips.set_predictions(snapshot.number, predicted)

    def withdraw_stale(self, iteration: int) -> None:
        """Takes back clips that nobody rated in time: the policy has moved on."""
        oldest = max(1, iteration - self._config.ratings.stale_iterations)
        stale = [c.id for c in self._store.clips.waiting(self._run) if c.iteration < oldest]
        self._store.clips.set_state(stale, "withdrawn")

    def _fill_once(self, learner: Learner, pool: Rollouts | None, snapshot: Snapshot | None) -> bool:
        """Cuts as many clips as are missing from the queue; True if some still are.

        A few at a time, because one alone cannot be a mix of kinds (``trainer/queries/selection.py``).
        """
        if self.clips is not None:
            self.clips.retry()
        if pool is None:
            return False
        missing = self._missing(learner, snapshot)
        if missing <= 0:
            return False
        # Seeded by what was cut before, so that a resumed run asks what the uninterrupted one would.
        seed = [self._config.seed, learner.iteration, self._store.clips.count(self._run)]
        questions = learner.choose(pool, snapshot, missing, np.random.default_rng(seed))
        new = []
        for question in questions:
            segment = pool.segment(question.lane, question.start, learner.clip_steps)
            predicted = None
            if snapshot is not None:
                predicted = learner.predict(snapshot, segment, question.demo_step)
            new.append(
                NewClip(
                    demo_step=question.demo_step,
                    segment=segment,
                    stage="pretrain" if learner.iteration == 0 else "online",
                    iteration=learner.iteration,
                    snapshot=snapshot.number if snapshot else 0,
                    predicted=predicted,
                    choice=question.choice,
                    score=question.score,
                )
            )
        clips = self._store.clips.add(self._run, new)
        if self.clips is not None:
            self.clips.submit(clips)
        return self._simulated is not None and self._answer(
            self._simulated, clips, [clip.segment for clip in new]
        )

    def _missing(self, learner: Learner, snapshot: Snapshot | None) -> int:
        # Waiting is read before given, so that a press in between is missing from neither.
        waiting = [c for s in ("ready", "cut") for c in self._store.clips.waiting(self._run, s)]
        given = self.given()
        if self._simulated is not None:
            return self._due(learner, snapshot) - given
        wanted = max(self._config.ratings.queue, 2 * self._ratings_an_iteration(learner.iteration, given))
        queue = min(wanted, self.asked(learner.iteration) - given)
        return queue - len(waiting) if len(waiting) <= _FULL * queue else 0

    def _ratings_an_iteration(self, iteration: int, given: int) -> int:
        """How many came during the last one: clips are cut between two, so as many must wait at the least."""
        before, given_before = self._seen
        self._seen = (iteration, given)  # the last look before an iteration is its beginning
        if iteration != before:
            self._pace = given - given_before if iteration == before + 1 else 0
        return self._pace

    def _answer(self, simulated: Simulated, clips: list[Clip], segments: list[Segment]) -> bool:
        """Has clips rated by the simulated rater; whether it declined any."""
        rater, declined = self._store.accounts.ensure(simulated.name, "simulated"), False
        for clip, segment in zip(clips, segments, strict=True):
            value = simulated.rate(segment, clip.demo_step)
            if value is not None:
                mark = simulated.mark(segment, clip.demo_step) if simulated.mark else None
                self._store.ratings.rate(clip.id, rater.id, value, latency_ms=0, mark=mark)
                self._declined = 0
                continue
            self._store.ratings.skip(clip.id, rater.id, latency_ms=0)
            self._declined, declined = self._declined + 1, True
        return declined

    def _due(self, learner: Learner, snapshot: Snapshot | None) -> int:
        """Ratings that a simulated rater has been asked for by now, in all."""
        ratings = self._config.ratings
        if learner.iteration == 0:
            # A round, a fit, the next round: later ones are chosen by what was learned.
            done = snapshot.number if snapshot else 0
            return due_in_round(done + 1, ratings.rounds, ratings.pretrain)
        span = ratings.online_share * self._config.rollouts.total_steps
        return ratings.pretrain + round(ratings.online * min(1.0, learner.env_steps / span))
