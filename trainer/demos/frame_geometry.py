"""How a decoded picture is meant to be seen, upright with square pixels; and how pictures lie in each other.

A motion is a 3 x 3 matrix that maps places in a picture, pixels, to those in another.

Shapes: n pictures, H rows, W columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import av
import cv2
import numpy as np

Turn = tuple[int, int, int, int]
"""A display matrix (a, b, c, d): x' = a x + c y, y' = b x + d y, each -1, 0 or 1."""
TURNS: dict[int, Turn] = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}
"""By degrees, clockwise."""
Box = tuple[int, int, int, int]
"""x, y, width, height."""


def pixel_aspect(aspect: Fraction | None) -> float:
    """Width of a pixel divided by its height; 1 where the container says nothing sensible."""
    return float(aspect) if aspect and 0.1 <= aspect <= 10 else 1.0


def square_pixels(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The size once pixels are square: the height stays."""
    return max(1, round(width * aspect)), height


def orientation(frame: av.VideoFrame) -> Turn:
    """The nearest quarter turn, mirrored or not, to the display matrix of a frame."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return 1, 0, 0, 1
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].astype(float)
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return (-1 if a < 0 else 1), 0, 0, (-1 if d < 0 else 1)
    return 0, (-1 if b < 0 else 1), (-1 if c < 0 else 1), 0


def turned(picture: np.ndarray, turn: Turn) -> np.ndarray:
    """The picture, (H, W, 3), turned and mirrored, without a copy."""
    a, b, c, d = turn
    if not a:
        picture = picture.swapaxes(0, 1)
    return picture[:: b or d, :: a or c]


def inner_edges(motions: Sequence[np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """The innermost left and top, right and bottom edge of pictures where they lie in the first, (2, 2)."""
    width, height = size
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float).T
    x, y = np.moveaxis((np.asarray(motions) @ corners)[:, :2], 1, 0)  # (n, 4) each
    return np.array([[x[:, [0, 2]].max(), y[:, [0, 1]].max()], [x[:, [1, 3]].min(), y[:, [2, 3]].min()]])


def overlap(one: Box, other: Box) -> Box:
    """What is in both; its sides are less than 1 where nothing is."""
    x, y = max(one[0], other[0]), max(one[1], other[1])
    return x, y, min(one[0] + one[2], other[0] + other[2]) - x, min(one[1] + one[3], other[1] + other[3]) - y


def motion(angle: float, x: float, y: float) -> np.ndarray:
    """By radians, clockwise, and pixels."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, x], [sine, cosine, y], [0, 0, 1]])


def angle_and_shift(matrix: np.ndarray) -> tuple[float, float, float]:
    """What ``motion`` was made of."""
    return math.atan2(matrix[1, 0], matrix[0, 0]), float(matrix[0, 2]), float(matrix[1, 2])


def resized(matrix: np.ndarray, now: tuple[int, ...], wanted: tuple[int, ...]) -> np.ndarray:
    """A motion in pictures of one shape (H, W), for the same pictures of another."""
    x, y = wanted[1] / now[1], wanted[0] / now[0]
    scale = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])  # the middle of a pixel is whole
    return scale @ matrix @ np.linalg.inv(scale)


def scaled(picture: np.ndarray, side: int) -> np.ndarray:
    """A picture whose longer side is at most so many pixels."""
    height, width = picture.shape[:2]
    by = min(1.0, side / max(height, width))
    size = (max(1, round(width * by)), max(1, round(height * by)))
    return cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_AREA)
