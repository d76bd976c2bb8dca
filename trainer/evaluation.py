"""What a trained policy is worth: 16 deterministic episodes, and how like the demo they are.

Evaluation may read hidden demo states; nothing in ``trainer.learner`` or ``trainer.loop`` may.
"""

from __future__ import annotations

import numpy as np

from trainer.learner import Learner
from trainer.motion import backflip_reward, clean_turns, net_turns
from trainer.predictor import Snapshot
from trainer.raters import Oracle
from trainer.rollouts import Episodes, evaluate

EPISODES = 16
_SEED = 10_000
"""Of the start states: the same for every policy, and used by no training."""


def summarise(
    learner: Learner, snapshot: Snapshot | None, oracle: Oracle | None
) -> dict[str, dict[str, float] | None]:
    """Figures of the current policy over 16 deterministic episodes, each {mean, best, worst}.

    Args:
        learner: Holds the policy.
        snapshot: Predicts similarity; None leaves that figure out.
        oracle: Knows the demo's hidden states; None leaves the true similarity out.

    Returns:
        ``predicted_similarity`` and ``true_similarity`` (mean rating of a step, 1..5),
        ``backflip_reward`` (actions clipped to what the motors do), ``backflip_reward_raw_actions``,
        ``net_turns`` and ``clean_turns``; None where a figure cannot be had.
    """
    episodes = evaluate(
        learner.policy(), learner.config.env, episodes=EPISODES, seed=_SEED,
        rules=learner.rules(EPISODES, snapshot) if snapshot is not None else None,
    )  # fmt: skip
    return {
        "predicted_similarity": _spread(_predicted(learner, snapshot, episodes)),
        "true_similarity": _spread(_true(oracle, episodes)),
        "backflip_reward": _spread(backflip_reward(episodes.obs[:, 1:], episodes.actions).sum(axis=-1)),
        "backflip_reward_raw_actions": _spread(
            backflip_reward(episodes.obs[:, 1:], episodes.actions, clip_actions=False).sum(axis=-1)
        ),
        "net_turns": _spread(net_turns(episodes.qpos[..., 2])),
        "clean_turns": _spread(clean_turns(episodes.qpos)),
    }


def _predicted(learner: Learner, snapshot: Snapshot | None, episodes: Episodes) -> np.ndarray | None:
    if snapshot is None:
        return None
    frames = learner.frames_of(episodes.clock[:, :-1])
    return snapshot.ratings(frames, episodes.obs[:, :-1], episodes.actions).mean(axis=-1)


def _true(oracle: Oracle | None, episodes: Episodes) -> np.ndarray | None:
    if oracle is None:
        return None
    lanes = zip(episodes.qpos[:, :-1], episodes.qvel[:, :-1], strict=True)
    return np.array([oracle.true_similarity(qpos, qvel) for qpos, qvel in lanes])


def _spread(values: np.ndarray | None) -> dict[str, float] | None:
    if values is None:
        return None
    return {
        "mean": round(float(np.mean(values)), 4),
        "best": round(float(np.max(values)), 4),
        "worst": round(float(np.min(values)), 4),
    }
