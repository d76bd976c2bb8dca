"""What learns, without threads, files or people: a predictor from ratings, a policy from the predictor.

The same config, demo and ratings, given at the same iterations, lead to the same policy. Nothing here
sees a demo's hidden states: the demo enters as features of its frames.

Shapes: N lanes, T control steps, F demo frames, D frame features, W control steps a clip.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from onedemo.config import RunConfig
from onedemo.demos.frame_clock import frame_of_step
from onedemo.errors import UserError
from onedemo.queries.selection import Question, choose
from onedemo.reward.episode_rules import PracticeRules, ResetBuffer, fill_reset_buffer, mean_rating
from onedemo.reward.latent_track import track_basis
from onedemo.reward.model import (
    FitStats,
    Lens,
    Snapshot,
    View,
    check_start,
    expected,
    fit,
    fit_lens,
    visual_inputs,
)
from onedemo.rl.policy import Policy, PolicySnapshot, check_device
from onedemo.rl.random_states import wild_rollouts
from onedemo.rl.rollouts import Collector, EpisodeRules, Transitions
from onedemo.rl.trpo import Trpo
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env
from onedemo.sim.kinematics import body_of
from onedemo.storage.rating_records import RatedSegment
from onedemo.types import Rollouts, Segment
from onedemo.vision.pose_estimator import Track

_RANDOM_LANES = 16
_WILD_SECONDS = 0.96
"""How long random states run on before the next."""
_AHEAD_SECONDS = (0.0, 0.13, 0.33)
"""The policy sees the demo as it is now and so far ahead (policy.kind = "table")."""
_JUDGED_EVERY = 4
"""Control steps between those that are looked at to choose a clip."""
_LOOKED_AT = 500
"""States of an iteration about which the members are asked."""
_DEVICE_LANES = 1024
"""From so many lanes on an accelerator acts itself; with fewer the way there and back costs more."""


class Learner:
    """The similarity predictor and the policy of one run.

    Args:
        config: The run's settings.
        frames: How many frames the demo has, F.
        fps: Frames per second of the demo.
        start: A predictor of another move: each fit starts from it, and before the first one it
            chooses what is asked. Practice waits for ratings all the same. None: from scratch.

    Raises:
        UserError: If the demo is shorter than a clip, or the device cannot be used.
    """

    def __init__(self, config: RunConfig, frames: int, fps: float, start: Snapshot | None = None) -> None:
        self.robot = robot_named(config.env)
        check_device(config.device)
        self.config = config
        self.dt = self.robot.dt
        self._table_dims = 2 * body_of(self.robot).pose_size
        self.demo_steps, self.clip_steps = lengths(config, frames, fps)
        self.iteration = 0
        self.env_steps = 0
        self.seconds: dict[str, float] = {}
        """What parts of the last iteration took."""
        self._view: View | None = None
        self._start = start
        self._first: Snapshot | None = None  # the start beside this demo
        self._fps = fps
        self._frames = frame_of_step(np.arange(self.demo_steps), self.dt, fps, frames)
        self._policy = self._make_policy().to(config.device)
        self._trpo = Trpo(self._policy, config.trpo, seed=config.seed, threads=config.rollouts.threads)
        self._acts_on_device = config.device != "cpu" and config.rollouts.lanes >= _DEVICE_LANES
        self._rules = self.rules(config.rollouts.lanes)
        self._collector = self._make_collector(
            config.rollouts.lanes, seed=config.seed, stagger=True, rules=self._rules
        )
        self._buffer: ResetBuffer | None = None
        self._buffer_of = 0  # number of the snapshot that filled it
        self._wild: Transitions | None = None

    def look_at(self, features: np.ndarray, track: Track | None = None) -> None:
        """Takes in the demo. Random rollouts and clips need none of it; fits do.

        Args:
            features: Features of its frames, (F, D).
            track: What the frames show of the robot; None if that is not known.

        Raises:
            UserError: If the predictor to start from is of another kind, or was fitted with another encoder.
        """
        lens = self._lens(features)
        self._view = View(
            visual=lens.see(features) if self._start is None else lens.see_other(features),
            track=track,
            basis=track_basis(features, self._fps),
            fps=self._fps,
            lens=lens,
            robot=self.config.env,
        )
        if self._start is not None:
            check_start(self._start, self.config.predictor)
            self._first = self._start.beside(self._view)
        if self.config.policy.kind == "table":
            if track is not None:
                shown = np.concatenate([track.pose, track.motion], axis=-1)
            else:
                shown = visual_inputs(features, self._table_dims)
                shown = np.pad(shown, ((0, 0), (0, self._table_dims - shown.shape[1])))
            self._policy.table = self._ahead(shown)

    @property
    def env(self) -> str:
        """Name of the robot."""
        return self.config.env

    def policy(self) -> PolicySnapshot:
        """The current policy, as a copy that any thread may use."""
        return self._policy.snapshot()

    def random_rollouts(self) -> Transitions:
        """What the robot does at random, the same for the same seed: clips to rate before there is a policy.

        With ``ratings.starts = "random"`` random actions in random states; else whole episodes of the
        untrained policy, which is its noise, from standing.
        """
        config = self.config
        if config.ratings.starts == "random":
            return self._wild_rollouts()  # the reset buffer picks from the same
        collector = self._make_collector(_RANDOM_LANES, seed=config.seed + 1, stagger=False)
        return collector.collect(self._make_policy().snapshot(), self.demo_steps)

    def frames_of(self, demo_steps: np.ndarray) -> np.ndarray:
        """The demo frame on screen at control steps, which may lie past the end: same shape."""
        return self._frames[np.minimum(demo_steps, self.demo_steps - 1)]

    def fit(self, ratings: Sequence[RatedSegment], number: int) -> tuple[Snapshot, FitStats]:
        """Fits snapshot ``number`` on ratings.

        Raises:
            ValueError: If there is none.
        """
        assert self._view is not None, "look_at comes before fit"
        steps = np.array([r.demo_step for r in ratings])[:, None] + np.arange(self.clip_steps)
        return fit(
            ratings,
            self.frames_of(steps),
            self._view,
            self.config.predictor,
            number=number,
            seed=self.config.seed,
            device=self.config.device,
            start=self._start,
        )

    def choose(
        self, rollouts: Rollouts, snapshot: Snapshot | None, count: int, rng: np.random.Generator
    ) -> list[Question]:
        """Chooses clips of rollouts to be rated, by the run's settings (``trainer/queries/selection.py``)."""
        config = self.config.ratings
        snapshot = snapshot or self._first

        def predict(
            lanes: np.ndarray, starts: np.ndarray, demo_steps: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray]:
            assert snapshot is not None
            span = np.arange(0, self.clip_steps, _JUDGED_EVERY)
            cut = (lanes[:, None], starts[:, None] + span)
            frames = self.frames_of(demo_steps[:, None] + span)
            return snapshot.clip_ratings(frames, rollouts.obs[cut], rollouts.actions[cut])

        return choose(
            rollouts,
            count,
            self.clip_steps,
            self.demo_steps,
            rng,
            any_time=config.pairing == "any" and self.iteration == 0,
            how=config.choice,
            predict=predict if snapshot is not None else None,
        )

    def predict(self, snapshot: Snapshot, segment: Segment, demo_step: int) -> float:
        """The rating that a snapshot predicts for a clip: the mean over its steps, 1..5."""
        frames = self.frames_of(demo_step + np.arange(len(segment)))
        return float(snapshot.ratings(frames, segment.obs, segment.actions).mean())

    def iterate(self, snapshot: Snapshot) -> tuple[Transitions, dict[str, float]]:
        """One iteration: rollouts, all scored by this one snapshot, and a TRPO step.

        Returns:
            The rollouts, and figures: ``predicted`` (mean rating, 1..5), those of ``TrpoStats``, and
            ``unstable``, the episodes that ended because the physics became unstable, if any did.
        """
        began = time.perf_counter()
        sizes = self.config.rollouts
        left = -(-(sizes.total_steps - self.env_steps) // sizes.lanes)
        steps = max(1, min(sizes.steps, left))
        policy = self._policy.snapshot(on_device=self._acts_on_device)
        self._use(snapshot)
        lost = self._collector.env.unstable
        rollouts = self._collector.collect(policy, steps)
        lost = self._collector.env.unstable - lost
        predicted = mean_rating(rollouts.rewards.ravel(), (rollouts.next_clock - rollouts.clock).ravel())
        collected = time.perf_counter()
        stats = self._trpo.update(rollouts, progress=min(1.0, self.env_steps / sizes.total_steps))
        self.seconds = {"rollouts": collected - began, "policy": time.perf_counter() - collected}
        self.iteration += 1
        self.env_steps += rollouts.clock.size
        figures: dict[str, float] = {"predicted": float(predicted), **asdict(stats)}
        if lost:
            figures["unstable"] = float(lost)
        return rollouts, figures

    def forecast(self, snapshot: Snapshot, ratings: Sequence[RatedSegment]) -> dict[str, float]:
        """How right a snapshot is about ratings that it was not fitted on; draws nothing at random.

        Args:
            snapshot: Fitted before they were given.
            ratings: n of them.

        Returns:
            Sums over them: ``new`` (n), ``hits`` (the most probable rating is the one given) and
            ``confidence`` (its probability). Nothing if n is 0.
        """
        if not ratings:
            return {}
        steps = np.array([r.demo_step for r in ratings])[:, None] + np.arange(self.clip_steps)
        obs, actions = (np.stack([getattr(r.segment, name) for r in ratings]) for name in ("obs", "actions"))
        chances = snapshot.probabilities(self.frames_of(steps), obs, actions).mean(axis=1)
        hits = chances.argmax(axis=-1) + 1 == np.array([r.value for r in ratings])
        return {
            "new": len(ratings), "hits": int(hits.sum()), "confidence": float(chances.max(axis=-1).sum()),
        }  # fmt: skip

    def diagnose(self, rollouts: Transitions, snapshot: Snapshot) -> dict[str, float | None]:
        """Figures of an iteration that nothing learns from, and that draw nothing at random.

        Returns:
            ``disagreement``, the members' standard deviation of the rating of a state, its mean over some
            states; ``episode_seconds``, the mean length of an episode, None if none ended; ``reference``, the
            rating of a robot that does what the demo shows, None where it is not known.
        """
        stride = max(1, rollouts.clock.size // _LOOKED_AT)
        obs, actions = (x.reshape(-1, x.shape[-1])[::stride] for x in (rollouts.next_obs, rollouts.actions))
        frames = self.frames_of(rollouts.next_clock.ravel()[::stride])
        members = expected(snapshot.member_probabilities(frames, obs, actions))
        ended = int((rollouts.terminated | rollouts.truncated).sum())
        return {
            "disagreement": float(members.std(axis=0).mean()),
            "episode_seconds": rollouts.clock.size * self.dt / ended if ended else None,
            "reference": snapshot.best(),
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs besides config, demo and ratings, for ``torch.save``."""
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "policy": self._policy.state_dict(),
            "trpo": self._trpo.state_dict(),
            "collector": self._collector.state_dict(),
            "rules": self._rules.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken."""
        self.iteration = state["iteration"]
        self.env_steps = state["env_steps"]
        self._policy.load_state_dict(state["policy"])
        self._trpo.load_state_dict(state["trpo"])
        self._collector.load_state_dict(state["collector"])
        self._rules.load_state_dict(state.get("rules", {}))

    def rules(self, lanes: int, snapshot: Snapshot | None = None) -> PracticeRules:
        """The run's rules for episodes of so many lanes; for evaluation and for the live view.

        Args:
            lanes: N.
            snapshot: What similarity is; needed before the rules can be used.
        """
        rules = PracticeRules(
            self.config.practice,
            lanes=lanes,
            dt=self.dt,
            demo_steps=self.demo_steps,
            frames_of=self.frames_of,
        )
        if snapshot is not None:
            rules.use(snapshot, None)
        return rules

    def _use(self, snapshot: Snapshot) -> None:
        """Lets rollouts follow a snapshot; a new one fills a new reset buffer, the same after a resume."""
        practice = self.config.practice
        if snapshot.number != self._buffer_of and (practice.bank_share or practice.give_up):
            rng = np.random.default_rng([self.config.seed, snapshot.number])
            wild = self._wild_rollouts()
            self._buffer = fill_reset_buffer(
                snapshot, wild, self.frames_of, self.demo_steps, rng, tries=practice.bank_tries, dt=self.dt
            )
            self._buffer_of = snapshot.number
        self._rules.use(snapshot, self._buffer)

    def _lens(self, features: np.ndarray) -> Lens:
        """The start's own, so that its weights mean the same; else one for this demo."""
        lens = self._start.lens if self._start is not None else None
        if lens is None:
            return fit_lens(features, self.config.predictor.visual_dims)
        if len(lens.mean) != features.shape[-1]:
            raise UserError(
                f"the predictor to start from was fitted on {len(lens.mean)} features of a frame, encoder "
                f"{self.config.encoder} gives {features.shape[-1]}; use the encoder of that run"
            )
        return lens

    def _wild_rollouts(self) -> Transitions:
        if self._wild is None:
            config, every = self.config, round(_WILD_SECONDS / self.dt)
            self._wild = wild_rollouts(
                config.env, lanes=config.practice.random_lanes, steps=8 * every, every=every,
                seed=config.seed + 1, nthread=config.rollouts.threads,
            )  # fmt: skip
            self._wild = _anywhere(self._wild, self.demo_steps - every, config.seed)
        return self._wild

    def _make_policy(self) -> Policy:
        robot, config = self.robot, self.config.policy
        table = None
        if config.kind == "table":  # filled in ``look_at``
            table = np.zeros((self.demo_steps, len(_AHEAD_SECONDS) * self._table_dims))
        return Policy(
            config, obs_size=robot.obs_size, action_size=robot.action_size, horizon=self.demo_steps,
            seed=self.config.seed, table=table, angles=robot.angles,
        )  # fmt: skip

    def _ahead(self, shown: np.ndarray) -> np.ndarray:
        """What the policy sees at each demo step: frames (F, k) now and ahead, (H, 3 k)."""
        steps = np.arange(self.demo_steps)
        ahead = [self.frames_of(steps + round(seconds / self.dt)) for seconds in _AHEAD_SECONDS]
        return np.concatenate([shown[frames] for frames in ahead], axis=-1)

    def _make_collector(
        self, lanes: int, *, seed: int, stagger: bool, rules: EpisodeRules | None = None
    ) -> Collector:
        rollouts = self.config.rollouts
        env = vector_env.make(
            self.config.env,
            lanes,
            horizon=self.demo_steps,
            nthread=rollouts.threads,
            physics=rollouts.physics,
        )
        return Collector(env, seed=seed, stagger=stagger, rules=rules)


def _anywhere(rollouts: Transitions, latest: int, seed: int) -> Transitions:
    """Rollouts whose episodes count from a random moment of the demo, up to ``latest``, instead of from 0.

    A random state has no moment of its own; where clips are paired by time, all of the demo is to be seen.
    """
    ended = rollouts.terminated | rollouts.truncated
    number = np.cumsum(ended, axis=1) - ended  # of the episode in its lane
    rng = np.random.default_rng([seed, 1])
    begins = rng.integers(max(1, latest + 1), size=(len(number), int(number.max()) + 1))
    shift = np.take_along_axis(begins, number, axis=1).astype(np.int32)
    return replace(rollouts, clock=rollouts.clock + shift, next_clock=rollouts.next_clock + shift)


def lengths(config: RunConfig, frames: int, fps: float) -> tuple[int, int]:
    """Control steps of a demo and of a clip.

    Args:
        config: Names the robot and the length of a clip.
        frames: How many frames the demo has.
        fps: Frames per second of the demo.

    Raises:
        UserError: If the robot is unknown or the demo is shorter than a clip.
    """
    dt = robot_named(config.env).dt
    demo, clip = int(frames / fps / dt + 1e-6), int(config.ratings.clip_seconds / dt + 0.5)
    if demo < clip:
        raise UserError(
            f"the demo lasts {frames / fps:.2f} s, shorter than a clip of "
            f"{config.ratings.clip_seconds} s; use a longer video or a smaller ratings.clip_seconds"
        )
    return demo, clip
