"""Hand-coded rewards of tasks, from stored states. Pure functions on arrays; no simulator runs here.

Shapes: T states or steps along the last time axis, "..." any lanes before it, o observations,
a = 3 actions, q = 6 positions (x, z, torso angle, thigh, leg and foot joints).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from onedemo.robots.registry import robot_named
from onedemo.robots.robot import Robot


def backflip_reward(next_obs: np.ndarray, actions: np.ndarray, *, clip_actions: bool = True) -> np.ndarray:
    """The hand-coded backflip reward known from the human-preferences literature.

    backroll (1 + 0.3 height + 0.1 work + 0.05 backslide), where backroll is the backward torso
    spin, work the sum of action times joint velocity, and backslide the backward speed
    (published beside Christiano et al. 2017). It also pays for thrashing limbs: report turns
    beside it.

    Args:
        next_obs: Observation after each step, (..., 11).
        actions: Action of each step, (..., 3).
        clip_actions: Count what the motors do (-1..1) rather than what the policy asked for.

    Returns:
        Reward per step, (...).
    """
    motors = np.clip(actions, -1, 1) if clip_actions else actions
    height, backslide, backroll = next_obs[..., 0], -next_obs[..., 5], -next_obs[..., 7]
    work = (motors * next_obs[..., 8:11]).sum(-1)
    return backroll * (1 + 0.3 * height + 0.1 * work + 0.05 * backslide)


def hop_reward(
    qpos: np.ndarray, next_qpos: np.ndarray, next_qvel: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """The reward of Hopper-v5: forward speed, upright, small actions.

    Unlike the stock environment nothing ends at a fall; ``until_fall`` cuts the sum there.

    Args:
        qpos: Positions before each step, (..., q).
        next_qpos: Positions after it, (..., q).
        next_qvel: Velocities after it, (..., v).
        actions: (..., a), not clipped.

    Returns:
        Reward per step, (...).
    """
    hopper = robot_named("hopper")
    forward = (next_qpos[..., 0] - qpos[..., 0]) / hopper.dt
    upright = hopper.stock.healthy * hopper.healthy(next_qpos, next_qvel)
    return forward + upright - hopper.stock.control * np.square(actions).sum(-1)


def until_fall(next_qpos: np.ndarray, next_qvel: np.ndarray, of: Robot | None = None) -> np.ndarray:
    """Whether each step belongs to gymnasium's episode, the step that falls included.

    Args:
        next_qpos: Positions after each step, (..., T, q).
        next_qvel: Velocities after each step, (..., T, v).
        of: The robot; the hopper if not given.

    Returns:
        True up to the first fall, (..., T). The stock return is the sum of the rewards there.
    """
    upright = (of or robot_named("hopper")).healthy(next_qpos, next_qvel)
    before = np.concatenate([np.ones_like(upright[..., :1]), upright[..., :-1]], axis=-1)
    return np.logical_and.accumulate(before, axis=-1)


def _backflip_task(
    next_obs: np.ndarray,
    actions: np.ndarray,
    qpos: np.ndarray,
    next_qpos: np.ndarray,
    next_qvel: np.ndarray,
) -> np.ndarray:
    return backflip_reward(next_obs, actions)


def _hop_task(
    next_obs: np.ndarray,
    actions: np.ndarray,
    qpos: np.ndarray,
    next_qpos: np.ndarray,
    next_qvel: np.ndarray,
) -> np.ndarray:
    return hop_reward(qpos, next_qpos, next_qvel, actions)


TaskReward = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]

TASK_REWARDS: dict[str, TaskReward] = {"backflip": _backflip_task, "hop": _hop_task}
"""Hand-coded reward of each task: (next_obs, actions, qpos, next_qpos, next_qvel), each
(..., n), to reward per step, (...)."""


def task_reward(
    task: str, obs: np.ndarray, actions: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
) -> np.ndarray:
    """The hand-coded reward of whole episodes, per step.

    Args:
        task: A key of ``TASK_REWARDS``.
        obs: (..., T + 1, o).
        actions: (..., T, a).
        qpos: (..., T + 1, q).
        qvel: (..., T + 1, v).

    Returns:
        (..., T).
    """
    after = (..., slice(1, None), slice(None))
    before = (..., slice(None, -1), slice(None))
    return TASK_REWARDS[task](obs[after], actions, qpos[before], qpos[after], qvel[after])
