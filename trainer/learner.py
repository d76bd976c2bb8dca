"""What learns, without threads, files or people: a predictor from ratings, a policy from the predictor.

The same config, demo and ratings, given at the same iterations, lead to the same policy. Nothing here
sees a demo's hidden states: the demo enters as features of its frames.

Shapes: N lanes, T control steps, F demo frames, D frame features, W control steps a clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from trainer import envs
from trainer.config import RunConfig
from trainer.errors import UserError
from trainer.policy import Policy, PolicySnapshot, check_device
from trainer.predictor import FitStats, Snapshot, fit, visual_inputs
from trainer.records import Segment
from trainer.rollouts import Collector, Transitions
from trainer.store import RatedSegment
from trainer.timing import frame_of_step
from trainer.trpo import Trpo

_RANDOM_LANES = 16
_DEVICE_LANES = 1024
"""From so many lanes on an accelerator acts itself; with fewer the way there and back costs more."""


class Learner:
    """The similarity predictor and the policy of one run.

    Args:
        config: The run's settings.
        frames: How many frames the demo has, F.
        fps: Frames per second of the demo.

    Raises:
        UserError: If the demo is shorter than a clip, or the device cannot be used.
    """

    def __init__(self, config: RunConfig, frames: int, fps: float) -> None:
        spec = envs.spec(config.env)
        check_device(config.device)
        self.config = config
        self.dt = spec.dt
        self.demo_steps, self.clip_steps = lengths(config, frames, fps)
        self.iteration = 0
        self.env_steps = 0
        self._visual: np.ndarray | None = None
        self._frames = frame_of_step(np.arange(self.demo_steps), spec.dt, fps, frames)
        self._policy = Policy(
            config.policy,
            obs_size=spec.obs_size,
            action_size=spec.action_size,
            horizon=self.demo_steps,
            seed=config.seed,
        ).to(config.device)
        self._trpo = Trpo(self._policy, config.trpo, seed=config.seed, threads=config.rollouts.threads)
        self._acts_on_device = config.device != "cpu" and config.rollouts.lanes >= _DEVICE_LANES
        self._collector = self._make_collector(config.rollouts.lanes, seed=config.seed, stagger=True)

    def look_at(self, features: np.ndarray) -> None:
        """Takes in the demo's frame features, (F, D). Random rollouts and clips need none; fits do."""
        self._visual = visual_inputs(features, self.config.predictor.visual_dims)

    def policy(self) -> PolicySnapshot:
        """The current policy, as a copy that any thread may use."""
        return self._policy.snapshot()

    def random_rollouts(self) -> Transitions:
        """Whole episodes of the untrained policy, which is its noise: the same for the same seed."""
        config = self.config
        policy = Policy(
            config.policy,
            obs_size=self._policy.obs_size,
            action_size=self._policy.action_size,
            horizon=self.demo_steps,
            seed=config.seed,
        )
        collector = self._make_collector(_RANDOM_LANES, seed=config.seed + 1, stagger=False)
        return collector.collect(policy.snapshot(), self.demo_steps)

    def frames_of(self, demo_steps: np.ndarray) -> np.ndarray:
        """The demo frame on screen at control steps, which may lie past the end: same shape."""
        return self._frames[np.minimum(demo_steps, self.demo_steps - 1)]

    def fit(self, ratings: Sequence[RatedSegment], number: int) -> tuple[Snapshot, FitStats]:
        """Fits snapshot ``number`` on ratings.

        Raises:
            ValueError: If there is none.
        """
        assert self._visual is not None, "look_at comes before fit"
        steps = np.array([r.demo_step for r in ratings])[:, None] + np.arange(self.clip_steps)
        return fit(
            ratings,
            self.frames_of(steps),
            self._visual,
            self.config.predictor,
            number=number,
            seed=self.config.seed,
            device=self.config.device,
        )

    def predict(self, snapshot: Snapshot, segment: Segment, demo_step: int) -> float:
        """The rating that a snapshot predicts for a clip: the mean over its steps, 1..5."""
        frames = self.frames_of(demo_step + np.arange(len(segment)))
        return float(snapshot.ratings(frames, segment.obs, segment.actions).mean())

    def iterate(self, snapshot: Snapshot) -> tuple[Transitions, dict[str, float]]:
        """One iteration: rollouts, all scored by this one snapshot, and a TRPO step.

        Returns:
            The rollouts, and figures: ``predicted`` (mean rating, 1..5) and those of ``TrpoStats``.
        """
        sizes = self.config.rollouts
        left = -(-(sizes.total_steps - self.env_steps) // sizes.lanes)
        steps = max(1, min(sizes.steps, left))
        policy = self._policy.snapshot(on_device=self._acts_on_device)
        rollouts = self._collector.collect(policy, steps)
        rewards = snapshot.ratings(self.frames_of(rollouts.clock), rollouts.obs, rollouts.actions)
        stats = self._trpo.update(rollouts, rewards)
        self.iteration += 1
        self.env_steps += rollouts.clock.size
        return rollouts, {"predicted": float(rewards.mean()), **asdict(stats)}

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs besides config, demo and ratings, for ``torch.save``."""
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "policy": self._policy.state_dict(),
            "trpo": self._trpo.state_dict(),
            "collector": self._collector.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken."""
        self.iteration = state["iteration"]
        self.env_steps = state["env_steps"]
        self._policy.load_state_dict(state["policy"])
        self._trpo.load_state_dict(state["trpo"])
        self._collector.load_state_dict(state["collector"])

    def _make_collector(self, lanes: int, *, seed: int, stagger: bool) -> Collector:
        rollouts = self.config.rollouts
        env = envs.make(
            self.config.env,
            lanes,
            horizon=self.demo_steps,
            nthread=rollouts.threads,
            physics=rollouts.physics,
        )
        return Collector(env, seed=seed, stagger=stagger)


def lengths(config: RunConfig, frames: int, fps: float) -> tuple[int, int]:
    """Control steps of a demo and of a clip.

    Args:
        config: Names the robot and the length of a clip.
        frames: How many frames the demo has.
        fps: Frames per second of the demo.

    Raises:
        UserError: If the robot is unknown or the demo is shorter than a clip.
    """
    dt = envs.spec(config.env).dt
    demo, clip = int(frames / fps / dt + 1e-6), int(config.ratings.clip_seconds / dt + 0.5)
    if demo < clip:
        raise UserError(
            f"the demo lasts {frames / fps:.2f} s, shorter than a clip of "
            f"{config.ratings.clip_seconds} s; use a longer video or a smaller ratings.clip_seconds"
        )
    return demo, clip
