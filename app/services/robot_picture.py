"""A picture of what a robot can be in: at rest, and in random states."""

from __future__ import annotations

import math

import cv2
import numpy as np

from onedemo.render.renderer import Renderer
from onedemo.rl.random_states import random_states
from onedemo.robots.robot import Robot

_WIDTH, _HEIGHT = 320, 240


def robot_picture(robot: Robot, count: int, *, seed: int, suffix: str) -> bytes:
    """Pictures side by side, the first at rest.

    Args:
        robot: Which.
        count: How many states.
        seed: Of the random ones.
        suffix: Of the file's name, which says how it is written: ".png" or ".jpg".

    Returns:
        The content of the file.

    Raises:
        UserError: If this machine cannot draw without a screen.
    """
    qpos, _ = random_states(count - 1, np.random.default_rng(seed), robot.name)
    renderer = Renderer(_WIDTH, _HEIGHT, robot=robot, exact=False)
    try:
        pictures = renderer.render(np.concatenate([np.array([robot.rest]), qpos]))
    finally:
        renderer.close()
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    sheet = np.full((rows * _HEIGHT, columns * _WIDTH, 3), 255, np.uint8)
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        sheet[row * _HEIGHT : (row + 1) * _HEIGHT, column * _WIDTH : (column + 1) * _WIDTH] = picture
    return cv2.imencode(suffix, sheet[:, :, ::-1])[1].tobytes()
