"""What the silhouette net sees of masks: the shape at a fixed size, and where it is. Pure functions.

The shape is cut out around its own middle, a fixed number of metres across, so that it tells nothing of
where the robot is; place and speed, in metres, are given beside it.

Shapes: F frames, H rows, W columns, S = ``SIDE``, K = ``PLACES`` numbers of a place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

SIDE = 48
"""Pixels of the cut-out."""
RATE = 30.0
"""Frames a second at which the net looks; other videos are brought to it."""
PLACES = 8
"""Middle, lower and upper edge above the floor; speed to the right and up; what of it is known: mask, way,
floor."""
FOUND = 5
"""Which of them says whether there is a mask."""
_ACROSS = 1.15
"""The cut-out, in lengths of the robot."""
_SPEED = 0.2
_FEWEST = 12
"""Pixels of a mask; fewer are none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Views:
    """What is seen in each frame."""

    crops: np.ndarray
    """(F, S, S), uint8, 255 inside the silhouette; black where no mask was found."""
    places: np.ndarray
    """(F, K), float32, about 1 in size."""


def views(
    masks: np.ndarray, *, floor: np.ndarray, scale: float, way: np.ndarray | None, reach: float,
    fps: float = RATE,
) -> Views:  # fmt: skip
    """What of the frames of a video is seen.

    Args:
        masks: Where the robot is, (F, H, W), bool.
        floor: The row of the floor under it, (F,); not finite where unknown.
        scale: Pixels a metre in the plane of the robot.
        way: Metres that the camera has gone to the right, (F,); None if unknown.
        reach: Length of the robot stretched out, metres.
        fps: Frames a second.
    """
    edges = np.full((len(masks), 4), np.nan)  # column and row of the middle, upper and lower edge
    crops = np.zeros((len(masks), SIDE, SIDE), np.uint8)
    for index, mask in enumerate(masks):
        rows, columns = np.nonzero(mask)
        if len(rows) < _FEWEST:
            continue
        edges[index] = columns.mean() + 0.5, rows.mean() + 0.5, rows.min(), rows.max() + 1
        crops[index] = _crop(mask, edges[index, 0], edges[index, 1], SIDE / (_ACROSS * reach * scale))
    return Views(crops=crops, places=_places(edges, floor, scale, way, fps))


def _crop(mask: np.ndarray, column: float, row: float, zoom: float) -> np.ndarray:
    """The part of a mask around a place, (S, S), at ``zoom`` pixels for one."""
    half = SIDE / 2
    if zoom >= 1:
        smooth, by = mask.astype(np.uint8) * 255, 1.0
    else:  # each pixel is the mean of those that it stands for
        reach = math.ceil(half / zoom) + 2
        top, left = max(0, int(row) - reach), max(0, int(column) - reach)
        part = mask[top : int(row) + reach, left : int(column) + reach].astype(np.uint8) * 255
        size = tuple(max(1, round(side * zoom)) for side in part.shape[::-1])
        smooth = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        by = size[0] / part.shape[1]
        column, row, zoom = (column - left) * by, (row - top) * by, zoom / by
    shift = np.array([[zoom, 0, half - column * zoom], [0, zoom, half - row * zoom]], np.float32)
    return cv2.warpAffine(smooth, shift, (SIDE, SIDE), flags=cv2.INTER_LINEAR)


def _places(
    edges: np.ndarray, floor: np.ndarray, scale: float, way: np.ndarray | None, fps: float
) -> np.ndarray:
    seen = np.isfinite(edges[:, 0])
    if not seen.any():
        return np.zeros((len(edges), PLACES), np.float32)
    edges = bridged(edges, seen)
    known = np.isfinite(floor)
    ground = bridged(np.where(known, floor, 0.0)[:, None], known)[:, 0] if known.any() else floor
    places = np.zeros((len(edges), PLACES), np.float32)
    if known.any():
        heights = (ground[:, None] - edges[:, 1:]) / scale
        places[:, :3] = heights
        places[:, 4] = _SPEED * _rates(heights[:, 0], fps)
    else:
        places[:, 4] = _SPEED * _rates(-edges[:, 1] / scale, fps)
    if way is not None:
        places[:, 3] = _SPEED * _rates(edges[:, 0] / scale + way, fps)
    places[:, FOUND], places[:, 6], places[:, 7] = seen, way is not None, known
    return places


def bridged(track: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """A track, (F, n), with straight lines over the frames that were not seen, (F,)."""
    times, filled = np.arange(len(track)), track.copy()
    for values in filled.T:
        values[:] = np.interp(times, times[seen], values[seen])
    return filled


def _rates(x: np.ndarray, fps: float) -> np.ndarray:
    return np.gradient(x) * fps if len(x) > 1 else np.zeros_like(x)
