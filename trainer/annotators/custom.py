"""A user's own rater: a class with one method, given both clips as a person would see them.

``onedemo train --rater package.module:Class`` finds it in the current directory or among what is
installed, and makes it without arguments:

    class Class:
        def rate(self, demo_frames, agent_frames, segment) -> int | None: ...

Nothing that learns may import this module.

Shapes: n frames, H = 360 rows, W = 480 columns.
"""

from __future__ import annotations

import difflib
import importlib
import operator
import os
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from onedemo.annotators.base import Budget
from onedemo.demos.frame_clock import frame_of_step
from onedemo.demos.library import read_frames
from onedemo.errors import UserError
from onedemo.render.clip_image import fit
from onedemo.robots.registry import robot_named
from onedemo.types import Demo, Segment


class OwnRater(Budget):
    """Asks a class of the user's.

    Its ``rate`` gets the demo's clip and the robot's, each (n, H, W, 3), uint8 RGB, the same moments in
    both, scaled as on the rating page, and the robot's ``Segment``. It returns 1..5, or None to decline
    the clip. It is not given anything else of the demo.

    Args:
        name: ``package.module:Class``.
        demo: What is shown beside the robot.
        robot: Name of the robot.
        budget: Ratings it will give in all, enforced here.
        given: Ratings it gave before, in an earlier process.

    Raises:
        UserError: If there is no such class, or it cannot be made or asked.
    """

    def __init__(self, name: str, *, demo: Demo, robot: str = "hopper", budget: int, given: int = 0) -> None:
        super().__init__(budget, given)
        self.name = name
        self._rate = _find(name)
        self._demo, self._robot = demo, robot_named(robot)
        self._frames: np.ndarray | None = None
        self._renderer: Any = None

    def rate(self, segment: Segment, demo_step: int) -> int | None:
        """The rating, 1..5, or None: declined, which costs nothing of the budget.

        Raises:
            RatingBudgetSpent: If the budget is used up.
            UserError: If the user's class fails, or gives something else than a rating.
        """
        self.check()
        demo_frames, agent_frames = self._clips(segment, demo_step)
        try:
            value = self._rate(demo_frames, agent_frames, segment)
        except Exception as error:
            raise UserError(f"rater {self.name} failed: {_say(error)}") from error
        if value is None:
            return None
        rating = _whole(value)
        if rating is None or not 1 <= rating <= 5:
            raise UserError(
                f"rater {self.name} must give a whole number from 1 to 5, or None to decline; "
                f"it gave {value!r:.80}"
            )
        self.given += 1
        return rating

    def close(self) -> None:
        """Ends the thread that draws, if anything was drawn."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _clips(self, segment: Segment, demo_step: int) -> tuple[np.ndarray, np.ndarray]:
        """The pictures of ``training.clip_worker``: one of the robot for each frame of the demo's clip."""
        from onedemo.render.render_thread import RenderThread

        if self._frames is None:
            self._frames = read_frames(self._demo)
        if self._renderer is None:
            self._renderer = RenderThread()
        steps = demo_step + np.arange(len(segment))
        shown = frame_of_step(steps, self._robot.dt, self._demo.fps, self._demo.frames)
        index, first = np.unique(shown, return_index=True)
        agent = self._renderer.render(segment.qpos[first], self._robot).result()
        return np.stack([fit(frame) for frame in self._frames[index]]), agent


def _find(name: str) -> Callable[[np.ndarray, np.ndarray, Segment], object]:
    """The ``rate`` of a new object of the class ``package.module:Class``."""
    module_name, _, class_name = name.partition(":")
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)  # last: what lies there must not hide a library
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise UserError(f"rater {name}: {module_name} cannot be imported: {_say(error)}") from error
        raise UserError(
            f"rater {name}: there is no module {error.name!r}, neither in {here} nor installed"
        ) from None
    except Exception as error:
        raise UserError(f"rater {name}: {module_name} cannot be imported: {_say(error)}") from error
    made = getattr(module, class_name, None)
    if not isinstance(made, type):
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        near = difflib.get_close_matches(class_name, classes, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise UserError(f"rater {name}: module {module_name!r} has no class {class_name!r}{hint}")
    if not callable(getattr(made, "rate", None)):
        raise UserError(
            f"rater {name}: class {class_name} has no method rate(self, demo_frames, agent_frames, segment)"
        )
    try:
        return made().rate
    except Exception as error:
        raise UserError(f"rater {name}: {class_name}() failed: {_say(error)}") from error


def _whole(value: object) -> int | None:
    """A whole number, NumPy's included, as an int; None if it is none."""
    if isinstance(value, bool | np.bool_):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def _say(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
