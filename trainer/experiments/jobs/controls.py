"""What the method is compared with: rewards that somebody wrote, comparisons, and the true rating.

Each gives the same kind of result as ``onedemo.experiments.jobs.method``. Settings: ``demo``, which the
episodes are compared with, and ``steps`` of practice, and those named below.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from onedemo.annotators.oracle import Oracle, appearance
from onedemo.baselines.handcoded_trpo import HandcodedConfig, train_handcoded
from onedemo.baselines.preferences import PreferencesConfig, split_comparisons, train_preferences
from onedemo.baselines.scores import Score
from onedemo.config import load_config
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.ground_truth import HiddenStates
from onedemo.demos.library import find_demo
from onedemo.errors import UserError
from onedemo.evaluation.episodes import per_episode, perform_policy
from onedemo.experiments.jobs.method import POINTS, Watch, hidden_of, oracle_of, outcome
from onedemo.reward.model import CLASSES, PredictorConfig, Snapshot
from onedemo.rl.policy import Policy
from onedemo.rl.trpo import TrpoConfig
from onedemo.robots.registry import robot_named
from onedemo.robots.robot import Robot
from onedemo.sim.kinematics import body_of
from onedemo.training.learner import Learner
from onedemo.types import Demo
from onedemo.vision.pose_estimator import Track

_TRPO = {"backflip": TrpoConfig(), "hop": TrpoConfig(max_kl=0.02, gamma=0.995)}
"""Those that made the built-in demos."""


def handcoded(settings: Mapping[str, Any], seed: int, scratch: Path) -> dict[str, Any]:
    """TRPO on the hand-coded reward of the demo's task (the paper's first baseline); the *final* policy.

    Args:
        settings: See above.
        seed: Of everything random.
        scratch: Not used.
    """
    began, demo = time.monotonic(), find_demo(settings["demo"], scratch)
    sizes = HandcodedConfig()
    config = HandcodedConfig(
        task=demo.task, steps=settings["steps"], seed=seed, threads=1,
        evaluate_every=_every(settings["steps"], sizes.lanes * sizes.batch), trpo=_TRPO[demo.task],
    )  # fmt: skip
    trained = train_handcoded(config, progress=False)
    return _baseline(demo, trained.final, trained.curve) | {
        "ratings": 0,
        "seconds": {"training": round(time.monotonic() - began, 1)},
    }


def preferences(settings: Mapping[str, Any], seed: int, scratch: Path) -> dict[str, Any]:
    """Learning from preferences (the paper's second baseline).

    Args:
        settings: And ``comparisons``, in all.
        seed: Of everything random.
        scratch: Not used.
    """
    began, demo = time.monotonic(), find_demo(settings["demo"], scratch)
    sizes = PreferencesConfig()
    pretrain, online = split_comparisons(settings["comparisons"])
    config = PreferencesConfig(
        pretrain=pretrain, online=online, steps=settings["steps"], seed=seed, threads=1,
        evaluate_every=_every(settings["steps"], sizes.lanes * sizes.batch),
    )  # fmt: skip
    trained = train_preferences(config, progress=False)
    return _baseline(demo, trained.final, trained.curve) | {
        "ratings": trained.curve[-1].comparisons,
        "reward_correlation": round(trained.curve[-1].correlation, 4),
        "seconds": {"training": round(time.monotonic() - began, 1)},
    }


def truth(settings: Mapping[str, Any], seed: int, scratch: Path) -> dict[str, Any]:
    """TRPO on the *true* rating: what a perfect predictor would give. The ceiling, and no method.

    Args:
        settings: And ``method``: "paper" practises by a fixed clock from standing starts, "onedemo" with
            an adaptive phase, a reset buffer and early termination; and ``set``, as in
            ``onedemo.experiments.jobs.method``.
        seed: Of everything random.
        scratch: Not used.

    Raises:
        UserError: If the demo has no hidden states.
    """
    began, demo = time.monotonic(), find_demo(settings["demo"], scratch)
    hidden = hidden_of(demo)
    if hidden is None:
        raise UserError(f"there is no true rating: demo {demo.name!r} has no hidden states")
    given = {
        "method": settings["method"], "seed": seed, "rollouts.total_steps": settings["steps"],
        "rollouts.threads": 1,
    }  # fmt: skip
    config = load_config(None, given | settings.get("set", {}))
    torch.set_num_threads(1)
    learner = Learner(config, demo.frames, demo.fps)
    body = body_of(robot_named(config.env))
    seen = body.seen(hidden.obs[_steps(demo, hidden, body.robot)])
    track = Track(**{name: x.astype(np.float32) for name, x in seen._asdict().items()})
    learner.look_at(track.pose, track)
    snapshot = TrueRating(demo, hidden, config.env)
    watch = Watch(hidden, config.rollouts.total_steps, config.env)
    while learner.env_steps < config.rollouts.total_steps:
        learner.iterate(snapshot)
        watch(learner, snapshot)
    return {
        **watch.result(demo),
        "ratings": 0,
        "env_steps": learner.env_steps,
        "seconds": {
            "training": round(watch.ended - began - watch.seconds, 1),
            "evaluation": round(watch.seconds, 1),
        },
    }


class TrueRating(Snapshot):
    """**The ceiling, and no method**: it reads the demo's hidden states, which nothing that learns may.

    It stands where the similarity predictor would, and gives each single state the rating of the oracle
    without error, as if somebody had rated every state of every rollout. It lives among the benchmarks,
    which nothing that learns imports.

    Args:
        demo: Whose frames are meant.
        hidden: Its states.
        robot: Name of the robot.
    """

    def __init__(self, demo: Demo, hidden: HiddenStates, robot: str = "hopper") -> None:
        super().__init__(number=1, config=PredictorConfig())
        self._oracle = Oracle(hidden, robot, budget=0)
        self._body = self._oracle.body
        steps = _steps(demo, hidden, self._body.robot)
        self._demo = appearance(hidden.qpos[steps], hidden.qvel[steps], self._body)

    def member_probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Certainty about the one true rating, by the one member."""
        # An observation lacks the place on the floor alone, which cannot be seen.
        seen = appearance(*self._body.robot.state(obs), self._body)
        distance = np.linalg.norm(self._demo[frames] - seen, axis=-1)
        return np.eye(CLASSES, dtype=np.float32)[self._oracle.rating_of(distance) - 1][None]

    def tensors(self) -> dict[str, Any]:
        """It is not kept."""
        raise NotImplementedError("the true rating is not a predictor to be saved")


def _baseline(demo: Demo, policy: Policy, curve: Sequence[Score]) -> dict[str, Any]:
    episodes, oracle = perform_policy(policy.snapshot()), oracle_of(hidden_of(demo))
    names = {
        "env_steps": "steps", "net_turns": "net_turns_mean", "clean_turns": "clean_turns_mean",
        "backflip_reward" if demo.task == "backflip" else "hop_return": "reward_mean",
    }  # fmt: skip
    return {
        **outcome(episodes, per_episode(episodes, oracle), demo, oracle),
        "curve": {name: [getattr(score, field) for score in curve] for name, field in names.items()},
        "env_steps": curve[-1].steps,
    }


def _steps(demo: Demo, hidden: HiddenStates, robot: Robot) -> np.ndarray:
    """Control step that each frame shows."""
    steps = steps_of_frames(demo.frames, robot.dt, demo.fps)
    return np.minimum(steps, len(hidden.qpos) - 1)


def _every(steps: int, per_iteration: int) -> int:
    """Iterations between evaluations that give about ``POINTS`` of them."""
    return max(1, round(steps / per_iteration / POINTS))
