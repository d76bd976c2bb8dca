"""Simulated raters, by name. They compare what a person would see; the oracle reads hidden demo states.

``oracle``, ``script[:TABLE.json]`` or ``package.module:Class``; the first two may be followed by error
models, ``oracle+mistake:0.1+jitter`` (``onedemo.annotators.noise``), and by ``+seed:N``.

Nothing that learns may import this module or ``onedemo.demos.ground_truth``: a rater sees the demo's
states, the learner sees nothing but the rating.

Shapes: W control steps, q positions, v velocities, A axes and K numbers that are compared
(``onedemo.sim.kinematics``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from onedemo.annotators.base import DistanceAnnotator, RatingBudgetSpent
from onedemo.annotators.custom import OwnRater
from onedemo.annotators.noise import Errors, parse_errors
from onedemo.annotators.scripted import Script, load_marks, table_path
from onedemo.demos.ground_truth import HiddenStates
from onedemo.errors import UserError
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import Body, body_of
from onedemo.types import Demo, Segment

__all__ = ["THRESHOLDS", "Oracle", "RatingBudgetSpent", "SimulatedRater", "appearance", "make_rater"]

THRESHOLDS = (0.9, 1.3, 1.7, 2.15)
"""Mean distances (see ``appearance``) beyond which the oracle takes one point off a hopper."""
_MEANT_FOR = 2.23
"""Sum of the squared weights of a hopper's four limbs: 1, 0.49, 0.49 and 0.25."""

MARKS = "marks"
"""In a rater's name: it marks, too."""

_CHOICES = "oracle, script, script:TABLE.json, package.module:Class"


class SimulatedRater(Protocol):
    """What the trainer asks when no person is there."""

    def rate(self, segment: Segment, demo_step: int) -> int | None:
        """The rating, 1..5, of a segment beside the demo from control step ``demo_step`` on.

        None if it declines; then another clip is asked.
        """
        ...

    def close(self) -> None:
        """Frees what it holds."""
        ...


class Oracle(DistanceAnnotator):
    """Rates by the mean distance between the robot's states and the demo's hidden ones.

    Args:
        hidden: The demo's states.
        robot: Name of the robot.
        budget: Ratings it will give, enforced here.
        thresholds: Four distances, ascending; those of ``thresholds_of`` if None.
        given: Ratings it gave before, in an earlier process.
        seed: Of what chance there is in the errors.
        errors: What it gets wrong.
    """

    def __init__(
        self,
        hidden: HiddenStates,
        robot: str = "hopper",
        *,
        budget: int,
        thresholds: Sequence[float] | None = None,
        given: int = 0,
        seed: int = 0,
        errors: Errors = (),
    ) -> None:
        self.body = body_of(robot_named(robot))
        """Of the robot."""
        given_ones = thresholds_of(self.body) if thresholds is None else thresholds
        super().__init__(
            given_ones, dt=self.body.robot.dt, budget=budget, given=given, seed=seed, errors=errors
        )
        self.hidden = hidden
        """The demo's states."""
        self._demo = appearance(hidden.qpos, hidden.qvel, self.body)

    def distance(self, qpos: np.ndarray, qvel: np.ndarray, demo_step: int) -> np.ndarray:
        """Distance in appearance, step by step, (W,), from the demo's states at the same steps on."""
        demo = self._demo[demo_step : demo_step + len(qpos)]
        seen = appearance(qpos[: len(demo)], qvel[: len(demo)], self.body)
        return np.linalg.norm(seen - demo, axis=-1)

    def true_similarity(self, qpos: np.ndarray, qvel: np.ndarray) -> float:
        """Mean rating of single states of an episode against the demo at the same step; evaluation.

        Args:
            qpos: Positions of one episode from its start, (T, q).
            qvel: Velocities, (T, v).

        Returns:
            1..5, without any error. Costs nothing of the budget: no learner gets to see it.
        """
        return float(self.rating_of(self.distance(qpos, qvel, 0)).mean())


def appearance(qpos: np.ndarray, qvel: np.ndarray, body: Body) -> np.ndarray:
    """What a person sees of a robot in a clip whose camera follows it: the place itself is not visible.

    Absolute directions of limbs are closer to what the eye compares than joint angles; the slower, heavier
    root counts more than what hangs at it, and tips count least (``Body.weights``).

    Args:
        qpos: Positions, (..., q).
        qvel: Velocities, (..., v).
        body: Of the robot.

    Returns:
        (..., K): height beside that at rest, how far each limb points right and up, spin of the root,
        vertical and horizontal velocity, each in units in which 1 is a clearly visible difference. A hopper
        has 12 of them.
    """
    directions = body.weights[:, None] * body.axes(qpos)
    rates = body.root_rates(qpos, qvel)
    parts = [
        (1.5 * (body.height(qpos) - body.rest_height))[..., None],
        directions.reshape(*directions.shape[:-2], -1),
        0.15 * np.clip(rates.spin, -10, 10),
        0.15 * rates.climb[..., None],
        0.08 * rates.travel[..., None],
    ]
    return np.concatenate(parts, axis=-1)


def thresholds_of(body: Body) -> list[float]:
    """The four distances beyond which the oracle takes one point off.

    The more limbs are compared, the farther apart are two poses that have nothing in common: in proportion to
    the root of the sum of squared weights, of which directions in space show two thirds in a picture. The
    hopper's thresholds are scaled by that.
    """
    shown = 1.0 if body.planar else 2 / 3
    scale = float(np.sqrt(shown * np.square(body.weights).sum() / _MEANT_FOR))
    return [scale * threshold for threshold in THRESHOLDS]


def make_rater(
    name: str, hidden: HiddenStates | None, *, demo: Demo, budget: int, given: int = 0, seed: int = 0,
    robot: str = "hopper",
) -> SimulatedRater:  # fmt: skip
    """The simulated rater of that name.

    Args:
        name: ``oracle``, ``script``, ``script:TABLE.json`` or ``package.module:Class``, then ``+`` and
            error models, ``seed:N``, or ``marks``: it also says where a clip goes wrong.
        hidden: The demo's states, if it has any; only the oracle gets them.
        demo: What is compared with.
        budget: Ratings the rater will give in a run, enforced by itself.
        given: Of these, before now.
        seed: Of the rater's errors, unless the name gives one.
        robot: Name of the robot that is rated.

    Raises:
        UserError: If there is no such rater, or it does not fit the demo.
    """
    base, *parts = name.split("+")
    kind, _, rest = base.partition(":")
    errors, own_seed = parse_errors([part for part in parts if part != MARKS], name)
    seed = seed if own_seed is None else own_seed
    if base == "oracle":
        if hidden is None:
            raise UserError(
                f"the oracle rater compares hidden demo states, and demo {demo.name!r} has none; "
                "use a built-in demo or a table of marks (--rater script), or rate it yourself with "
                "`onedemo serve`"
            )
        annotator: DistanceAnnotator = Oracle(
            hidden, robot, budget=budget, given=given, seed=seed, errors=errors
        )
        annotator.marking = MARKS in parts
        return annotator
    if kind == "script":
        marks = load_marks(Path(rest) if rest else table_path(demo.path), demo)
        annotator = Script(marks, robot, budget=budget, given=given, seed=seed, errors=errors)
        annotator.marking = MARKS in parts
        return annotator
    if kind == "oracle" or not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*", base):
        raise UserError(f"unknown rater {base!r}; choose one of: {_CHOICES}")
    if parts:
        raise UserError(
            f"rater {name!r}: error models need a rater that measures a distance, oracle or script; "
            f"let {base} make its own errors"
        )
    return OwnRater(base, demo=demo, robot=robot, budget=budget, given=given)


def marker(rater: SimulatedRater) -> Callable[[Segment, int], tuple[int, int] | None] | None:
    """How a rater says where a clip goes wrong; None if it does not."""
    return rater.mark if isinstance(rater, DistanceAnnotator) and rater.marking else None
