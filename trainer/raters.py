"""Simulated raters. They compare what a person would see; the oracle reads hidden demo states to do so.

Nothing that learns may import this module or ``trainer.hidden``: a rater sees the demo's states, the
learner sees nothing but the rating.

Shapes: W control steps, q = v = 6.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from trainer.errors import UserError
from trainer.hidden import HiddenStates
from trainer.records import Segment

THRESHOLDS = (0.9, 1.3, 1.7, 2.15)
"""Mean distances (see ``appearance``) beyond which the oracle takes one point off."""


class RatingBudgetSpent(Exception):
    """The rater was asked once more than it agreed to."""


class SimulatedRater(Protocol):
    """What the trainer asks when no person is there."""

    def rate(self, segment: Segment, demo_step: int) -> int:
        """The rating, 1..5, of a segment beside the demo from control step ``demo_step`` on."""
        ...


class Oracle:
    """Rates by the mean distance between the robot's states and the demo's hidden ones.

    Args:
        hidden: The demo's states.
        budget: Ratings it will give, enforced here.
        thresholds: Four distances, ascending.
    """

    def __init__(
        self, hidden: HiddenStates, *, budget: int, thresholds: tuple[float, ...] = THRESHOLDS
    ) -> None:
        self._demo = appearance(hidden.qpos, hidden.qvel)
        self._thresholds = np.asarray(thresholds)
        self.budget = budget
        self.given = 0

    def rate(self, segment: Segment, demo_step: int) -> int:
        """The rating, 1..5.

        Args:
            segment: W control steps of the robot.
            demo_step: Where the demo clip beside it begins.

        Raises:
            RatingBudgetSpent: If the budget is used up.
        """
        if self.given >= self.budget:
            raise RatingBudgetSpent(f"the budget of {self.budget} ratings is spent")
        self.given += 1
        return int(self._rating(self.distance(segment.qpos, segment.qvel, demo_step).mean()))

    def distance(self, qpos: np.ndarray, qvel: np.ndarray, demo_step: int) -> np.ndarray:
        """Distance in appearance, step by step, (W,), from the demo's states at the same steps on."""
        demo = self._demo[demo_step : demo_step + len(qpos)]
        return np.linalg.norm(appearance(qpos[: len(demo)], qvel[: len(demo)]) - demo, axis=-1)

    def true_similarity(self, qpos: np.ndarray, qvel: np.ndarray) -> float:
        """Mean rating of single states of an episode against the demo at the same step; evaluation.

        Args:
            qpos: Positions of one episode from its start, (T, q).
            qvel: Velocities, (T, v).

        Returns:
            1..5. Costs nothing of the budget: no learner gets to see it.
        """
        return float(self._rating(self.distance(qpos, qvel, 0)).mean())

    def _rating(self, distance: np.ndarray) -> np.ndarray:
        return 5 - (np.asarray(distance)[..., None] > self._thresholds).sum(axis=-1)


def appearance(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """What a person sees of a Hopper in a clip whose camera follows it: x is not visible.

    Absolute directions of the four body segments are closer to what the eye compares than joint
    angles; the slower, heavier torso counts more than the foot.

    Args:
        qpos: Positions, (..., 6).
        qvel: Velocities, (..., 6).

    Returns:
        (..., 12): height, sine and cosine of the four segments' directions, torso spin, vertical and
        horizontal velocity, each in units in which 1 is a clearly visible difference.
    """
    torso = qpos[..., 2]
    thigh = torso - qpos[..., 3]
    leg = thigh - qpos[..., 4]
    foot = leg - qpos[..., 5]
    parts = [1.5 * (qpos[..., 1] - 1.25)]
    for angle, weight in ((torso, 1.0), (thigh, 0.7), (leg, 0.7), (foot, 0.5)):
        parts += [weight * np.sin(angle), weight * np.cos(angle)]
    spin = 0.15 * np.clip(qvel[..., 2], -10, 10)
    parts += [spin, 0.15 * qvel[..., 1], 0.08 * qvel[..., 0]]
    return np.stack(parts, axis=-1)


def make_rater(name: str, hidden: HiddenStates | None, *, demo: str, budget: int) -> SimulatedRater:
    """The simulated rater of that name.

    Raises:
        UserError: If there is none, or the demo has no hidden states to compare with.
    """
    if name != "oracle":
        raise UserError(f"unknown rater {name!r}; choose one of: oracle")
    if hidden is None:
        raise UserError(
            f"the oracle rater compares hidden demo states, and demo {demo!r} has none; "
            "use a built-in demo, or rate it yourself with `onedemo serve`"
        )
    return Oracle(hidden, budget=budget)
