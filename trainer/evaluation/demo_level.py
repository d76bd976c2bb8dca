"""What the demo itself would get: the level beside which a robot's figures mean something."""

from __future__ import annotations

import numpy as np

from onedemo.demos.frame_clock import frame_of_step
from onedemo.demos.ground_truth import HiddenStates, hidden_path, load_hidden
from onedemo.errors import UserError
from onedemo.reward.model import Snapshot
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
    states = _states(demo)
    if states is None:
        return None
    return float(task_reward(demo.task, states.obs, states.actions, states.qpos, states.qvel).sum())


def predicted_rating_of(demo: Demo, snapshot: Snapshot, dt: float) -> float | None:
    """The rating that a reward model predicts for the movement in the demo itself, the mean over it.

    For kinds that cannot tell it from the video alone (``Snapshot.best``).

    Args:
        demo: What is learned.
        snapshot: Fitted beside it.
        dt: Seconds of a control step.

    Returns:
        1..5; None where the states behind the video are not known, or are another robot's.
    """
    states = _states(demo)
    if states is None:
        return None
    frames = frame_of_step(np.arange(1, len(states.obs)), dt, demo.fps, demo.frames)
    try:
        return float(snapshot.ratings(frames, states.obs[1:], states.actions).mean())
    except (RuntimeError, ValueError):  # its arrays have other widths
        return None


def _states(demo: Demo) -> HiddenStates | None:
    try:
        return load_hidden(hidden_path(demo.path))
    except UserError:
        return None
