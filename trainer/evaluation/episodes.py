"""What a trained policy is worth: 16 deterministic episodes, and how like the demo they are.

Evaluation may read hidden demo states; nothing in ``onedemo.training.learner`` or
``onedemo.training.training_run`` may.

Shapes: N episodes, T control steps, o observations, q positions, v velocities.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from onedemo.annotators.oracle import Oracle, appearance
from onedemo.evaluation.metrics import clean_turns, farthest_turn, landings, net_turns, turned
from onedemo.evaluation.robot_figures import robot_figures
from onedemo.evaluation.time_warping import align
from onedemo.reward.episode_rules import mean_rating
from onedemo.reward.model import Snapshot
from onedemo.rl.policy import PolicySnapshot
from onedemo.rl.rollouts import EpisodeRules, Episodes, evaluate
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import without_turns
from onedemo.sim.task_rewards import backflip_reward

EPISODES = 16
ALIGN_SECONDS = 0.6
"""How late or early the robot may be when it is laid along the demo; as far as an adaptive phase goes
by default (``practice.slack_seconds``), but the same for every method."""
LEAST_IS_BEST = ("state_error", "energy")
"""Figures whose best episode has the least."""

_SEED = 10_000
"""Of the start states: the same for every policy, and used by no training."""
_EVERY_SECONDS = 0.032
"""Between the moments that are aligned: about a frame."""


class Trained(Protocol):
    """What is evaluated: a ``training.learner.Learner``."""

    @property
    def env(self) -> str:
        """Name of the robot."""
        ...

    def policy(self) -> PolicySnapshot:
        """The current policy."""
        ...

    def rules(self, lanes: int, snapshot: Snapshot | None = None) -> EpisodeRules:
        """How the demo phase moves in so many episodes."""
        ...


def summarise(
    learner: Trained, snapshot: Snapshot | None, oracle: Oracle | None
) -> dict[str, dict[str, float] | None]:
    """Figures of the current policy over 16 deterministic episodes, each {mean, best, worst}.

    Args:
        learner: Holds the policy.
        snapshot: Predicts similarity; None leaves that figure out.
        oracle: Knows the demo's hidden states; None leaves out what compares with them.

    Returns:
        ``predicted_similarity`` (mean rating over the demo, 1..5) and all of ``per_episode``; None where a
        figure cannot be had.
    """
    episodes = perform(learner, snapshot)
    figures = {"predicted_similarity": predicted_similarity(episodes) if snapshot is not None else None}
    figures |= per_episode(episodes, oracle, learner.env)
    return {name: spread(name, values) for name, values in figures.items()}


def perform(learner: Trained, snapshot: Snapshot | None) -> Episodes:
    """The 16 episodes of the current policy; the snapshot gives rewards and moves an adaptive phase."""
    rules = learner.rules(EPISODES, snapshot) if snapshot is not None else None
    return perform_policy(learner.policy(), env_name=learner.env, rules=rules)


def perform_policy(
    policy: PolicySnapshot, *, env_name: str = "hopper", rules: EpisodeRules | None = None
) -> Episodes:
    """The 16 episodes of any policy, from the same starts for all of them."""
    return evaluate(policy, env_name, episodes=EPISODES, seed=_SEED, rules=rules)


def predicted_similarity(episodes: Episodes) -> np.ndarray:
    """Mean predicted rating of each episode over the demo steps it passed, from its rewards, (N,)."""
    return mean_rating(episodes.rewards, np.diff(episodes.clock))


def per_episode(
    episodes: Episodes, oracle: Oracle | None, robot: str = "hopper"
) -> dict[str, np.ndarray | None]:
    """What each episode was worth.

    Args:
        episodes: N of them.
        oracle: Knows the demo's hidden states; None leaves out what compares with them.
        robot: Name of the robot.

    Returns:
        Of each episode, (N,):

        - ``true_similarity``: mean rating of its states against the demo's at the same time, 1..5.
        - ``aligned_similarity``: the same once it is laid along the demo (``aligned_similarity``).
        - ``state_error``: mean squared error of its states (``state_errors``), mean over time.
        - what ``onedemo.evaluation.robot_figures`` says of any robot, and of a hopper ``hopper_figures``.
    """
    of, qpos, qvel = robot_named(robot), episodes.qpos, episodes.qvel
    compared = {
        "true_similarity": _true(oracle, episodes),
        "aligned_similarity": None if oracle is None else aligned_similarity(qpos, qvel, oracle),
        "state_error": None
        if oracle is None
        else state_errors(episodes.obs, oracle.hidden.obs, robot).mean(-1),
    }
    general = robot_figures(of, qpos, qvel, episodes.actions)
    return compared | general | (hopper_figures(episodes, general) if of.name == "hopper" else {})


def hopper_figures(
    episodes: Episodes, general: Mapping[str, np.ndarray | None]
) -> dict[str, np.ndarray | None]:
    """What there is to say of a hopper alone.

    Returns:
        Of each episode, (N,):

        - ``backflip_reward``, with the actions clipped to what the motors do, and
          ``backflip_reward_raw_actions``.
        - ``net_turns``, ``clean_turns``, ``landings``: see ``onedemo.evaluation.metrics``.
        - ``turned``, ``farthest_turn``: backward rotation in turns, not rounded; see
            ``onedemo.evaluation.metrics``.
        - ``hop_return``: of stock Hopper-v5, which ends at the first fall.
        - ``hop_reward``: the same rewards over the whole episode, falls or not.
    """
    qpos, actions, after = episodes.qpos, episodes.actions, episodes.obs[:, 1:]
    return {
        "backflip_reward": backflip_reward(after, actions).sum(axis=-1),
        "backflip_reward_raw_actions": backflip_reward(after, actions, clip_actions=False).sum(axis=-1),
        "net_turns": net_turns(qpos[..., 2]),
        "clean_turns": clean_turns(qpos),
        "landings": landings(qpos, robot_named("hopper").dt),
        "turned": turned(qpos[..., 2]),
        "farthest_turn": farthest_turn(qpos[..., 2]),
        "hop_reward": general["stock_reward"],
        "hop_return": general["stock_return"],
    }


def spread(name: str, values: np.ndarray | None) -> dict[str, float] | None:
    """A figure of several episodes as {mean, best, worst}; None stays None."""
    if values is None:
        return None
    best, worst = (np.min, np.max) if name in LEAST_IS_BEST else (np.max, np.min)
    return {
        "mean": round(float(np.mean(values)), 4),
        "best": round(float(best(values)), 4),
        "worst": round(float(worst(values)), 4),
    }


def aligned_similarity(qpos: np.ndarray, qvel: np.ndarray, oracle: Oracle) -> np.ndarray:
    """How like the demo episodes are if being early or late does not count, up to ``ALIGN_SECONDS``.

    Each episode is laid along the demo by dynamic time warping on the oracle's distance
    (``onedemo.evaluation.time_warping``); then every moment of the demo is rated against the episode's
    moment beside it.

    Args:
        qpos: Positions, (N, T, q).
        qvel: Velocities, (N, T, v).
        oracle: Knows the demo.

    Returns:
        Mean rating, 1..5, (N,).
    """
    dt = oracle.body.robot.dt
    step = max(1, round(_EVERY_SECONDS / dt))
    every = slice(None, None, step)
    demo = appearance(oracle.hidden.qpos[every], oracle.hidden.qvel[every], oracle.body)
    robot = appearance(qpos[:, every], qvel[:, every], oracle.body)
    distances = np.stack([np.linalg.norm(demo[:, None] - episode, axis=-1) for episode in robot])
    band = round(ALIGN_SECONDS / (step * dt))
    path = align(distances, band)
    return oracle.rating_of(np.take_along_axis(distances, path[..., None], axis=-1)[..., 0]).mean(axis=-1)


def state_errors(obs: np.ndarray, demo_obs: np.ndarray, robot: str = "hopper") -> np.ndarray:
    """Squared error of the states against the demo's at the same time: the paper's figure 3 (c).

    A state is the observation with angles that have no end, such as the torso's, as in a picture, by sine and
    cosine: a turn more or less cannot be seen. Each number, of a hopper 12, is divided by its standard
    deviation over the demo, at least 0.05; the error is the mean over them, so the demo's own mean state has
    an error of 1 on average.

    Args:
        obs: Observations, (N, T, o).
        demo_obs: The demo's, (T', o).
        robot: Name of the robot.

    Returns:
        (N, min(T, T')).
    """
    steps, of = min(obs.shape[1], len(demo_obs)), robot_named(robot)
    demo = without_turns(of, demo_obs)
    scale = np.maximum(demo.std(axis=0), _LEAST_DEVIATION)
    return np.square((without_turns(of, obs[:, :steps]) - demo[:steps]) / scale).mean(axis=-1)


_LEAST_DEVIATION = 0.05
"""Of a number that hardly moves in the demo, as the torso of a hop: without it, noise would be all."""


def _true(oracle: Oracle | None, episodes: Episodes) -> np.ndarray | None:
    if oracle is None:
        return None
    lanes = zip(episodes.qpos[:, :-1], episodes.qvel[:, :-1], strict=True)
    return np.array([oracle.true_similarity(qpos, qvel) for qpos, qvel in lanes])
