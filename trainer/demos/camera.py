"""Where a video is looked at: with its background held still, or along with what moves.

A video is gone through once, small (``Survey``); then each of its pictures is cut (``View``).

Shapes: n pictures, m of them that are surveyed for what moves, H rows, W columns; pictures are uint8 RGB.
Places are pixels from the upper left corner; a motion maps those of a picture to those of the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from onedemo.demos.frame_geometry import (
    Box,
    angle_and_shift,
    inner_edges,
    motion,
    overlap,
    resized,
    scaled,
)
from onedemo.demos.import_checks import MIN_SIDE
from onedemo.errors import UserError

_CALM_SECONDS = 0.3
"""Over which the way of a crop is smoothed, as they are shown."""
_ROOM = 1.5
"""Sides of a crop, in sides of what it follows."""
_NARROWEST = 0.75
"""One side of such a crop by the other, at least."""
_SMALL_SIDE, _MOST_SMALL = 240, 600
"""Pictures in which the mover is looked for: pixels of their longer side, and how many."""
_HELD_SIDE = 640
"""Pixels, of the longer side of the pictures in which the background is looked for."""
_MOST_POINTS, _FEWEST_POINTS = 400, 16
_SPREAD = 0.4
"""Share of the picture's width over which points of the background lie, at least."""
_NEAR = 1.5
"""Pixels within which points agree on the way of the camera."""
_STILL = 0.5
"""Pixels: a background that moves less stands still."""
_LEAST_LEFT = 0.5
"""Of each side of the picture, once its edges are gone."""
_OTHER = 30
"""Difference of a colour from the background's, of 255, that something before it makes."""
_LEAST_SEEN = 0.7
"""Share of the pictures in which what moves is seen."""


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """What of each picture is wanted."""

    box: Box | None = None
    """x, y, width, height; the first two only where nothing is followed. None: all of it."""
    times: np.ndarray | None = None
    """Of the pictures that were surveyed, seconds, (n,)."""
    poses: np.ndarray | None = None
    """Angle in radians and shift in pixels that lay a picture's background on that of the first, (n, 3)."""
    corners: np.ndarray | None = None
    """Upper left corner of the crop, (n, 2)."""

    def cut(self, seconds: float, picture: np.ndarray) -> np.ndarray:
        """The part of a picture, (H, W, 3), that is wanted at a moment; perhaps without a copy."""
        if self.box is None:
            return picture
        x, y, width, height = self.box
        if self.corners is not None:
            x, y = (round(float(place)) for place in self._at(seconds, self.corners))
        if self.poses is None:
            return picture[y : y + height, x : x + width]
        shift = np.array([[1.0, 0, -x], [0, 1, -y], [0, 0, 1]])
        moved = (shift @ motion(*self._at(seconds, self.poses)))[:2]
        return cv2.warpAffine(
            np.ascontiguousarray(picture), moved, (width, height), flags=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip

    def _at(self, seconds: float, track: np.ndarray) -> np.ndarray:
        assert self.times is not None
        return np.array([np.interp(seconds, self.times, values) for values in track.T])


class Survey:
    """Goes through a video to find its background, what moves before it, or both.

    Args:
        name: What sentences call the video.
        size: Width and height of its pictures.
        crop: x, y, width, height of the part that is wanted; None: all.
        track: Whether the crop follows what moves in it at first; without one, whatever moves.
        stabilise: Whether the background is held still.
        speed: Seconds of the video that one second shows.
    """

    def __init__(
        self, name: str, size: tuple[int, int], *, crop: Box | None, track: bool, stabilise: bool,
        speed: float,
    ) -> None:  # fmt: skip
        self._name, self._size, self._crop, self._track, self._speed = name, size, crop, track, speed
        self._background = _Background(name) if stabilise else None
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._small: list[tuple[int, np.ndarray]] = []
        self._every = 1

    def see(self, seconds: float, picture: np.ndarray) -> None:
        """Takes the next picture, (H, W, 3).

        Raises:
            UserError: If its background cannot be found.
        """
        number = len(self._times)
        self._times.append(seconds)
        if self._background is not None:
            small = scaled(picture, _HELD_SIDE)
            pose = self._background.find(seconds, cv2.cvtColor(small, cv2.COLOR_RGB2GRAY))
            self._poses.append(resized(pose, small.shape, picture.shape))
        if self._track and number % self._every == 0:
            self._small.append((number, scaled(picture, _SMALL_SIDE)))
            if len(self._small) > _MOST_SMALL:
                self._every *= 2
                self._small = self._small[::2]

    def view(self, warn: Callable[[str], object]) -> View:
        """What of each picture is wanted.

        Raises:
            UserError: If nothing can be followed, or too little is left of a picture that is held still.
        """
        width, height = self._size
        room, poses = (0, 0, width, height), None
        if self._background is not None:
            poses = self._held(warn)
        if poses is not None:
            room = _left(self._poses, self._size, self._name)
        times = np.array(self._times)
        if not self._track:
            box = overlap(room, self._crop) if self._crop else room
            if min(box[2:]) < MIN_SIDE:
                raise UserError(
                    f"--crop {','.join(map(str, self._crop or ()))} leaves nothing of {self._name} once its "
                    "background is held still: choose a part nearer to the middle of the picture"
                )
            return View(box=box, times=times, poses=poses)
        boxes, numbers = self._mover(room, poses)
        size, corners = _follow(
            times[numbers], boxes, room, self._crop[2:] if self._crop else None, _CALM_SECONDS * self._speed
        )
        if size[0] > 0.95 * room[2] and size[1] > 0.95 * room[3]:
            warn("what moves fills the whole picture, so --track changes nothing")
        every = np.stack([np.interp(times, times[numbers], places) for places in corners.T], axis=1)
        return View(box=(0, 0, *size), times=times, poses=poses, corners=every)

    def _held(self, warn: Callable[[str], object]) -> np.ndarray | None:
        """The poses of all pictures, (n, 3); None if the background stands still as it is."""
        poses = np.array([angle_and_shift(pose) for pose in self._poses])
        if np.abs(inner_edges(self._poses, self._size) - inner_edges([np.eye(3)], self._size)).max() < _STILL:
            warn("the background stands still as it is, so --stabilise changes nothing")
            return None
        return poses

    def _mover(self, room: Box, poses: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Left, top, right and bottom of what moves, (m, 4), in the pictures of these numbers, (m,)."""
        from onedemo.render.mover import locate  # with it comes MuJoCo, for the studio's measures

        shape = self._small[0][1].shape
        by = np.array([shape[1] / self._size[0], shape[0] / self._size[1]])
        left, top = (math.ceil(place) for place in room[:2] * by)
        right, bottom = (int(place) for place in np.add(room[:2], room[2:]) * by)
        pictures = []
        for number, small in self._small:
            if poses is not None:
                moved = resized(motion(*poses[number]), self._size[::-1], shape)
                small = cv2.warpAffine(small, moved[:2], shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
            pictures.append(small[top:bottom, left:right])
        self._small, numbers = [], np.array([number for number, _ in self._small])
        all_of_them, boxes = np.stack(pictures), None
        if self._crop is not None:
            begin = (np.array(self._crop).reshape(2, 2) * by - [[left, top], [0, 0]]).ravel()
            boxes = _in_rectangle(all_of_them, begin)
        elif (mover := locate(all_of_them)) is not None:
            boxes = mover.box
        if boxes is None:
            where = f"the rectangle of --crop at the beginning of {self._name}" if self._crop else self._name
            others = "" if self._background else "add --stabilise if the camera shakes, "
            raise UserError(
                f"--track finds nothing in {where} that moves before a background that stands still; "
                f"{others}choose another part with --start and --end, or leave it out"
            )
        return (boxes + np.array([left, top, left, top])) / np.tile(by, 2), numbers


class _Background:
    """Finds where the background of each picture lies in the first one, by points that move as one."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._first: np.ndarray | None = None
        self._points = np.empty((0, 1, 2), np.float32)
        self._base = self._last = np.eye(3)

    def find(self, seconds: float, grey: np.ndarray) -> np.ndarray:
        """The matrix of the next picture, (H, W) uint8.

        Raises:
            UserError: If too little is as it was in the pictures before.
        """
        if self._first is None:
            self._begin(grey, np.eye(3))
            return self._last
        found, share = self._match(grey)
        if found is None:
            raise UserError(
                f"--stabilise finds no background in {self._name} at {seconds:.2f} s that is that of before "
                "(a cut, a plain wall, or a camera that goes away); choose a part with --start and --end, or "
                "leave it out"
            )
        self._last = self._base @ found
        if share < 0.5:  # the camera is on its way: what it sees now is what it is followed by
            self._begin(grey, self._last)
        return self._last

    def _begin(self, grey: np.ndarray, pose: np.ndarray) -> None:
        points = cv2.goodFeaturesToTrack(grey, _MOST_POINTS, 0.01, 7)
        self._first, self._base, self._last = grey, pose, pose
        self._points = np.empty((0, 1, 2), np.float32) if points is None else points

    def _match(self, grey: np.ndarray) -> tuple[np.ndarray | None, float]:
        """How a picture lies in the one with the points, and the share of them that say so."""
        assert self._first is not None
        if len(self._points) < _FEWEST_POINTS:
            return None, 0.0
        near = np.linalg.inv(np.linalg.inv(self._base) @ self._last)
        guess = cv2.perspectiveTransform(self._points, near).astype(np.float32)
        there, seen, _ = cv2.calcOpticalFlowPyrLK(
            self._first, grey, self._points, guess.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        back, again, _ = cv2.calcOpticalFlowPyrLK(
            grey, self._first, there, self._points.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        sure = np.logical_and(seen, again)[:, 0] & (np.abs(back - self._points).max(axis=(1, 2)) < 1)
        now, before = there[sure, 0], self._points[sure, 0]
        if len(now) < _FEWEST_POINTS:
            return None, 0.0
        matrix, agree = cv2.estimateAffinePartial2D(now, before, ransacReprojThreshold=_NEAR)
        if matrix is None:
            return None, 0.0
        agree = agree[:, 0].astype(bool)
        now, before = now[agree].astype(float), before[agree].astype(float)
        zoom = math.hypot(matrix[0, 0], matrix[1, 0])
        if len(now) < _FEWEST_POINTS or np.ptp(now[:, 0]) < _SPREAD * grey.shape[1] or abs(zoom - 1) > 0.1:
            return None, 0.0
        turn = motion(math.atan2(matrix[1, 0], matrix[0, 0]), 0, 0)
        turn[:2, 2] = (before - now @ turn[:2, :2].T).mean(axis=0)
        return turn, len(now) / len(self._points)


def _in_rectangle(pictures: np.ndarray, rectangle: np.ndarray) -> np.ndarray | None:
    """What moves in a rectangle at first, and then in one around where it was last: others are left alone.

    Args:
        pictures: (m, H, W, 3).
        rectangle: x, y, width, height.

    Returns:
        Left, top, right, bottom in each picture, (m, 4); None if it is seen in too few.
    """
    background = np.median(pictures[:: max(1, len(pictures) // 48)], axis=0).astype(np.uint8)
    middle, half = rectangle[:2] + rectangle[2:] / 2, rectangle[2:] / 2
    boxes = np.full((len(pictures), 4), np.nan)
    for box, picture in zip(boxes, pictures, strict=True):
        other = (cv2.absdiff(picture, background).max(axis=2) > _OTHER).astype(np.uint8)
        other = cv2.morphologyEx(other, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        places = np.argwhere(other)[:, ::-1] + 0.5
        for _ in range(4):  # to where most of it is
            inside = places[(np.abs(places - middle) <= half).all(axis=1)]
            if len(inside) < max(6, 0.02 * 4 * half.prod()):
                break
            middle = inside.mean(axis=0)
            box[:2], box[2:] = np.percentile(inside, [2, 98], axis=0)
    seen = ~np.isnan(boxes[:, 0])
    if seen.mean() < _LEAST_SEEN:
        return None
    numbers = np.arange(len(boxes))
    return np.stack([np.interp(numbers, numbers[seen], side[seen]) for side in boxes.T], axis=1)


def _follow(
    times: np.ndarray, boxes: np.ndarray, room: Box, size: tuple[int, int] | None, calm: float
) -> tuple[tuple[int, int], np.ndarray]:
    """A crop that goes along with what moves.

    It follows what moves along the ground. Up and down it stands still, so that heights can be seen, unless
    what moves would leave it.

    Args:
        times: When, seconds, (m,).
        boxes: Left, top, right, bottom of what moves, (m, 4).
        room: Where the crop may be.
        size: Its width and height; None: as large as what moves asks for.
        calm: Seconds over which its way is smoothed.

    Returns:
        Its width and height, and its upper left corner each time, (m, 2).
    """
    left, top, right, bottom = boxes.T
    wide, high = np.percentile(right - left, 95), np.percentile(bottom - top, 95)
    highest, lowest = np.percentile(top, 1), np.percentile(bottom, 99)
    if size is None:
        tall = 1.2 * (lowest - highest) if lowest - highest < 2 * high else _ROOM * high
        width = max(_ROOM * wide, _NARROWEST * tall)
        height = max(tall, _NARROWEST * width)
    else:
        width, height = size
    width, height = (2 * round(max(MIN_SIDE, side) / 2) for side in (width, height))
    width, height = min(width, room[2] // 2 * 2), min(height, room[3] // 2 * 2)
    x = _calmed(times, (left + right) / 2, calm)
    if lowest - highest <= height:
        y = np.full(len(times), (highest + lowest) / 2)
    else:
        y = _calmed(times, (top + bottom) / 2, calm)
    corners = np.stack([x - width / 2, y - height / 2], axis=1)
    return (width, height), np.clip(
        corners, room[:2], [room[0] + room[2] - width, room[1] + room[3] - height]
    )


def _calmed(times: np.ndarray, values: np.ndarray, calm: float) -> np.ndarray:
    """Values without their haste, (m,): lines laid through those around, which do not lag at the ends."""
    apart = times[None, :] - times[:, None]
    weights = np.exp(-0.5 * (apart / calm) ** 2)
    total, first, second = (np.sum(weights * apart**power, axis=1) for power in (0, 1, 2))
    sums, moments = weights @ values, (weights * apart) @ values
    spread = total * second - first**2
    flat = spread < 1e-12 * total * second + 1e-12
    line = (second * sums - first * moments) / np.where(flat, 1, spread)
    return np.where(flat, sums / total, line)


def _left(matrices: list[np.ndarray], size: tuple[int, int], name: str) -> Box:
    """What of the first picture all pictures show, upright; raises UserError if it is too little."""
    (left, top), (right, bottom) = inner_edges(matrices, size)
    width, height = size
    x, y = max(0, math.ceil(left)), max(0, math.ceil(top))
    box = (x, y, min(width, math.floor(right)) - x, min(height, math.floor(bottom)) - y)
    if box[2] < _LEAST_LEFT * width or box[3] < _LEAST_LEFT * height:
        raise UserError(
            f"--stabilise would leave {max(0, box[2])} x {max(0, box[3])} of {width} x {height} pixels of "
            f"{name}, as its camera goes so far; choose a part with --start and --end, or leave it out"
        )
    return box
