"""What the demo itself would get: the level beside which a robot's figures mean something."""

from __future__ import annotations

from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.errors import UserError
from onedemo.sim.task_rewards import TASK_REWARDS, task_reward
from onedemo.types import Demo


def true_reward_of(demo: Demo) -> float | None:
    """The hand-coded reward of the movement in a demo, summed over it.

    Returns:
        None where the move has no such reward, or the states behind the video are not known: of a video
        that was not simulated they never are.
    """
    if demo.task not in TASK_REWARDS:
        return None
    try:
        states = load_hidden(hidden_path(demo.path))
    except UserError:
        return None
    return float(task_reward(demo.task, states.obs, states.actions, states.qpos, states.qvel).sum())
