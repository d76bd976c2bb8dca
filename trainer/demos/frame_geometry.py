"""How a decoded picture is meant to be seen: upright, with square pixels.

Shapes: H rows, W columns.
"""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np

Turn = tuple[int, int, int, int]
"""A display matrix (a, b, c, d): x' = a x + c y, y' = b x + d y, each -1, 0 or 1."""
TURNS: dict[int, Turn] = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}
"""By degrees, clockwise."""


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
