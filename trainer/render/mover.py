"""Where in a video whatever moves is, told by its pictures alone.

Pictures of the robot's own studio are known by their sky. There the camera is known, and with it heights
and sizes; the limbs are told by their colours, and the way of the camera by the squares of the floor.
Of any other video, what differs from the median picture is taken as what moves, as long as that is
neither next to nothing nor most of the picture.

Shapes: F pictures, H rows, W columns. Places in pictures are pixels from the upper left corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from onedemo.render.backdrop import SKY_HORIZON, SKY_TOP
from onedemo.render.renderer import studio
from onedemo.render.stage import free_above
from onedemo.render.studio import LIMB_COLOURS
from onedemo.robots.camera import Camera
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.robots.robot import Robot
from onedemo.sim.kinematics import CONTACT_REACH

_CALM = 4.0  # pictures over which a view's way is smoothed
_MOST = 0.15  # of a picture: what differs from the median when one body moves
BODY = 1.45
"""Length at which a mover of unknown size is shown, metres, beside a robot that is seen from three metres:
the robot's own, stretched out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Mover:
    """What is known of what moves in a video."""

    scale: float
    """Pixels a metre."""
    floor: float
    """The row of the floor under it."""
    box: np.ndarray
    """Left, top, right, bottom in each picture, (F, 4)."""
    aim: np.ndarray
    """The column that a view which follows it keeps in its middle, (F,)."""
    head: np.ndarray | None = None
    """Column and row in each picture, (F, 2); None where parts cannot be told."""
    foot: np.ndarray | None = None
    """The same."""
    root: np.ndarray | None = None
    """The same of the middle of the limb that the others hang at."""
    way: np.ndarray | None = None
    """Metres that the camera has gone along the track, (F,); None where floor and sizes are guessed."""
    outlines: tuple[np.ndarray, ...]
    """Its border in each picture, (n, 2) each; empty where it was not seen."""

    def at(self, frames: np.ndarray) -> Mover:
        """Of some of the pictures, (k,)."""
        tracks = {
            name: track if track is None else track[frames]
            for name in ("box", "aim", "head", "foot", "root", "way")
            for track in [getattr(self, name)]
        }
        return replace(self, **tracks, outlines=tuple(self.outlines[frame] for frame in frames))


def locate(frames: np.ndarray, robot: Robot | None = None) -> Mover | None:
    """Finds what moves.

    Args:
        frames: (F, H, W, 3), uint8 RGB.
        robot: Whose studio it is if it is a studio, and how large what moves is shown; the hopper if None.

    Returns:
        None if it cannot be told from what is around it.
    """
    robot = robot or robot_named(DEFAULT)
    return _in_studio(frames, robot) if is_studio(frames) else _before_background(frames, robot)


def travel_of(mover: Mover, fps: float) -> np.ndarray | None:
    """Velocity of the root to the right: how the camera goes and how the root moves in its pictures.

    Args:
        mover: Where it is in F pictures.
        fps: Pictures per second.

    Returns:
        m/s, (F,), smoothed over a picture before and after; None where the camera's way is not known.
    """
    if mover.way is None or mover.root is None or len(mover.way) < 2:
        return None
    speed = fps * np.gradient(mover.way + (mover.root[:, 0] - mover.aim) / mover.scale)
    return np.convolve(np.pad(speed, 1, "edge"), (0.25, 0.5, 0.25), "valid")


def contact_of(mover: Mover) -> np.ndarray | None:
    """How far the lowest part touches the ground, 0..1, (F,); None where the floor is guessed."""
    if mover.way is None:
        return None
    lowest = (mover.floor - mover.box[:, 3]) / mover.scale
    return np.clip(1 - lowest / CONTACT_REACH, 0, 1)


def is_studio(frames: np.ndarray) -> bool:
    """Whether pictures are of the robot's studio, seen whole: known by their sky."""
    height, width = frames.shape[1:3]
    if width * 3 != height * 4:
        return False
    rows = height // 8
    t = (np.linspace(0, 1, height // 2)[:rows, None] ** 1.5).astype(np.float32)
    sky = SKY_TOP * (1 - t) + SKY_HORIZON * t
    some = frames[:: max(1, len(frames) // 12), :rows]
    return bool(np.abs(np.median(some, axis=2) - sky).mean() < 4)


def _in_studio(frames: np.ndarray, robot: Robot) -> Mover | None:
    height, width = frames.shape[1:3]
    camera = robot.camera
    view = studio(width, height, camera)
    box = np.full((len(frames), 4), np.nan)
    torso, foot = np.full((len(frames), 4), np.nan), np.full((len(frames), 2), np.nan)
    solids = np.stack([solid_in_studio(frame) for frame in frames])
    outlines: list[np.ndarray] = []
    colours = np.asarray(LIMB_COLOURS) - np.mean(LIMB_COLOURS, axis=1, keepdims=True)
    colours = (colours / np.linalg.norm(colours, axis=1, keepdims=True)).astype(np.float32)
    for index, (frame, solid) in enumerate(zip(frames, solids, strict=True)):
        outlines.append(_outline(cv2.medianBlur(solid, 5)))
        columns, rows = (
            np.reshape(cv2.findNonZero(solid), (-1, 2)).T if solid.any() else np.empty((2, 0), int)
        )
        if len(rows) < 40:
            continue
        box[index] = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        places = np.stack([columns, rows], axis=1) + 0.5
        tint = frame[rows, columns].astype(np.float32)
        tint -= tint.mean(axis=1, keepdims=True)
        limb = np.argmax(tint @ colours.T, axis=1)
        torso[index] = _rod(places[limb == 0], places[(limb == 1) | (limb == 2)])
        if (feet := places[limb == 3]).size > 20:
            foot[index] = feet.mean(axis=0)
    # Where the camera rises with the robot, heights are not known.
    top = height - (camera.height + free_above(camera) - 0.03 * camera.size - view.bottom) * view.scale
    if np.isnan(box[:, 0]).mean() > 0.3 or (box[:, 1] < top).any():
        return None
    return Mover(
        scale=view.scale, floor=height + view.bottom * view.scale, box=_filled(box),
        aim=np.full(len(frames), width / 2), head=_filled(_ends(torso)), foot=_filled(foot),
        root=_filled(torso[:, :2]), way=way_in_studio(frames, solids, camera), outlines=tuple(outlines),
    )  # fmt: skip


def solid_in_studio(frame: np.ndarray) -> np.ndarray:
    """What of a picture of the studio, (H, W, 3), is the robot, (H, W), uint8 0 or 1, by colour."""
    red, green, blue = cv2.split(frame)
    bright, faint = cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue)
    solid = cv2.threshold(cv2.subtract(bright, faint), 45, 1, cv2.THRESH_BINARY)[1]
    return cv2.medianBlur(solid, 3)


def way_in_studio(frames: np.ndarray, solids: np.ndarray, camera: Camera | None = None) -> np.ndarray:
    """Metres that the studio's camera has gone along the track since the first picture, (F,).

    Args:
        frames: (F, H, W, 3), uint8 RGB.
        solids: Where the floor is not seen, (F, H, W), uint8 0 or 1.
        camera: The studio's; the hopper's if None.
    """
    camera = camera or robot_named(DEFAULT).camera
    height, width = frames.shape[1:3]
    pattern = _floor_pattern(height, width, camera)
    places = [_place(frame[..., 1], solid, pattern) for frame, solid in zip(frames, solids, strict=True)]
    way = np.unwrap(places, period=2) * camera.unit
    return way - way[0]


def _rod(limb: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The middle of a straight limb, (n, 2), and from there its end that is away from the others, (4,)."""
    if len(limb) < 20 or not len(rest):
        return np.full(4, np.nan)
    middle = limb.mean(axis=0)
    lengths, axes = np.linalg.eigh(np.cov((limb - middle).T))
    side = np.sign(axes[:, 1] @ (middle - rest.mean(axis=0))) or 1
    return np.concatenate([middle, side * 0.8 * math.sqrt(3 * lengths[1]) * axes[:, 1]])


def _ends(rods: np.ndarray) -> np.ndarray:
    """One end of a limb through a video, (F, 4) to (F, 2): that which is away from the others mostly.

    A limb that lies over them does not tell, but none turns over from picture to picture.
    """
    told, last, agree = rods.copy(), None, 0
    for rod in told:
        if np.isnan(rod[0]):
            continue
        turned = last is not None and rod[2:] @ last < 0
        agree += -1 if turned else 1
        if turned:
            rod[2:] *= -1
        last = rod[2:]
    return told[:, :2] + (told[:, 2:] if agree >= 0 else -told[:, 2:])


def _floor_pattern(height: int, width: int, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Some rows of the floor, (r,), and its squares in them from many places of the camera, (P, r * W).

    The places are a centimetre apart, over the two metres after which the squares come again.
    """
    distance = camera.distance / camera.unit
    focal = studio(width, height, camera).scale * camera.distance
    rows = np.arange(height // 2, height)
    depth = camera.height / camera.unit * focal / (rows + 0.5 - height / 2)
    y = depth - distance
    clear = (y < -0.42) & (y > -0.95) | (y > 0.5) & (y < 0.92)  # neither on the lane nor on a border
    x = depth[clear, None] * ((np.arange(width) + 0.5 - width / 2) / focal)
    sign = np.where(np.mod(y[clear], 2) < 1, 1.0, -1.0)[:, None]
    places = np.arange(_PLACES)[:, None, None] * (2 / _PLACES)
    squares = np.where(np.mod(x + places, 2) < 1, sign, -sign)
    squares -= squares.mean(axis=2, keepdims=True)
    return rows[clear], squares.reshape(_PLACES, -1).astype(np.float32)


_PLACES = 200


def _place(green: np.ndarray, robot: np.ndarray, pattern: tuple[np.ndarray, np.ndarray]) -> float:
    """Where the camera is, metres, but for whole two; ``robot``: where the floor is not seen, (H, W)."""
    rows, squares = pattern
    clear = (cv2.dilate(robot, np.ones((9, 9), np.uint8))[rows] == 0).astype(np.float32)
    floor = green[rows] * clear
    floor -= clear * (floor.sum(axis=1) / np.maximum(clear.sum(axis=1), 1))[:, None]
    alike = squares @ floor.ravel()
    best = int(np.argmax(alike))
    before, here, after = (alike[(best + k) % _PLACES] for k in (-1, 0, 1))
    between = (before - after) / (2 * (before - 2 * here + after) or 1)
    return (best + float(np.clip(between, -0.5, 0.5))) * 2 / _PLACES


def _before_background(frames: np.ndarray, robot: Robot) -> Mover | None:
    height, width = frames.shape[1:3]
    by = max(1.0, width / 240)
    size = (round(width / by), round(height / by))
    small = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])
    background = np.median(small[:: max(1, len(small) // 48)], axis=0).astype(np.uint8)
    box = np.full((len(frames), 4), np.nan)
    shares, outlines = [], []
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    for index, frame in enumerate(small):
        other = (cv2.absdiff(frame, background).max(axis=2) > 30).astype(np.uint8)
        other = cv2.morphologyEx(other, cv2.MORPH_OPEN, kernel)
        joined = cv2.dilate(other, kernel, iterations=3)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
        shares.append(other.mean())
        areas = stats[1:, cv2.CC_STAT_AREA]
        outlines.append(np.empty((0, 2)))
        if not len(areas) or areas.max() < 0.004 * other.size:
            continue
        large = 1 + np.flatnonzero(areas > 0.3 * areas.max())
        solid = (np.isin(labels, large) & (other > 0)).astype(np.uint8)
        rows, columns = np.nonzero(solid)
        box[index] = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        outlines[-1] = _outline(cv2.morphologyEx(solid, cv2.MORPH_CLOSE, kernel, iterations=2)) * by
    areas = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1]) / (size[0] * size[1])
    if np.mean(shares) > _MOST or np.isnan(areas).mean() > 0.3 or np.nanmedian(areas) > 2 * _MOST:
        return None  # the camera moves, or the trees do
    box = _filled(box) * by
    sides = np.maximum(box[:, 2] - box[:, 0], box[:, 3] - box[:, 1])
    return Mover(
        scale=float(np.percentile(sides, 90)) / (BODY * robot.camera.size),
        floor=float(np.percentile(box[:, 3], 95)),
        box=box,
        aim=cv2.GaussianBlur((box[:, :1] + box[:, 2:3]) / 2, (1, 0), sigmaX=1, sigmaY=_CALM)[:, 0],
        outlines=tuple(outlines),
    )


def _outline(solid: np.ndarray) -> np.ndarray:
    """The border of the largest part, (n, 2), simplified."""
    found, _ = cv2.findContours(solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not found:
        return np.empty((0, 2))
    return cv2.approxPolyDP(max(found, key=cv2.contourArea), 1.0, True)[:, 0] + 0.5


def _filled(track: np.ndarray) -> np.ndarray:
    """A track, (F, n), with gaps bridged by straight lines."""
    times = np.arange(len(track))
    filled = track.copy()
    for values in filled.T:
        seen = ~np.isnan(values)
        values[:] = np.interp(times, times[seen], values[seen]) if seen.any() else 0.0
    return filled
