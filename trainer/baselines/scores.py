"""What every baseline reports: scores of 16 deterministic episodes, and the files of a training.

Shapes: N episodes, T control steps.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from onedemo.demos.ground_truth import SUFFIX, HiddenStates, save_hidden
from onedemo.errors import UserError
from onedemo.evaluation.metrics import clean_turns, net_turns
from onedemo.rl.policy import Policy
from onedemo.rl.rollouts import Episodes
from onedemo.robots.registry import robot_named
from onedemo.robots.robot import Robot
from onedemo.sim.task_rewards import TASK_REWARDS, task_reward, until_fall


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """An evaluation: 16 deterministic episodes."""

    steps: int
    """Control steps used for training so far."""
    seconds: float
    """Wall time so far."""
    reward_mean: float
    """Hand-coded reward of an episode."""
    reward_max: float
    """Of the best episode."""
    net_turns_mean: float
    """Backward turns of an episode."""
    clean_turns_mean: float
    """Backward turns of an episode on the foot alone."""
    upright_seconds: float
    """Mean time until it would have fallen by gymnasium's rule."""
    travel: float = 0.0
    """Mean distance gone, metres."""


FORWARD = "forward"
"""Gymnasium's own reward of a robot: ahead, upright, with small actions."""
TASKS = (*TASK_REWARDS, FORWARD)
"""Hand-coded rewards."""
UNTIL_FALL = ("hop", FORWARD)
"""Those that end with a fall, by gymnasium's rule."""


def check_task(robot: str, task: str) -> None:
    """Whether a robot has a hand-coded reward.

    Raises:
        UserError: If there is no such robot or task, or the task is the hopper's.
    """
    own = TASKS if robot_named(robot).name == "hopper" else (FORWARD,)
    if task not in own:
        raise UserError(f"unknown task {task!r} of robot {robot!r}; choose one of: {', '.join(sorted(own))}")


def measure(
    task: str, episodes: Episodes, *, steps: int, seconds: float, of: Robot | None = None
) -> tuple[Score, HiddenStates]:
    """The score of an evaluation, and its episode of the highest reward.

    Args:
        task: One of ``TASKS``.
        episodes: The evaluation.
        steps: Control steps used for training so far.
        seconds: Wall time so far.
        of: The robot; the hopper if not given.
    """
    states = episodes.obs, episodes.actions, episodes.qpos, episodes.qvel
    of = of or robot_named("hopper")
    rewards_NT = episodes.rewards if task == FORWARD else task_reward(task, *states)
    upright_NT = until_fall(episodes.qpos[:, 1:], episodes.qvel[:, 1:], of)
    if task in UNTIL_FALL:  # the stock episode ends at the fall
        rewards_NT = rewards_NT * upright_NT
    totals_N = rewards_NT.sum(1)
    score = Score(
        steps=steps,
        seconds=round(seconds, 1),
        reward_mean=float(totals_N.mean()),
        reward_max=float(totals_N.max()),
        net_turns_mean=float(net_turns(episodes.qpos[..., 2]).mean()) if of.root == "planar" else 0.0,
        clean_turns_mean=float(clean_turns(episodes.qpos).mean()) if of.name == "hopper" else 0.0,
        upright_seconds=float(upright_NT.sum(1).mean() * of.dt),
        travel=float((episodes.qpos[:, -1, 0] - episodes.qpos[:, 0, 0]).mean()),
    )
    lane = int(totals_N.argmax())
    episode = HiddenStates(
        obs=episodes.obs[lane],
        actions=episodes.actions[lane],
        qpos=episodes.qpos[lane],
        qvel=episodes.qvel[lane],
    )
    return score, episode


SAVED = (SUFFIX, ".policy.pt", ".json")
"""What the names of the files of a training end in, after its prefix."""


def save_training(
    prefix: Path,
    *,
    config: Any,
    curve: Sequence[Score],
    policy: Policy,
    episode: HiddenStates,
    **scores: Score,
) -> None:
    """Writes ``<prefix>.hidden.npz``, ``<prefix>.policy.pt`` and ``<prefix>.json``.

    Args:
        prefix: Where.
        config: Settings, a dataclass.
        curve: Evaluations.
        policy: What to keep.
        episode: One of its episodes.
        **scores: Evaluations to name in the JSON file, beside the curve.
    """
    hidden, weights, scored = (prefix.with_name(prefix.name + suffix) for suffix in SAVED)
    save_hidden(hidden, episode)
    torch.save(policy.to_dict(), weights)
    report = {
        "config": asdict(config),
        **{name: asdict(score) for name, score in scores.items()},
        "curve": [asdict(score) for score in curve],
    }
    scored.write_text(json.dumps(report, indent=2) + "\n")
