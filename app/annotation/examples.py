"""Examples of ratings: moments of the demo beside others, so far apart that people agree on them. Pure.

How far apart two moments are is told by what the pose estimator sees in the frames, never by the states
behind a demo; frames in which it is not sure are left alone. The other side is of the same demo, or of
another move of the same robot, since a quiet move has no moments that are far apart. Where no robot is seen,
only the same moment twice is certain, and nothing else is shown.

Shapes: F frames of a demo, L frames of a clip, M = F - L + 1 moments of the demo at which a clip may begin, N
those of all demos, its own first.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.robots.robot import Robot
from onedemo.sim.kinematics import HEIGHT_SCALE, body_of
from onedemo.vision.pose_estimator import Track

_LIMBS = 1.23
"""Sum of the squared weights of all limbs (``Body.weights``), beside 1 of the root: however many there are,
people see the robot as a whole."""
_BANDS = {5: (0.0, 0.0), 4: (0.75, 0.95), 3: (1.25, 1.45), 2: (1.7, 1.9), 1: (2.8, np.inf)}
"""Distances at which a clip is a clear case of a rating; 1 is a difference that is seen at once."""
_PRACTICE = (5, 1, 3, 4, 2)
"""Ratings of the practice clips, in order."""
_LETTERS = str.maketrans("0123456789", "abcdefghij")
_APART = 8
"""So many frames at least lie between the two sides of an example, unless they are the same."""
_MOST_DOUBT = 0.45
"""Frames of which the pose estimator is less sure are not compared."""
_STEPS = (0.45, 0.95, 1.6, 2.3)
"""Distances of a part from which on the next words are said of it."""
_SINGULAR = ("fits", "is a little off", "differs clearly", "differs a lot", "has nothing in common")
_PLURAL = ("fit", "are a little off", "differ clearly", "differ a lot", "have nothing in common")


@dataclass(frozen=True, kw_only=True, slots=True)
class Example:
    """A moment of the demo beside another, or beside one of another demo."""

    left: int
    """First frame of the left side."""
    right: int
    """First frame of the right side."""
    source: str = ""
    """The demo of the right side; "" if it is the same."""
    rating: int
    """What we would give."""
    why: str
    """What fits and what does not, one or two sentences."""

    @property
    def name(self) -> str:
        """Names its picture, for good: demo and frames, in up to 15 letters."""
        source = f"x{zlib.crc32(self.source.encode()) % 1000}" if self.source else ""
        return f"{self.left}x{self.right}{source}".translate(_LETTERS)

    @property
    def right_ratings(self) -> tuple[int, ...]:
        """What sensible people give: in between, the next ones too."""
        return (self.rating,) if self.rating in (1, 5) else (self.rating - 1, self.rating, self.rating + 1)


@dataclass(frozen=True, kw_only=True, slots=True)
class Examples:
    """What is shown of one demo."""

    guide: tuple[Example, ...]
    """For the guide, at most one for each rating, in the order of the scale."""
    practice: tuple[Example, ...]
    """Others, to practise with, in order."""


def choose(
    track: Track | None, frames: int, length: int, others: Mapping[str, Track] | None = None,
    robot: Robot | None = None,
) -> Examples:  # fmt: skip
    """Chooses the examples of a demo.

    Args:
        track: What its frames show of the robot; None if that is not known.
        frames: F.
        length: L.
        others: The same of other demos of the robot, by name.
        robot: The robot; the hopper if None.
    """
    if track is None:
        middle = (frames - length) // 2
        same = [Example(left=n, right=n, rating=5, why=_why(5, 0, 0)) for n in (middle, middle // 2)]
        return Examples(guide=tuple(same[:1]), practice=tuple(same[1:]))
    chooser = _Chooser({"": track, **(others or {})}, length, weights_of(robot or robot_named(DEFAULT)))
    guide = [chooser.next(rating) for rating in (1, 2, 3, 4, 5)]
    practice = [chooser.next(rating) for rating in _PRACTICE]
    more = [example.rating for example in practice if example is not None]
    practice += [chooser.next(rating) for rating in more[: practice.count(None)]]
    return Examples(
        guide=tuple(example for example in guide if example is not None),
        practice=tuple(example for example in practice if example is not None),
    )


class _Chooser:
    """Takes one pair of moments after another, each apart from those before.

    Args:
        tracks: Of the demo, and of others by name.
        length: L.
        weights: How much each axis and end counts, (A + K,).
    """

    def __init__(self, tracks: Mapping[str, Track], length: int, weights: np.ndarray) -> None:
        moments = [len(track.pose) - length + 1 for track in tracks.values()]
        self._where = [(name, n) for name, count in zip(tracks, moments, strict=True) for n in range(count)]
        # Frames of other demos are far from all of this one.
        self._at = np.concatenate([1e6 * k + np.arange(count) for k, count in enumerate(moments)])
        self._apart, self._own = max(4, length // 2), moments[0]
        self._pose, self._pace, self._distance = _distances(list(tracks.values()), length, weights)
        lively = _by_moment([np.linalg.norm(track.motion, axis=1) for track in tracks.values()], length)
        doubt = _by_moment([_doubt(track) for track in tracks.values()], length)
        # A clip in which something happens is better than one in which nothing does.
        moment = 2 * doubt - lively / max(lively.max(), 1e-9) + 0.2 * (self._at >= 1e6)
        self._cost = moment[: self._own, None] + moment
        self._gap = np.abs(self._at[: self._own, None] - self._at)
        sure = doubt <= _MOST_DOUBT
        self._open = ((self._gap >= _APART) & sure[: self._own, None] & sure) | (self._gap == 0)

    def next(self, rating: int) -> Example | None:
        """The best pair for a rating that is left, or None if no pair is a clear case of it."""
        low, high = _BANDS[rating]
        fits = self._open & (self._distance >= low) & (self._distance <= high)
        fits &= (self._gap == 0) == (rating == 5)
        if not fits.any():
            return None
        cost = np.where(fits, self._cost, np.inf)
        left, right = map(int, np.unravel_index(np.argmin(cost), cost.shape))
        for one, other in ((left, right), (right, left)):  # not these two again, in whichever order
            near = [np.abs(self._at - self._at[n]) < self._apart for n in (one, other)]
            self._open &= ~(near[0][: self._own, None] & near[1])
            self._cost = self._cost + near[0][: self._own, None] + near[0]  # nor either of them, if possible
        source, frame = self._where[right]
        why = _why(rating, self._pose[left, right], self._pace[left, right])
        return Example(left=left, right=frame, source=source, rating=rating, why=why)


def _by_moment(of_frames: Sequence[np.ndarray], length: int) -> np.ndarray:
    """Means over the clip from each moment on, of all demos, (N,)."""
    return np.concatenate([np.convolve(x, np.ones(length) / length, "valid") for x in of_frames])


def _doubt(track: Track) -> np.ndarray:
    return track.doubt if track.doubt is not None else np.zeros(len(track.pose))


def weights_of(robot: Robot) -> np.ndarray:
    """How much each axis and each end of a robot's pose counts, (A + K,): the root's axes first.

    Ends count nothing: directions all but tell where they are.
    """
    body = body_of(robot)
    axes = 1 if body.planar else 3  # of the root
    limbs = body.weights[axes:]
    limbs = limbs * np.sqrt(_LIMBS / max(np.square(limbs).sum(), 1e-9))
    ends = (body.pose_size - 1) // 2 - len(body.weights)
    return np.concatenate([np.full(axes, 1 / np.sqrt(axes)), limbs, np.zeros(ends)])


def _seen(track: Track, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a person sees of each frame, in units of what is seen at once: pose (F, P) and pace (F, 2).

    Sideways motion is not part of it: the camera follows.
    """
    pose = np.concatenate([track.pose[:, :1], track.pose[:, 1:] * np.repeat(weights, 2)], axis=1)
    spin = track.motion[:, 1] * track.pose[:, 2] - track.motion[:, 2] * track.pose[:, 1]
    return pose, np.stack([spin, track.motion[:, 0] / HEIGHT_SCALE], axis=1)


def _distances(tracks: Sequence[Track], length: int, weights: np.ndarray) -> np.ndarray:
    """Mean distance of the frames of two clips, by their moments: in pose, in pace, in all; (3, M, N)."""
    seen = [_seen(track, weights) for track in tracks]
    moments = [len(track.pose) - length + 1 for track in tracks]
    answer = np.zeros((3, moments[0], sum(moments)))
    for offset in range(length):
        squares = []
        for part in (0, 1):
            there = [x[part][offset : offset + count] for x, count in zip(seen, moments, strict=True)]
            squares.append(np.square(there[0][:, None] - np.concatenate(there)).sum(-1))
        answer += np.sqrt([*squares, squares[0] + squares[1]]) / length
    return answer


def _why(rating: int, pose: float, pace: float) -> str:
    """What to say of two clips, from how far apart they are in pose and in pace."""
    if rating == 5:
        return "Both sides show the same moment, so you could take one for the other."
    one, other = (sum(distance > step for step in _STEPS) for distance in (pose, pace))
    if one == other:
        return f"Pose, direction and pace {_PLURAL[one]}."
    return f"The pose {_SINGULAR[one]}; direction and pace {_PLURAL[other]}."
