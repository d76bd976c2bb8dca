"""Which part of the pictures a clip shows: one scale for all sides, tight, and nothing that moves cut off.

Every side follows its mover along the track. Heights are the same on all sides, from the floor where
somebody is near it, so that a jump is seen beside a step; only movers at very different heights have a
height each, and so has one that is seen from above. What is known beside the pictures (heights, the way
along the track, the paths of head and foot and the first outline) goes with them as numbers in metres,
which the page draws (``static/player.js``).

Shapes: k moments, q positions. x is along the track, z above the floor, in metres; the constants are those
of a robot that is seen from three metres.
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
    CLOSE_HEIGHT,
    CLOSE_WIDTH,
    CloseUp,
    Renderer,
)
from onedemo.render.stage import Shape
from onedemo.robots.camera import Camera
from onedemo.robots.robot import Robot, body_name, model_of
from onedemo.sim.kinematics import body_of

_BESIDE, _ABOVE, _BELOW = 0.1, 0.12, 0.2
"""What is seen around the movers, and of the floor below them with its marks; metres."""
_LOWEST, _STEP = 1.15, 0.05
"""Heights of a view: at least, and in steps of, so that one clip looks like the next; metres."""
_NEAR_FLOOR = 0.6
"""Whoever comes so low is shown with the floor, metres."""
_APART = 2.1
"""Movers further apart in height have a height each, metres."""
_FEET = 4
"""Of so many the paths are drawn."""


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
    grounded: bool = True
    """Whether there is a floor; else heights, too, are counted from what a view aims at."""


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """What one side shows, metres."""

    width: float
    height: float
    shift: float
    """How far its middle is beside what it follows."""
    bottom: float
    """Height of its lower edge."""


def views_of(extents: Sequence[Extent], size: float = 1.0) -> list[View]:
    """Views of one size, in which every mover stays for the whole clip.

    Args:
        extents: Of the movers.
        size: Of the robot, as ``Camera.size``.
    """
    across = max(e.right - e.left for e in extents) + 2 * _BESIDE * size
    low, high = min(e.low for e in extents), max(e.high for e in extents)
    level = _NEAR_FLOOR * size
    together = all(e.grounded for e in extents) and (
        high - low <= _APART * size or all(extent.low < level for extent in extents)
    )
    lows, highs = ([low] * len(extents), [high] * len(extents)) if together else (
        [e.low for e in extents], [e.high for e in extents]
    )  # fmt: skip
    bottoms = [
        min(near - _ABOVE * size, -_BELOW * size if extent.grounded and near < level else np.inf)
        for extent, near in zip(extents, lows, strict=True)
    ]
    tall = max(high + _ABOVE * size - bottom for high, bottom in zip(highs, bottoms, strict=True))
    height = max(tall, across * CLOSE_HEIGHT / CLOSE_WIDTH, _LOWEST * size)
    step = _STEP * size
    height = step * math.ceil(height / step - 1e-9)
    return [
        View(
            width=height * CLOSE_WIDTH / CLOSE_HEIGHT,
            height=height,
            shift=(extent.left + extent.right) / 2,
            # What is left over is above, but for some of the floor.
            bottom=bottom - min(0.15 * size, (height - (high + _ABOVE * size - bottom)) / 3),
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
    camera = renderer.robot.camera
    tracks = [_Track.of(renderer, qpos) for qpos in robots]
    extents = [track.extent for track in tracks]
    if mover is None:
        views = views_of(extents, camera.size)
        return [_whole(film), *(_drawn(renderer, *pair) for pair in zip(tracks, views, strict=True))]
    first, *others = views_of([_extent(mover), *extents], camera.size)
    if _beyond(film, mover, first):
        return clip_sides(renderer, film, None, robots)
    drawn = [_drawn(renderer, *pair) for pair in zip(tracks, others, strict=True)]
    return [_cut(film, mover, first, camera), *drawn]


def film_sides(films: Sequence[np.ndarray], movers: Sequence[Mover | None], camera: Camera) -> list[Side]:
    """The sides of a clip of videos alone, as ``clip_sides``; of a robot that is seen by that camera."""
    if any(mover is None for mover in movers):
        return [_whole(film) for film in films]
    known = [mover for mover in movers if mover is not None]
    views = views_of([_extent(mover) for mover in known], camera.size)
    if any(_beyond(*side) for side in zip(films, known, views, strict=True)):
        return [_whole(film) for film in films]
    return [_cut(*side, camera) for side in zip(films, known, views, strict=True)]


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


def _cut(film: np.ndarray, mover: Mover, view: View, camera: Camera) -> Side:
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
        "seen": _numbers(seen), "offsets": _numbers(offsets), "width": round(view.width, 4),
        "left": _numbers(way + (left - middle) / scale),
        "bottom": round(float((mover.floor - top[0] - tall) / scale), 4),
    }  # fmt: skip
    if mover.way is not None:
        known |= {"eye": _numbers(way)} | _measures(camera)
    if mover.head is not None and mover.foot is not None:
        known["marks"] = [["Head", _numbers(place(mover.head))], ["Foot", _numbers(place(mover.foot))]]
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
    low: np.ndarray
    """The least x and z that it reaches, (k, 2)."""
    high: np.ndarray
    """The most."""
    aim: np.ndarray
    """The x that a view keeps in its middle, (k,)."""
    rise: np.ndarray | None
    """The z that a view from above keeps in its middle, (k,)."""

    @staticmethod
    def of(renderer: Renderer, qpos: np.ndarray) -> _Track:
        camera = renderer.robot.camera
        if not camera.follows:
            aim = np.full((len(qpos), 2), (camera.middle, camera.height))
        else:  # the mean of its limbs: steadier than the edges of what it reaches
            ends = np.stack(list(body_of(renderer.robot).points(qpos).values()))
            aim = ends.mean(axis=(0, 2))
        above = camera.up != 2
        # As large as it is seen in the plane that the view has the scale of.
        eyes = aim if above else np.stack([aim[:, 0], np.full(len(qpos), camera.height)], axis=1)
        edges = [
            _seen_at(shape, eye, camera.distance)
            for shape, eye in zip(renderer.shapes(qpos), eyes, strict=True)
        ]
        low, high = (np.stack(some) for some in zip(*edges, strict=True))
        return _Track(qpos, low, high, aim[:, 0], aim[:, 1] if above else None)

    @property
    def extent(self) -> Extent:
        rise = np.zeros(len(self.aim)) if self.rise is None else self.rise
        return Extent(
            left=float((self.low[:, 0] - self.aim).min()), right=float((self.high[:, 0] - self.aim).max()),
            low=float((self.low[:, 1] - rise).min()), high=float((self.high[:, 1] - rise).max()),
            grounded=self.rise is None,
        )  # fmt: skip


def _seen_at(shape: Shape, eye: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """The least and the most x and z, (2,) each, that a camera at ``eye`` sees parts at."""
    scales = [
        distance / np.maximum(distance + depth[:, 1:2], 0.1 * distance) for depth in (shape.low, shape.high)
    ]
    ends = [eye + (side[:, (0, 2)] - eye) * scale for side in (shape.low, shape.high) for scale in scales]
    return np.min(ends, axis=(0, 1)), np.max(ends, axis=(0, 1))


def _drawn(renderer: Renderer, track: _Track, view: View) -> Side:
    middle = track.aim + view.shift
    close = CloseUp(
        width=CLOSE_WIDTH, height=CLOSE_HEIGHT, scale=CLOSE_HEIGHT / view.height, bottom=view.bottom
    )
    known = {
        "width": round(view.width, 4), "left": _numbers(middle - view.width / 2),
        "marks": [[word, _numbers(path)] for word, path in marks(renderer.robot, track.qpos)],
        "ghost": _numbers(renderer.outline(track.qpos[0])),
    }  # fmt: skip
    if track.rise is None:
        known |= {"bottom": round(view.bottom, 4), "eye": _numbers(middle)} | _measures(renderer.robot.camera)
    else:
        known["bottom"] = _numbers(track.rise + view.bottom)
    return Side(pictures=renderer.close_ups(track.qpos, middle, close, track.rise), known=known)


def _measures(camera: Camera) -> dict[str, Any]:
    """What the page must know to draw a scale of metres."""
    return {"camera": [camera.height, camera.distance], "unit": camera.unit}


def marks(robot: Robot, qpos: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """The paths that are drawn through a clip, with a word for each that is named.

    Of a robot that moves about these are its head, the end of its root that is higher at rest, or that is in
    front, and its feet; of one that stays where it is, the end that reaches farthest.

    Args:
        robot: The robot.
        qpos: Positions, (k, q).

    Returns:
        Of each its word, "" for further feet, and its places, (k, 2): to the right and above the floor.
    """
    body, camera = body_of(robot), robot.camera
    rest = body.points(model_of(robot.xml).qpos0)
    now = body.points(qpos)
    ground = np.array([0.0, camera.floor if camera.up == 2 else 0.0])
    root = robot.limbs[0]
    if robot.root == "fixed":
        begin = rest[root].mean(axis=0)
        far = max(robot.limbs, key=lambda name: np.linalg.norm(rest[name] - begin, axis=1).max())
        end = int(np.linalg.norm(rest[far] - begin, axis=1).argmax())
        return [("Tip", now[far][..., end, :] - ground)]
    top = int(rest[root][:, 1 if camera.up == 2 else 0].argmax())
    found = [("Head", now[root][..., top, :] - ground)]
    for number, name in enumerate(_feet(robot, rest)):
        rise = abs(rest[name][1, 1] - rest[name][0, 1])
        upright = rise > 0.5 * np.linalg.norm(rest[name][1] - rest[name][0])
        # Of what stands upright, its lower end; else its middle.
        place = now[name][..., int(rest[name][:, 1].argmin()), :] if upright else now[name].mean(axis=-2)
        found.append(("" if number else "Foot" if camera.up == 2 else "Tail", place - ground))
    return found


def _feet(robot: Robot, rest: dict[str, np.ndarray]) -> list[str]:
    """What it stands on; seen from above, what is farthest from its head."""
    if robot.feet:
        return list(robot.feet[:_FEET])
    others = [name for name in robot.limbs if name != robot.limbs[0]]
    if robot.camera.up != 2:
        head = rest[robot.limbs[0]].mean(axis=0)
        return sorted(others, key=lambda name: -np.linalg.norm(rest[name].mean(axis=0) - head))[:1]
    low = {name: float(rest[name][:, 1].min()) for name in others}
    near = 0.05 * robot.camera.size
    return [name for name in _outermost(robot) if low[name] < min(low.values()) + near][:_FEET]


def _outermost(robot: Robot) -> list[str]:
    """Limbs that carry no other, without the root."""
    model = model_of(robot.xml)
    number = {body_name(model, body): body for body in range(model.nbody)}
    inner = {int(model.body_parentid[number[name]]) for name in robot.limbs}
    return [name for name in robot.limbs[1:] if number[name] not in inner]


def _numbers(values: Any) -> list[Any]:
    """As JSON, to a tenth of a millimetre or the thousandth of a pixel."""
    return np.round(np.asarray(values, float), 4).tolist()
