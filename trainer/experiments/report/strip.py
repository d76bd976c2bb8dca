"""A strip of frames: the demo in the upper row, the robot at the same times in the lower one.

Shapes: F demo frames, q = 6 positions.
"""

from __future__ import annotations

import cv2
import numpy as np

from onedemo.demos.library import read_frames
from onedemo.render.clip_image import SIDE_HEIGHT, SIDE_WIDTH, fit
from onedemo.render.render_thread import RenderThread
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.types import Demo

_SHOWN = 8
_WIDTH, _HEIGHT = 180, 135
_GAP = 4  # pixels of white between pictures
_QUALITY = 85


def strip(demo: Demo, qpos: np.ndarray, *, first: float = 0.0, last: float = 1.0) -> bytes:
    """Moments spread evenly over a part of the demo, as one WebP.

    Args:
        demo: The demo.
        qpos: The episode's positions at each of the demo's frames, (F, q).
        first: Where the part begins, as a share of the demo.
        last: Where it ends.

    Returns:
        The file's bytes.

    Raises:
        UserError: If this machine cannot draw or the demo's video cannot be read.
        ValueError: If there are not as many positions as frames.
    """
    if len(qpos) != demo.frames:
        raise ValueError(f"{len(qpos)} positions do not go with the {demo.frames} frames of {demo.name}")
    shown = moments(demo.frames, first, last)
    with RenderThread() as drawing:
        robot = drawing.render(
            np.asarray(qpos, np.float64)[shown], robot_named(demo.robot or DEFAULT)
        ).result()
    rows = [
        np.concatenate([_small(frame) for frame in row], axis=1) for row in (read_frames(demo)[shown], robot)
    ]
    picture = np.concatenate(rows)[:-_GAP, :-_GAP]
    options = [cv2.IMWRITE_WEBP_QUALITY, _QUALITY]
    done, encoded = cv2.imencode(".webp", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise RuntimeError("OpenCV could not encode a WebP")
    return encoded.tobytes()


def moments(frames: int, first: float = 0.0, last: float = 1.0) -> np.ndarray:
    """Frames that are shown, both ends of the part included, ascending."""
    return np.unique(np.round(np.linspace(first, last, _SHOWN) * (frames - 1)).astype(int))


def _small(frame: np.ndarray) -> np.ndarray:
    assert SIDE_WIDTH * _HEIGHT == SIDE_HEIGHT * _WIDTH
    picture = np.full((_HEIGHT + _GAP, _WIDTH + _GAP, 3), 255, np.uint8)
    picture[:_HEIGHT, :_WIDTH] = cv2.resize(fit(frame), (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
    return picture
