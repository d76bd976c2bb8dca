"""The robot beside its demo as a small moving picture, for reports and the README.

Shapes: F demo frames, q = 6 positions.
"""

from __future__ import annotations

import cv2
import numpy as np

from onedemo.demos.library import read_frames
from onedemo.render.clip_image import frame_durations, side_by_side
from onedemo.render.render_thread import RenderThread
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.types import Demo

MOST_BYTES = 400_000

_EVERY = 2
"""Frames of the demo between those that are shown: 15 a second are enough to follow a flip."""
_TRIES = ((0.5, 70), (0.4, 50), (0.3, 30))
"""Scale of a clip's 972 x 360 pixels, and WebP quality; the first that is small enough is taken."""


def movie(demo: Demo, qpos: np.ndarray) -> bytes:
    """The demo on the left, an episode on the right, as an endless animated WebP.

    Args:
        demo: The demo.
        qpos: The episode's positions at each of the demo's frames, (F, q).

    Returns:
        The file's bytes, at most ``MOST_BYTES`` unless the demo is very long.

    Raises:
        UserError: If this machine cannot draw or the demo's video cannot be read.
        ValueError: If there are not as many positions as frames.
    """
    if len(qpos) != demo.frames:
        raise ValueError(f"{len(qpos)} positions do not go with the {demo.frames} frames of {demo.name}")
    with RenderThread() as drawing:
        whose = robot_named(demo.robot or DEFAULT)
        robot = drawing.render(np.asarray(qpos, np.float64)[::_EVERY], whose).result()
    pairs = [side_by_side(*pair) for pair in zip(read_frames(demo)[::_EVERY], robot, strict=True)]
    animation = cv2.Animation()
    animation.durations = frame_durations(len(pairs), demo.fps / _EVERY)
    animation.loop_count = 0
    data = b""
    for scale, quality in _TRIES:
        size = (round(pairs[0].shape[1] * scale), round(pairs[0].shape[0] * scale))
        small = [cv2.resize(pair, size, interpolation=cv2.INTER_AREA) for pair in pairs]
        animation.frames = [cv2.cvtColor(frame, cv2.COLOR_RGB2BGR) for frame in small]
        done, encoded = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, quality])
        if not done:
            raise RuntimeError("OpenCV could not encode an animated WebP")
        data = encoded.tobytes()
        if len(data) <= MOST_BYTES:
            break
    return data
