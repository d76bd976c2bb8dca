"""``gym:ID``: the robot of any MuJoCo environment of gymnasium, where its model and control step can be read.

The robot is the environment's, the rest is as of any robot here: observations are positions and velocities,
actions reach from -1 to 1, episodes end at a time limit.
"""

from __future__ import annotations

import re
import warnings
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

from onedemo.errors import UserError, in_words
from onedemo.robots.library import choose
from onedemo.robots.robot import Robot, model_of

PREFIX = "gym:"
_ID = re.compile(r"([A-Za-z0-9_-]+/)?[A-Za-z0-9_-]+-v\d+")
"""An environment's id without a module, which gymnasium would import."""


def make(name: str) -> Robot:
    """The robot of an environment.

    Args:
        name: "gym:" and the environment's id.

    Raises:
        UserError: If there is no such environment, or it is no robot that its own motors move.
    """
    number = name.removeprefix(PREFIX)
    if not _ID.fullmatch(number):
        raise UserError(f"an environment of gymnasium is called as {PREFIX}Walker2d-v5, got {name[:80]!r}")
    env = _environment(number)
    try:
        model: Any = getattr(env.unwrapped, "model", None)
        file = getattr(env.unwrapped, "fullpath", "")
        skip = getattr(env.unwrapped, "frame_skip", getattr(env.unwrapped, "n_substeps", 0))
        actions = getattr(env.action_space, "shape", None)
    finally:
        env.close()
    if model is None or not isinstance(model, mujoco.MjModel) or not Path(file).is_file() or not skip:
        raise UserError(
            f"{name} does not say which MuJoCo model it has and how long a control step is; if you have its "
            "MJCF file, add that: onedemo robot add MODEL.xml"
        )
    if actions != (model.nu,):
        raise UserError(
            f"{name} takes actions {actions} where its model has {model.nu} actuators: something else than "
            "motors moves it, which a policy here cannot do"
        )
    xml = Path(file)
    if not _same(model, model_of(xml)):
        raise UserError(f"{name} changes its model when it starts, so it cannot be read from {xml.name}")
    return choose(xml, name, control_step=int(skip) * float(model.opt.timestep))


def _environment(number: str) -> gymnasium.Env[Any, Any]:
    with suppress(ImportError):
        gymnasium.register_envs(import_module("gymnasium_robotics"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there is a newer version of it, say
            return gymnasium.make(number, disable_env_checker=True)
    except gymnasium.error.Error as error:
        raise UserError(
            f"gymnasium has no environment {number} ({error}); those of robots with hands come with the "
            "package gymnasium-robotics"
        ) from None
    except Exception as error:  # what an environment needs and does not find, whatever it is
        raise UserError(f"gymnasium's environment {number} cannot be made: {in_words(error)}") from None


def _same(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Whether two models move alike, as far as their tables of bodies and joints tell."""
    return all(
        np.array_equal(getattr(one, table), getattr(other, table))
        for table in ("qpos0", "body_mass", "body_pos", "jnt_type", "jnt_range", "actuator_ctrlrange")
    )
