"""What a finished predictor is asked besides the ratings: whether it would do as a reward.

Hidden states are read here to judge, and by the oracle; no predictor gets to see them.

Shapes: n clips, W control steps a clip, T control steps of the demo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from onedemo.annotators.oracle import Oracle
from onedemo.demos.ground_truth import HiddenStates
from onedemo.experiments.predictor_scores import spearman
from onedemo.queries.selection import choose
from onedemo.reward.episode_rules import fill_reset_buffer
from onedemo.reward.model import Snapshot
from onedemo.rl.random_states import HeldNoise
from onedemo.sim import vector_env
from onedemo.training.learner import Learner
from onedemo.types import Rollouts, Segment

STANDING, WILD, OTHERS, ATTEMPTS = "random, standing", "random starts", "other moves", "attempts"
"""The policies whose clips are ranked."""
_STREAM = 50_000
"""Sets these random numbers apart from others that the same seed gives."""
_RUN_IN = 60
"""Control steps at most that a move is disturbed before a clip of it is cut."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Clips:
    """Clips of one policy beside the demo."""

    demo_steps: np.ndarray
    """(n,)"""
    segments: Sequence[Segment]
    distances: np.ndarray
    """True ones, each a mean over the clip, (n,)."""


class Exam:
    """The same questions for all predictors.

    Args:
        oracle: Knows the truth.
        hidden: The demo's states.
        others: Those of other moves.
        learner: Of onedemo; its random rollouts have not been rated.
        standing: What a random policy does from standing, not rated either.
        clips: Of each policy, n.
        seed: Of the choice of clips and the disturbances.
    """

    def __init__(
        self, oracle: Oracle, hidden: HiddenStates, others: Sequence[HiddenStates], learner: Learner,
        standing: Rollouts, *, clips: int, seed: int,
    ) -> None:  # fmt: skip
        self._oracle, self._hidden, self._learner = oracle, hidden, learner
        self._rng = np.random.default_rng([_STREAM, seed])
        self._seed = seed
        self._wild = learner.random_rollouts()
        steps = min(learner.demo_steps, len(hidden.actions))
        self._steps, self._shuffled = np.arange(steps), self._rng.permutation(steps)
        self._clips = {
            STANDING: self._cut(standing, clips),
            WILD: self._cut(self._wild, clips),
            OTHERS: self._disturbed(others, clips, beside=None),
            ATTEMPTS: self._disturbed([hidden], clips, beside=learner.clip_steps),
        }
        distances = oracle.distance(hidden.qpos[self._shuffled], hidden.qvel[self._shuffled], 0)
        self.truth = {
            "own": 5.0, "shuffled": float(oracle.rating_of(distances).mean()),
            "clips": {name: oracle.rating_of(clips.distances).mean() for name, clips in self._clips.items()},
        }  # fmt: skip

    def figures(self, snapshot: Snapshot) -> dict[str, Any]:
        """Of one predictor.

        Returns:
            ``own``: mean predicted rating of the demo's own states beside their own frames;
            ``shuffled``: beside frames of other moments; ``picked``: true rating of the random states that
            it rates best at moments of the demo; ``ranks``: rank correlation of the predicted rating of clips
            with their true nearness, by policy.
        """
        frames_of, hidden = self._learner.frames_of, self._hidden

        def mean(steps: np.ndarray) -> float:
            return float(
                snapshot.ratings(frames_of(self._steps), hidden.obs[steps], hidden.actions[steps]).mean()
            )

        rng = np.random.default_rng([_STREAM, self._seed, 1])  # the same tries for all predictors
        tries = self._learner.config.practice.bank_tries
        buffer = fill_reset_buffer(
            snapshot, self._wild, frames_of, self._learner.demo_steps, rng, tries=tries, dt=self._learner.dt
        )
        picked = [
            self._oracle.distance(qpos[None], qvel[None], int(step))[0]
            for qpos, qvel, step in zip(buffer.qpos, buffer.qvel, buffer.clock, strict=True)
        ]
        return {
            "own": mean(self._steps),
            "shuffled": mean(self._shuffled),
            "picked": self._oracle.rating_of(np.array(picked)).mean(),
            "ranks": {name: self._rank(snapshot, clips) for name, clips in self._clips.items()},
        }

    def _rank(self, snapshot: Snapshot, clips: _Clips) -> float | None:
        frames = self._learner.frames_of(clips.demo_steps[:, None] + np.arange(self._learner.clip_steps))
        obs, actions = (np.stack([getattr(s, name) for s in clips.segments]) for name in ("obs", "actions"))
        return spearman(snapshot.clip_ratings(frames, obs, actions)[0], -clips.distances)

    def _cut(self, rollouts: Rollouts, count: int) -> _Clips:
        """Clips of rollouts beside any moments of the demo."""
        length = self._learner.clip_steps
        asked = choose(rollouts, count, length, self._learner.demo_steps, self._rng, any_time=True)
        return self._measured(
            np.array([q.demo_step for q in asked]), [rollouts.segment(q.lane, q.start, length) for q in asked]
        )

    def _disturbed(self, moves: Sequence[HiddenStates], count: int, beside: int | None) -> _Clips:
        """Clips of moves that noise in the actions, of a strength of 0 to 1 a clip, has led astray.

        Args:
            moves: What is done.
            count: n.
            beside: Clips lie so many control steps at most from their own moment; None: beside any.
        """
        learner, rng = self._learner, self._rng
        length, last = learner.clip_steps, learner.demo_steps - learner.clip_steps
        which = rng.integers(len(moves), size=count)
        whole = _RUN_IN + length
        begin = np.array([rng.integers(len(moves[i].actions) - whole + 1) for i in which])
        moments = list(zip(which, begin, strict=True))
        qpos, qvel = (np.stack([getattr(moves[i], n)[t] for i, t in moments]) for n in ("qpos", "qvel"))
        strength, noise = rng.uniform(size=(count, 1)), HeldNoise(count, learner.robot.action_size)
        env = vector_env.make(learner.config.env, count, horizon=whole + 1, nthread=1)
        env.reset(seed=self._seed)
        env.set_states(np.arange(count), qpos, qvel, elapsed=np.zeros(count, np.int32))
        rows = []
        for k in range(whole):
            own = np.stack([moves[i].actions[t + k] for i, t in moments])
            action = np.clip(own, -1, 1) + strength * noise.act(noise.mean, rng)
            rows.append((env.obs.copy(), action, env.qpos.copy(), env.qvel.copy()))
            env.step(action)
        env.close()
        obs, actions, qpos, qvel = (np.stack(column, axis=1) for column in zip(*rows, strict=True))
        starts = rng.integers(_RUN_IN + 1, size=count)
        segments = [
            Segment(obs=obs[cut], actions=actions[cut], qpos=qpos[cut], qvel=qvel[cut])
            for lane, start in enumerate(starts)
            for cut in [(lane, slice(start, start + length))]
        ]
        if beside is None:
            return self._measured(rng.integers(last + 1, size=count), segments)
        shifts = rng.integers(-beside, beside + 1, size=count)
        return self._measured(np.clip(begin + starts + shifts, 0, last), segments)

    def _measured(self, demo_steps: np.ndarray, segments: Sequence[Segment]) -> _Clips:
        distances = [
            self._oracle.distance(s.qpos, s.qvel, int(step)).mean()
            for s, step in zip(segments, demo_steps, strict=True)
        ]
        return _Clips(demo_steps=demo_steps, segments=segments, distances=np.array(distances))
