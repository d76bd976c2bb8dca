"""The studio behind the robot: sky, floor and soft shadow, as a function of the camera.

Drawn here with arrays and not by MuJoCo, because the floor costs its software renderer 5 ms a
frame at 480 x 360 (12 ms smoothed) and shimmers in the distance. Here each pixel holds the exact
mean of the pattern over its footprint, so the floor is calm, at 3 ms, and 2 more for the shadow.

Shapes: H rows, W columns, h rows below the horizon, L limbs. Axes: x to the right, along the robot's track,
y away from the camera, z up. The camera looks along +y, level. The floor's squares have a side of 1: for a
robot much smaller or larger than a man all lengths are in another unit than metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

SKY_TOP = np.array((214, 224, 236), np.float32)
SKY_HORIZON = np.array((241, 244, 248), np.float32)
CHECK_DARK = np.array((178, 187, 199), np.float32)
CHECK_LIGHT = np.array((203, 210, 219), np.float32)
LANE = np.array((222, 227, 233), np.float32)
SHADOW = np.array((38, 48, 66), np.float32)

_LANE_HALF_WIDTH = 0.33


@dataclass(frozen=True, kw_only=True, slots=True)
class Viewpoint:
    """A level pinhole camera beside the track."""

    x: float
    """Along the track, metres."""
    z: float
    """Above the floor, metres."""
    distance: float
    """From the robot's plane, metres."""
    fovy: float
    """Vertical field of view, degrees."""
    y: float | None = None
    """Where the robot's plane is, which a camera follows that a robot can come near or leave, metres; None:
    at 0 for ever, and the track is marked on the floor."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Window:
    """What part of a camera's view a picture shows, and how large."""

    focal: float
    """Focal length, pixels: a metre at the distance d takes focal / d."""
    column: float
    """Where the camera looks at, pixels from the left edge."""
    row: float
    """The horizon, pixels from the upper edge; it may lie outside the picture."""


def whole_view(height: int, width: int, fovy: float) -> Window:
    """All that a camera sees, whose field of view fills the height."""
    return Window(focal=height / 2 / np.tan(np.radians(fovy) / 2), column=width / 2, row=height / 2)


def backdrop(
    width: int, height: int, camera: Viewpoint, limbs_L5: np.ndarray | None = None, *, exact: bool = True,
    window: Window | None = None,
) -> np.ndarray:  # fmt: skip
    """Draws sky, floor and the shadow of the limbs.

    Args:
        width: Pixels.
        height: Pixels.
        camera: Where the picture is taken from.
        limbs_L5: Per limb its extent in x (low, high), the height of its lowest point, half of its depth
            and how far behind the robot's plane its middle is, metres, (L, 5); None for an empty floor.
        exact: Computes in doubles; else in half the time, with some pixels a grey level off.
        window: The part of the camera's view that fills the picture; all of it if None.

    Returns:
        The picture, (H, W, 3), uint8 RGB.
    """
    window = window or whole_view(height, width, camera.fovy)
    track = camera.y is None
    ground = _ground(width, height, camera.z, camera.distance, camera.fovy, window, track, exact)
    if ground.horizon == height:
        return cv2.merge(ground.sky)
    x_hW1 = ground.x_hW1 + np.float32(camera.x)
    light_hW = _wave(x_hW1)
    light_hW /= ground.pixel_h1
    light_hW *= 0.5
    light_hW *= ground.wave_y_h1 if camera.y is None else ground.wave_y(camera.y)
    light_hW += 0.5
    clear = None
    if limbs_L5 is not None and len(limbs_L5):
        clear = _shadow(ground, x_hW1, limbs_L5)

    # Colour by colour: an inner loop over three bytes would cost as much as all the rest.
    planes = []
    scratch = np.empty(light_hW.shape, np.float32)
    for colour, sky in enumerate(ground.sky):
        plane = sky.copy()
        floor = np.multiply(light_hW, ground.lift_3h1[colour], out=scratch)
        floor += ground.dark_3h1[colour]
        if clear is not None:
            rows = floor[ground.near]
            rows += clear * (SHADOW[colour] - rows)
        floor += 0.5
        plane[ground.horizon :] = floor
        planes.append(plane)
    return cv2.merge(planes)


@dataclass(frozen=True, slots=True)
class _Ground:
    """What all pictures from one height have in common, whatever the camera passes."""

    horizon: int
    """The first row of the floor; the height of the picture if it shows none."""
    sky: list[np.ndarray]
    """Whole pictures, a plane each of red, green and blue, (H, W), uint8."""
    y_h: np.ndarray
    """Of each row of the floor, metres, (h,)."""
    y_size_h: np.ndarray
    """What each of them covers, metres, (h,)."""
    x_hW1: np.ndarray
    """Of the borders of its pixels, from the camera, metres, (h, W + 1)."""
    pixel_h1: np.ndarray
    """Width of a pixel, metres, (h, 1)."""
    wave_y_h1: np.ndarray
    """Mean of the pattern across the track, -1..1, (h, 1)."""
    dark_3h1: np.ndarray
    """The colour of dark squares, (3, h, 1)."""
    lift_3h1: np.ndarray
    """How far the light ones are from it, (3, h, 1)."""
    near: slice
    """Rows that can be in shadow."""

    def wave_y(self, y: float) -> np.ndarray:
        """As ``wave_y_h1``, where the robot's plane is elsewhere."""
        return _mean_wave(self.y_h + y % 2, self.y_size_h)[:, None].astype(self.pixel_h1.dtype)


@lru_cache(8)
def _ground(
    width: int, height: int, z: float, distance: float, fovy: float, window: Window, track: bool, exact: bool
) -> _Ground:
    """The camera keeps its height but for jumps, so this is computed once a clip."""
    focal = window.focal
    horizon = int(np.clip(np.ceil(window.row - 0.5), 0, height))
    sky = np.zeros((height, width, 3), np.uint8)
    above = _sky(round(focal * np.tan(np.radians(fovy) / 2)))
    rows = np.arange(horizon) - int(np.ceil(window.row - 0.5)) + len(above)
    sky[:horizon] = (above[np.clip(rows, 0, len(above) - 1), None] + 0.5).astype(np.uint8)

    # Half a pixel of the horizon itself would be floor without end.
    slope_h = np.maximum(np.arange(horizon, height, dtype=np.float32) + 0.5 - window.row, 0.05) / focal
    depth_h = z / slope_h
    y_h = depth_h - distance
    y_size_h = depth_h**2 / (z * focal)
    edges_W1 = (np.arange(width + 1, dtype=np.float32) - window.column) / focal
    wave_y_h = _mean_wave(y_h, y_size_h)

    # Row by row every colour is a blend of two, so the rest is one multiplication per pixel.
    dark_h3 = np.broadcast_to(CHECK_DARK, (len(y_h), 3))
    lift_h3 = np.broadcast_to(CHECK_LIGHT - CHECK_DARK, (len(y_h), 3))
    if track:
        lane_h1 = _covered(y_h, y_size_h, -_LANE_HALF_WIDTH, _LANE_HALF_WIDTH)[:, None] * 0.6
        dark_h3 = dark_h3 + lane_h1 * (LANE - dark_h3)
        lift_h3 = lift_h3 * (1 - lane_h1)
    fog_h1 = 1 - np.exp(-np.maximum(depth_h - distance, 0) / 4.5)[:, None]
    dark_h3 = dark_h3 + fog_h1 * (SKY_HORIZON - dark_h3)
    lift_h3 = lift_h3 * (1 - fog_h1)
    near = np.flatnonzero(np.abs(y_h) < (0.7 if track else 1.6))
    kind = np.float64 if exact else np.float32
    return _Ground(
        horizon=horizon,
        sky=[np.ascontiguousarray(sky[:, :, colour]) for colour in range(3)],
        y_h=y_h.astype(kind),
        y_size_h=y_size_h,
        x_hW1=(depth_h[:, None] * edges_W1).astype(kind),
        pixel_h1=(depth_h[:, None] / np.float32(focal)).astype(kind),
        wave_y_h1=wave_y_h[:, None].astype(kind),
        dark_3h1=np.ascontiguousarray(dark_h3.T)[:, :, None].astype(kind),
        lift_3h1=np.ascontiguousarray(lift_h3.T)[:, :, None].astype(kind),
        near=slice(near[0], near[-1] + 1) if len(near) else slice(0, 0),
    )


def _sky(rows: int) -> np.ndarray:
    """The sky's colour per row, (rows, 3)."""
    t = np.linspace(0, 1, rows, dtype=np.float32)[:, None] ** 1.5
    return SKY_TOP * (1 - t) + SKY_HORIZON * t


def _triangle(x: np.ndarray) -> np.ndarray:
    """The integral of the square wave that is +1 on [0, 1) and -1 on [1, 2), metres."""
    return 1 - np.abs(np.mod(x, 2) - 1)


def _mean_wave(y_h: np.ndarray, size_h: np.ndarray) -> np.ndarray:
    """Mean of the square wave over each row's footprint, (h,), -1..1."""
    return (_triangle(y_h + size_h / 2) - _triangle(y_h - size_h / 2)) / size_h


def _covered(y_h: np.ndarray, size_h: np.ndarray, low: float, high: float) -> np.ndarray:
    """Which part of each row's footprint lies in low..high, (h,), 0..1."""
    overlap = np.minimum(y_h + size_h / 2, high) - np.maximum(y_h - size_h / 2, low)
    return np.clip(overlap / size_h, 0, 1).astype(np.float32)


def _wave(x_hW1: np.ndarray) -> np.ndarray:
    """What ``_triangle`` adds from border to border, (h, W), metres."""
    edge = x_hW1 * 0.5
    np.floor(edge, out=edge)
    edge *= -2
    edge += x_hW1  # x modulo 2, to the bit
    edge -= 1
    np.abs(edge, out=edge)
    np.subtract(1, edge, out=edge)
    return edge[:, 1:] - edge[:, :-1]


def _shadow(ground: _Ground, x_hW1: np.ndarray, limbs_L5: np.ndarray) -> np.ndarray:
    """How dark it is under the limbs, 0..1, (near rows, W): the higher a limb, the fainter and softer."""
    y = ground.y_h[ground.near]
    x = (x_hW1[ground.near, 1:] + x_hW1[ground.near, :-1]) / 2
    clear = np.ones_like(x)
    for low, high, lift, half, middle in limbs_L5.astype(np.float32):
        lift = max(float(lift), 0.0)
        soft = 0.035 + 0.16 * lift
        dark = 0.6 * np.exp(-lift / 0.9)
        across = np.exp(-((np.maximum(np.abs(y - middle) - half * 0.6, 0) / (soft * 1.2)) ** 2))
        along = 0.5 * (np.tanh((x - low) / soft) - np.tanh((x - high) / soft))
        clear *= 1 - (dark * across[:, None]).astype(np.float32) * along
    return 1 - clear


def ground_from_above(width: int, height: int, camera: Viewpoint, window: Window) -> np.ndarray:
    """Draws the plain ground that a camera sees which looks straight down.

    Args:
        width: Pixels.
        height: Pixels.
        camera: Its ``z`` is its place along the picture's vertical axis, its distance that from the ground.
        window: The part of the camera's view that fills the picture.

    Returns:
        The picture, (H, W, 3), uint8 RGB.
    """
    pixel = camera.distance / window.focal
    x_W1 = camera.x + (np.arange(width + 1) - window.column) * pixel
    z_H1 = camera.z + (window.row - np.arange(height + 1)) * pixel
    waves = [np.diff(_triangle(edges)).astype(np.float32) / pixel for edges in (x_W1, z_H1)]
    light_HW = np.multiply.outer(-waves[1], waves[0])
    plain, lift = (CHECK_LIGHT + LANE) / 2, (LANE - CHECK_LIGHT) / 2
    return (plain + lift * light_HW[:, :, None] + 0.5).astype(np.uint8)
