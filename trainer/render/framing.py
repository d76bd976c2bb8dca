"""Which part of the pictures a clip shows: one scale for all sides, tight, and nothing that moves cut off.

Every side follows its mover along the track. Heights are the same on all sides, from the floor where
somebody is near it, so that a jump is seen beside a step; only movers at very different heights have a
height each. What is known beside the pictures (heights, the way along the track, head, foot and the first
outline) goes with them as numbers in metres, which the page draws (``static/player.js``).

Shapes: k moments, q positions. x is along the track, z above the floor, in metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from onedemo.render.clip_image import Side, fit
from onedemo.render.mover import Mover
from onedemo.render.renderer import (
    CAMERA_DISTANCE,
    CAMERA_HEIGHT,
    CLOSE_HEIGHT,
    CLOSE_WIDTH,
    CloseUp,
    Renderer,
)
from onedemo.robots.hopper import joint_points

_BESIDE, _ABOVE, _BELOW = 0.1, 0.12, 0.2
"""What is seen around the movers, and of the floor below them with its marks; metres."""
_LOWEST, _STEP = 1.15, 0.05
"""Heights of a view: at least, and in steps of, so that one clip looks like the next; metres."""
_NEAR_FLOOR = 0.6
"""Whoever comes so low is shown with the floor, metres."""
_APART = 2.1
"""Movers further apart in height have a height each, metres."""
_RADIUS = 0.06  # of the robot's limbs, at most
_GHOST = 160  # pixels a metre, of the drawing that an outline is taken from


@dataclass(frozen=True, kw_only=True, slots=True)
class Extent:
    """How far a mover reaches over a clip, metres."""

    left: float
    """From where a view that follows it aims at, negative to the left."""
    right: float
    """The same."""
    low: float
    """Above the floor."""
    high: float
    """The same."""


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """What one side shows, metres."""

    width: float
    height: float
    shift: float
    """How far its middle is beside what it follows."""
    bottom: float
    """Height of its lower edge."""


def views_of(extents: Sequence[Extent]) -> list[View]:
    """Views of one size, in which every mover stays for the whole clip."""
    across = max(e.right - e.left for e in extents) + 2 * _BESIDE
    low, high = min(e.low for e in extents), max(e.high for e in extents)
    together = high - low <= _APART or all(extent.low < _NEAR_FLOOR for extent in extents)
    lows, highs = ([low] * len(extents), [high] * len(extents)) if together else (
        [e.low for e in extents], [e.high for e in extents]
    )  # fmt: skip
    bottoms = [-_BELOW if near < _NEAR_FLOOR else near - _ABOVE for near in lows]
    tall = max(high + _ABOVE - bottom for high, bottom in zip(highs, bottoms, strict=True))
    height = max(tall, across * CLOSE_HEIGHT / CLOSE_WIDTH, _LOWEST)
    height = _STEP * math.ceil(height / _STEP - 1e-9)
    return [
        View(
            width=height * CLOSE_WIDTH / CLOSE_HEIGHT,
            height=height,
            shift=(extent.left + extent.right) / 2,
            # What is left over is above, but for some of the floor.
            bottom=bottom - min(0.15, (height - (high + _ABOVE - bottom)) / 3),
        )
        for extent, bottom, high in zip(extents, bottoms, highs, strict=True)
    ]


def clip_sides(
    renderer: Renderer, film: np.ndarray, mover: Mover | None, robots: Sequence[np.ndarray]
) -> list[Side]:
    """The sides of a clip: the demo, and each robot drawn at its scale.

    Args:
        renderer: Draws.
        film: The demo's pictures, (k, H, W, 3), uint8 RGB.
        mover: What moves in just these; None where that is unknown: they are shown whole.
        robots: Positions, (k, q) each.
    """
    tracks = [_Track.of(qpos) for qpos in robots]
    extents = [track.extent for track in tracks]
    if mover is None:
        views = views_of(extents)
        return [_whole(film), *(_drawn(renderer, *pair) for pair in zip(tracks, views, strict=True))]
    first, *others = views_of([_extent(mover), *extents])
    if _beyond(film, mover, first):
        return clip_sides(renderer, film, None, robots)
    drawn = [_drawn(renderer, *pair) for pair in zip(tracks, others, strict=True)]
    return [_cut(film, mover, first), *drawn]


def film_sides(films: Sequence[np.ndarray], movers: Sequence[Mover | None]) -> list[Side]:
    """The sides of a clip of videos alone, as ``clip_sides``."""
    if any(mover is None for mover in movers):
        return [_whole(film) for film in films]
    known = [mover for mover in movers if mover is not None]
    views = views_of([_extent(mover) for mover in known])
    if any(_beyond(*side) for side in zip(films, known, views, strict=True)):
        return [_whole(film) for film in films]
    return [_cut(*side) for side in zip(films, known, views, strict=True)]


# Videos


def _extent(mover: Mover) -> Extent:
    box, scale = mover.box, mover.scale
    return Extent(
        left=float((box[:, 0] - mover.aim).min() / scale),
        right=float((box[:, 2] - mover.aim).max() / scale),
        low=float((mover.floor - box[:, 3].max()) / scale),
        high=float((mover.floor - box[:, 1].min()) / scale),
    )


def _beyond(film: np.ndarray, mover: Mover, view: View) -> bool:
    """Whether a view is larger than the video, in which nothing but what moves is known."""
    tall, wide = film.shape[1:3]
    return mover.way is None and (view.width * mover.scale > wide or view.height * mover.scale > tall)


def _whole(film: np.ndarray) -> Side:
    return Side(pictures=np.stack([fit(frame, CLOSE_WIDTH, CLOSE_HEIGHT) for frame in film]))


def _cut(film: np.ndarray, mover: Mover, view: View) -> Side:
    """The view of a video at its own size: the page enlarges it, which costs nobody a larger file."""
    count, height, width = film.shape[:3]
    scale = mover.scale
    wide, tall = view.width * scale, view.height * scale
    left = mover.aim + view.shift * scale - wide / 2
    top = np.full(count, mover.floor - view.bottom * scale - tall)
    if mover.way is None:  # its edges may be anything: none is shown that need not be
        left = np.clip(left, 0, width - wide) if wide <= width else np.full(count, (width - wide) / 2)
        top = np.clip(top, 0, height - tall) if tall <= height else np.full(count, (height - tall) / 2)
    by = min(1.0, CLOSE_WIDTH / wide)
    size = (math.ceil(wide) + 2, math.ceil(tall) + 2)
    corners = np.stack([np.floor(left), np.floor(top)], axis=1).astype(int)
    pictures = [
        cv2.resize(cut, None, fx=by, fy=by, interpolation=cv2.INTER_AREA) if by < 1 else cut
        for cut in (_part(frame, corner, size, mover) for frame, corner in zip(film, corners, strict=True))
    ]
    offsets = by * (np.stack([left, top], axis=1) - corners)
    seen = [by * wide, by * tall]
    # From here on in metres: x is counted from where the camera, or the picture, was at first.
    middle, way = (0.0, np.zeros(count)) if mover.way is None else (width / 2, mover.way)

    def place(track: np.ndarray) -> np.ndarray:
        return np.stack([way + (track[:, 0] - middle) / scale, (mover.floor - track[:, 1]) / scale], axis=1)

    known: dict[str, Any] = {
        "seen": _numbers(seen), "offsets": _numbers(offsets), "width": round(view.width, 3),
        "left": _numbers(way + (left - middle) / scale),
        "bottom": round(float((mover.floor - top[0] - tall) / scale), 3),
    }  # fmt: skip
    if mover.way is not None:
        known |= {"eye": _numbers(way), "camera": [CAMERA_HEIGHT, CAMERA_DISTANCE]}
    if mover.head is not None and mover.foot is not None:
        known |= {"head": _numbers(place(mover.head)), "foot": _numbers(place(mover.foot))}
    if len(mover.outlines[0]) > 2:
        x, z = mover.outlines[0].T
        known["ghost"] = _numbers(
            np.stack([way[0] + (x - middle) / scale, (mover.floor - z) / scale], axis=1)
        )
    return Side(pictures=np.stack(pictures), known=known)


def _part(frame: np.ndarray, corner: np.ndarray, size: tuple[int, int], mover: Mover) -> np.ndarray:
    """A part of a picture; what is beyond its edges goes on as they are."""
    (x, y), (wide, tall) = corner, size
    height, width = frame.shape[:2]
    inside = frame[max(y, 0) : max(y + tall, 1), max(x, 0) : max(x + wide, 1)]
    if inside.shape[:2] == (tall, wide):
        return inside
    edges = (max(-y, 0), max(y + tall - height, 0), max(-x, 0), max(x + wide - width, 0))
    kind = cv2.BORDER_REPLICATE if mover.way is not None else cv2.BORDER_CONSTANT
    return cv2.copyMakeBorder(inside, *edges, kind, value=(236, 238, 241))


# The robot


@dataclass(frozen=True, slots=True)
class _Track:
    """A robot's way through a clip."""

    qpos: np.ndarray
    points: dict[str, np.ndarray]
    aim: np.ndarray

    @staticmethod
    def of(qpos: np.ndarray) -> _Track:
        points = joint_points(qpos)
        return _Track(qpos, points, np.mean([point[:, 0] for point in points.values()], axis=0))

    @property
    def extent(self) -> Extent:
        every = np.stack(list(self.points.values()))
        x, z = every[..., 0] - self.aim, every[..., 1]
        return Extent(
            left=float(x.min() - _RADIUS), right=float(x.max() + _RADIUS),
            low=float(z.min() - _RADIUS), high=float(z.max() + _RADIUS),
        )  # fmt: skip


def _drawn(renderer: Renderer, track: _Track, view: View) -> Side:
    middle = track.aim + view.shift
    close = CloseUp(
        width=CLOSE_WIDTH, height=CLOSE_HEIGHT, scale=CLOSE_HEIGHT / view.height, bottom=view.bottom
    )
    foot = (track.points["heel"] + track.points["toe"]) / 2
    known = {
        "width": round(view.width, 3), "left": _numbers(middle - view.width / 2),
        "bottom": round(view.bottom, 3), "eye": _numbers(middle),
        "camera": [CAMERA_HEIGHT, CAMERA_DISTANCE],
        "head": _numbers(track.points["top"]), "foot": _numbers(foot),
        "ghost": _numbers(_silhouette({name: point[0] for name, point in track.points.items()})),
    }  # fmt: skip
    return Side(pictures=renderer.close_ups(track.qpos, middle, close), known=known)


_LIMBS = (("top", "hip", 0.05), ("hip", "knee", 0.05), ("knee", "ankle", 0.04), ("heel", "toe", 0.06))


def _silhouette(points: dict[str, np.ndarray]) -> np.ndarray:
    """The outline of a pose, (n, 2), metres; of its joints, (2,) each."""
    corner = np.min(list(points.values()), axis=0) - 0.1
    extent = np.max(list(points.values()), axis=0) + 0.1 - corner
    drawing = np.zeros((math.ceil(extent[1] * _GHOST), math.ceil(extent[0] * _GHOST)), np.uint8)
    for begin, end, radius in _LIMBS:
        ends = [tuple(int(v) for v in (points[name] - corner) * _GHOST) for name in (begin, end)]
        cv2.line(drawing, ends[0], ends[1], 1, round(2 * radius * _GHOST))
    found, _ = cv2.findContours(drawing, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return corner + cv2.approxPolyDP(max(found, key=cv2.contourArea), 1.0, True)[:, 0] / _GHOST


def _numbers(values: Any) -> list[Any]:
    """As JSON, to the millimetre or the thousandth of a pixel."""
    return np.round(np.asarray(values, float), 3).tolist()
