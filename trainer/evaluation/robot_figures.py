"""What an episode of any robot was worth, from stored states and actions. Pure functions on arrays.

Shapes: "..." any lanes, T states along the time axis, T - 1 actions between them, q positions, v velocities,
a actions.
"""

from __future__ import annotations

import mujoco
import numpy as np

from onedemo.robots.robot import Robot, model_of
from onedemo.sim.kinematics import body_of

_LEANING = 0.5
"""Of a robot for which gymnasium has no rule: cosine of the lean from which on it is not upright."""

_TURNED = ("turned_forward", "turned_sideways", "turned_round")


def robot_figures(
    robot: Robot, qpos: np.ndarray, qvel: np.ndarray, actions: np.ndarray
) -> dict[str, np.ndarray | None]:
    """General figures of episodes.

    Args:
        robot: The robot.
        qpos: Positions, (..., T, q).
        qvel: Velocities, (..., T, v).
        actions: (..., T - 1, a), not clipped.

    Returns:
        Of each, (...); None where the robot has no such thing:

        - ``travel``: mean velocity to the right in pictures, m/s.
        - ``height``: mean height of the root, metres.
        - ``turned_forward``, ``turned_sideways``, ``turned_round``: net rotation of the root about the axes
          of its own that at rest point away from the camera, to the right and up, turns. A planar root has
          the first alone, clockwise, as seen; a fixed one has none.
        - ``upright_seconds``: until it falls by gymnasium's rule, or leans by 60 degrees if there is none.
        - ``energy``: mechanical work of the motors, braking counted as work, joules.
        - ``stock_reward``: gymnasium's hand-coded reward of all steps, falls or not.
        - ``stock_return``: the same until the first fall.
    """
    body = body_of(robot)
    rewards, upright = stock_rewards(robot, qpos, qvel, actions), until_leaning(robot, qpos, qvel)
    turns = robot.dt / (2 * np.pi) * body.own_spin(qvel[..., 1:, :]).sum(axis=-2)
    return {
        "travel": np.mean(body.root_rates(qpos, qvel).travel, axis=-1),
        "height": body.height(qpos).mean(axis=-1),
        **dict(zip(_TURNED, np.moveaxis(turns, -1, 0), strict=False)),
        "upright_seconds": None if upright is None else upright.sum(axis=-1) * robot.dt,
        "energy": energy(robot, qpos, qvel, actions),
        "stock_reward": rewards.sum(axis=-1),
        "stock_return": (rewards * until_fall(robot, qpos, qvel)).sum(axis=-1),
    }


def stock_rewards(robot: Robot, qpos: np.ndarray, qvel: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Gymnasium's reward of each step, (..., T - 1); arguments as ``robot_figures``."""
    stock = robot.stock
    ahead = np.diff(qpos[..., 0], axis=-1) / robot.dt if stock.forward else 0.0
    healthy = robot.healthy(qpos[..., 1:, :], qvel[..., 1:, :])
    costs = stock.control * np.square(_commands(robot, actions, clip=False)).sum(axis=-1)
    return stock.forward * ahead + stock.healthy * healthy - costs


def until_fall(robot: Robot, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Whether each step belongs to gymnasium's episode, the step that falls included, (..., T - 1)."""
    return _until(robot.healthy(qpos[..., 1:, :], qvel[..., 1:, :]))


def until_leaning(robot: Robot, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray | None:
    """Whether it has been upright until each step, (..., T - 1); None where there is no upright."""
    body = body_of(robot)
    if robot.stock.healthy_height is not None or robot.stock.healthy_angle is not None:
        return until_fall(robot, qpos, qvel)
    if robot.root == "fixed" or robot.camera.up != 2:
        return None
    return _until(body.axes(qpos[..., 1:, :])[..., body.upright, 1] > _LEANING)


def energy(robot: Robot, qpos: np.ndarray, qvel: np.ndarray, actions: np.ndarray) -> np.ndarray | None:
    """Mechanical work of the motors, joules, (...); None where they do not act on joints directly."""
    model = model_of(robot.xml)
    simple = (
        (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        & (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        & (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        & (model.actuator_biastype != mujoco.mjtBias.mjBIAS_MUSCLE)
    )
    if not simple.all():
        return None
    gear, joints = model.actuator_gear[:, 0], model.actuator_trnid[:, 0]
    length = gear * qpos[..., 1:, model.jnt_qposadr[joints]]
    speed = gear * qvel[..., 1:, model.jnt_dofadr[joints]]
    bias = model.actuator_biasprm
    force = model.actuator_gainprm[:, 0] * _commands(robot, actions, clip=True)
    force = force + bias[:, 0] + bias[:, 1] * length + bias[:, 2] * speed
    limits = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, [-np.inf, np.inf])
    return robot.dt * np.abs(np.clip(force, *limits.T) * speed).sum(axis=(-1, -2))


def _commands(robot: Robot, actions: np.ndarray, *, clip: bool) -> np.ndarray:
    """What actions command of the motors, (..., a)."""
    low, high = np.array(robot.low), np.array(robot.high)
    as_given = bool((low == -1).all() and (high == 1).all())
    actions = np.clip(actions, -1, 1) if clip or not as_given else actions
    return (low + high) / 2 + (high - low) / 2 * actions


def _until(holds: np.ndarray) -> np.ndarray:
    before = np.concatenate([np.ones_like(holds[..., :1]), holds[..., :-1]], axis=-1)
    return np.logical_and.accumulate(before, axis=-1)
