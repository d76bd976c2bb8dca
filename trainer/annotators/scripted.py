"""A rater for a demo of another body: it compares what a person would, through a table of marks.

Somebody looked at the demo's frames and wrote down, every few of them, how far the torso is turned and
whether the feet are off the ground. Nothing else of the demo enters, no hidden states in particular.
Nothing that learns may import this module.

A table is JSON: ``{"marks": [[seconds, pitch, airborne], ...]}``. Seconds count from the first frame,
ascending. Pitch is the direction from hip to neck, degrees from upright, backward positive and not
wrapped: a backflip goes from 0 to 360. Airborne is true (or 1) or false (or 0). In between, marks are
interpolated linearly; before the first and after the last they stay.

Shapes: M marks, W control steps, q positions, v velocities.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from onedemo.annotators.base import DistanceAnnotator
from onedemo.annotators.noise import Errors
from onedemo.errors import UserError
from onedemo.robots.registry import robot_named
from onedemo.robots.robot import CONTACT_MARGIN
from onedemo.sim.kinematics import Body, body_of
from onedemo.types import Demo

SUFFIX = ".script.json"
THRESHOLDS = (0.6, 0.9, 1.35, 1.9)
"""Mean distances beyond which one point is taken off. With the torso turning at the right time and the
right way, they stand for about: 30 degrees and 2 rad/s off; 45 and 3; 70 and 5; 110 and 7."""

SPIN_WEIGHT = 0.15
"""Of one rad/s, as in the oracle."""
AIR_WEIGHT = 0.5
_SPIN_LIMIT = 10.0  # rad/s; faster is not seen to be faster
_SPIN_WINDOW = 0.1  # seconds: marks made by eye are some degrees off, and a slope shows it


class Script(DistanceAnnotator):
    """Rates by the mean distance between the robot and the marks in pitch, spin and airborne or not.

    Args:
        marks: The table, (M, 3): seconds, pitch in degrees, airborne 0..1.
        robot: Name of the robot.
        budget: Ratings it will give, enforced here.
        thresholds: Four distances, ascending.
        given: Ratings it gave before, in an earlier process.
        seed: Of what chance there is in the errors.
        errors: What it gets wrong.
    """

    def __init__(
        self,
        marks: np.ndarray,
        robot: str = "hopper",
        *,
        budget: int,
        thresholds: Sequence[float] = THRESHOLDS,
        given: int = 0,
        seed: int = 0,
        errors: Errors = (),
    ) -> None:
        self._body = body_of(robot_named(robot))
        self._dt = self._body.robot.dt
        super().__init__(thresholds, dt=self._dt, budget=budget, given=given, seed=seed, errors=errors)
        self._marks = marks

    def distance(self, qpos: np.ndarray, qvel: np.ndarray, demo_step: int) -> np.ndarray:
        """Distance step by step, (W,), from the marks from control step ``demo_step`` on."""
        seconds = self._dt * (demo_step + np.arange(len(qpos)))
        return np.linalg.norm(visible(qpos, qvel, self._body) - marked(self._marks, seconds), axis=-1)


def visible(qpos: np.ndarray, qvel: np.ndarray, body: Body) -> np.ndarray:
    """What the marks tell of, on the robot, in units in which 1 is a clearly visible difference.

    Args:
        qpos: Positions, (..., q).
        qvel: Velocities, (..., v).
        body: Of the robot.

    Returns:
        (..., 4): sine and cosine of the root's pitch (a whole turn looks the same), its spin and
        whether nothing touches the ground. A fixed root has no spin.
    """
    gap = np.minimum.reduce(list(body.clearances(qpos).values()))
    right, up = np.moveaxis(body.axes(qpos)[..., body.upright, :], -1, 0)
    spin = body.root_rates(qpos, qvel).spin
    back = -spin[..., 0] if spin.shape[-1] else np.zeros_like(right)
    return _features(np.arctan2(-right, up), back, gap >= CONTACT_MARGIN)  # forward, as seen, is clockwise


def marked(marks: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """The same of the demo at times, interpolated between the marks.

    Args:
        marks: (M, 3), see ``Script``.
        seconds: (W,).

    Returns:
        (W, 4), as ``visible``.
    """
    times, pitch, airborne = marks.T
    pitch = np.radians(pitch)
    after, before = (np.interp(seconds + side * _SPIN_WINDOW / 2, times, pitch) for side in (1, -1))
    turned = np.interp(seconds, times, pitch)
    return _features(turned, (after - before) / _SPIN_WINDOW, np.interp(seconds, times, airborne))


def table_path(video: Path) -> Path:
    """Where the table of a demo lies if none is named: beside its video."""
    return video.with_name(video.name.removesuffix(video.suffix) + SUFFIX)


def load_marks(path: Path, demo: Demo) -> np.ndarray:
    """Reads a table of marks.

    Args:
        path: A JSON file.
        demo: What it is a table of.

    Returns:
        (M, 3): seconds, pitch in degrees, airborne.

    Raises:
        UserError: If there is none, or it is not such a table of this demo.
    """
    try:
        table = json.loads(path.read_text())
        marks = np.array(table["marks"], float)
    except FileNotFoundError:
        raise UserError(
            f"rater script: no table of marks at {path}; give one with --rater script:TABLE.json"
        ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"rater script: {path} is no table of marks: {type(error).__name__}: {error}"
        ) from None
    if marks.ndim != 2 or marks.shape[1] != 3 or len(marks) < 2 or not np.isfinite(marks).all():
        raise UserError(
            f"rater script: {path} needs two marks or more: [seconds, pitch in degrees, airborne] in numbers"
        )
    if marks[0, 0] < 0 or not (np.diff(marks[:, 0]) > 0).all():
        raise UserError(f"rater script: the seconds of the marks in {path} must ascend from 0")
    if not np.isin(marks[:, 2], (0, 1)).all():
        raise UserError(f"rater script: airborne in {path} must be true or false")
    if marks[-1, 0] > demo.seconds:
        raise UserError(
            f"rater script: the marks in {path} go on until {marks[-1, 0]:.2f} s, but demo {demo.name!r} "
            f"lasts {demo.seconds:.2f} s; is it the table of another video?"
        )
    return marks


def _features(pitch: np.ndarray, spin: np.ndarray, airborne: np.ndarray) -> np.ndarray:
    turn = SPIN_WEIGHT * np.clip(spin, -_SPIN_LIMIT, _SPIN_LIMIT)
    return np.stack([np.sin(pitch), np.cos(pitch), turn, AIR_WEIGHT * airborne], axis=-1)
