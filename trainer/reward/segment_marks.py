"""Where a clip goes wrong: a marked stretch counts in training as worse than the rest of its clip.

The paper leaves this to future work. The metric takes the marked steps to be further off than the others
(``trainer/reward/learned_distance.py``). For the network, a rating with a mark becomes two: the others get
a point more.
Each part is drawn out to the length of a clip by repeating steps, so that a fit need not know of marks.

Shapes: n ratings, W control steps a clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from onedemo.demos.frame_clock import frame_of_step
from onedemo.storage.rating_records import RatedSegment
from onedemo.types import Clip, Demo, Segment

Mark = tuple[int, int]
"""A stretch of a clip, in control steps or in pictures: the first, and the one after the last."""
INSIDE, OUTSIDE = 0, 1
"""Points that the marked steps and the others differ from the rating of their clip."""


def picture_of_step(clip: Clip, dt: float, demo: Demo) -> np.ndarray:
    """Which picture of a clip is on screen at each of its control steps: (W,), from 0 on.

    A picture stays until the step at which the next one is due, so pictures are of unequal length: 4 or 5
    steps at 30 per second and 0.008 s.

    Args:
        clip: W steps.
        dt: Seconds of a control step.
        demo: What is beside it.
    """
    shown = frame_of_step(clip.demo_step + np.arange(clip.steps), dt, demo.fps, demo.frames)
    return np.unique(shown, return_inverse=True)[1]


def steps_of_pictures(pictures: Mark, picture_of_step: np.ndarray) -> Mark:
    """The control steps of a clip during which some of its pictures are on screen.

    Args:
        pictures: The first of them, and the one after the last.
        picture_of_step: As of that function.

    Raises:
        ValueError: If they are no stretch of the clip's pictures.
    """
    first, after = pictures
    count = int(picture_of_step[-1]) + 1
    if not 0 <= first < after <= count:
        raise ValueError(f"a mark is a stretch of the clip's {count} pictures, got {pictures}")
    start, end = np.searchsorted(picture_of_step, pictures).tolist()
    return start, end


def pictures_of_steps(steps: Mark, picture_of_step: np.ndarray) -> Mark:
    """The pictures that are on screen during some of a clip's steps: first, and the one after the last."""
    return int(picture_of_step[steps[0]]), int(picture_of_step[steps[1] - 1]) + 1


def marked_steps(rating: RatedSegment) -> np.ndarray:
    """1 at the steps inside a rating's mark, else 0: (W,), float32."""
    inside = np.zeros(len(rating.segment), np.float32)
    if rating.mark is not None:
        inside[slice(*rating.mark)] = 1
    return inside


def split_marks(
    ratings: Sequence[RatedSegment], frames: np.ndarray
) -> tuple[Sequence[RatedSegment], np.ndarray]:
    """Makes two ratings of each with a mark; without any mark all stays as it is.

    Args:
        ratings: n rated segments, all of W steps.
        frames: Demo frame at each step of each segment, (n, W).

    Returns:
        The same of m >= n ratings, none with a mark.
    """
    if not any(rating.mark for rating in ratings):
        return ratings, frames
    parts, rows = [], []
    for rating, row in zip(ratings, frames, strict=True):
        inside = marked_steps(rating) > 0
        if inside.all() or not inside.any():
            parts.append(replace(rating, mark=None))
            rows.append(row)
            continue
        for chosen, change in ((inside, INSIDE), (~inside, OUTSIDE)):
            at = _drawn_out(np.flatnonzero(chosen), len(inside))
            segment = rating.segment
            cut = {name: getattr(segment, name)[at] for name in ("obs", "actions", "qpos", "qvel")}
            value = min(5, max(1, rating.value + change))
            parts.append(replace(rating, segment=Segment(**cut), value=value, mark=None))
            rows.append(row[at])
    return parts, np.stack(rows)


def _drawn_out(at: np.ndarray, length: int) -> np.ndarray:
    """So many entries of ``at``, in order and as evenly as can be."""
    return at[np.arange(length) * len(at) // length]
