"""The rater that measures: a distance at each step of a clip, four thresholds, a budget.

``onedemo.annotators.oracle.Oracle`` and ``onedemo.annotators.scripted.Script`` say what is measured;
``onedemo.annotators.noise``
what goes wrong on the way to a rating. Nothing that learns may import this module.

Shapes: W control steps, q positions, v velocities.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from onedemo.annotators.noise import Errors, Look
from onedemo.types import Segment

_STREAM = 1511
"""Sets a rater's random numbers apart from others that the same seed gives."""


_SHORTEST_MARK_SECONDS = 0.032
"""About a frame."""
_STANDS_OUT = 0.5
"""Of the width of a class."""


class RatingBudgetSpent(Exception):
    """The rater was asked once more than it agreed to."""


class Budget:
    """How many ratings a rater will give, and has given; clips it declined cost nothing.

    Args:
        ratings: It will give in a run.
        given: Of these, before now: a run that was stopped goes on.
    """

    def __init__(self, ratings: int, given: int = 0) -> None:
        self.budget, self.given = ratings, given

    def check(self) -> None:
        """Raises RatingBudgetSpent if nothing is left."""
        if self.given >= self.budget:
            raise RatingBudgetSpent(f"the budget of {self.budget} ratings is spent")


class DistanceAnnotator(Budget):
    """Rates by the mean distance of a clip. A subclass measures it.

    The k-th rating depends on the clip, the seed and k alone, so a run that was stopped goes on as if
    it had not been.

    Args:
        thresholds: Four mean distances, ascending, beyond each of which a point is taken off.
        dt: Seconds of a control step.
        budget: Ratings it will give in all, enforced here.
        given: Ratings it gave before, in an earlier process.
        seed: Of what chance there is in the errors.
        errors: What it gets wrong.
    """

    marking = False
    """Whether it also says where a clip goes wrong."""

    def __init__(
        self,
        thresholds: Sequence[float],
        *,
        dt: float,
        budget: int,
        given: int = 0,
        seed: int = 0,
        errors: Errors = (),
    ) -> None:
        super().__init__(budget, given)
        self._thresholds = np.asarray(thresholds, float)
        self._seed, self._errors = seed, errors
        self._shortest_mark = max(1, round(_SHORTEST_MARK_SECONDS / dt))

    def distance(self, qpos: np.ndarray, qvel: np.ndarray, demo_step: int) -> np.ndarray:
        """Distance step by step, (W,), from the demo from control step ``demo_step`` on.

        Args:
            qpos: Positions, (W, q).
            qvel: Velocities, (W, v).
            demo_step: Where the demo clip begins.
        """
        raise NotImplementedError

    def rate(self, segment: Segment, demo_step: int) -> int | None:
        """The rating, 1..5, or None: declined, which costs nothing of the budget.

        Args:
            segment: W control steps of the robot.
            demo_step: Where the demo clip beside it begins.

        Raises:
            RatingBudgetSpent: If the budget is used up.
        """
        self.check()
        rng = np.random.default_rng([_STREAM, self._seed, self.given])
        look = Look(
            distances=self.distance(segment.qpos, segment.qvel, demo_step),
            thresholds=self._thresholds,
            progress=self.given / max(1, self.budget - 1),
            normal=float(rng.normal()),
        )
        for model, strength in self._errors:
            look = model.apply(look, strength)
        if look.declined:
            return None
        self.given += 1
        return min(5, 1 + int(np.searchsorted(look.chances.cumsum(), rng.random(), side="right")))

    def mark(self, segment: Segment, demo_step: int) -> tuple[int, int] | None:
        """Where a clip goes wrong, as a person would mark it: the one stretch that is worst.

        Args:
            segment: W control steps of the robot.
            demo_step: Where the demo clip beside it begins.

        Returns:
            First step and step after the last; None if no stretch stands out by half a class.
        """
        distances = self.distance(segment.qpos, segment.qvel, demo_step)
        # The stretch with the most distance above the mean (Kadane's algorithm, by prefix sums).
        above = np.concatenate([[0.0], np.cumsum(distances - distances.mean())])
        gains = above - np.minimum.accumulate(above)
        end = int(gains.argmax())
        start = int(above[: end + 1].argmin())
        inside = np.zeros(len(distances), bool)
        inside[start:end] = True
        if min(end - start, len(distances) - (end - start)) < self._shortest_mark:
            return None
        width = Look(distances=distances, thresholds=self._thresholds).width
        stands_out = distances[inside].mean() - distances[~inside].mean() >= _STANDS_OUT * width
        return (start, end) if stands_out else None

    def close(self) -> None:
        """Holds nothing that would have to be freed."""

    def rating_of(self, distance: np.ndarray) -> np.ndarray:
        """Ratings of distances without any error, the same shape. Costs nothing: for evaluation."""
        return 5 - (np.asarray(distance)[..., None] > self._thresholds).sum(axis=-1)
