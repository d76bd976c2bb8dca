"""The episode rules of the method: where episodes start, how the demo phase moves, rewards, early ends.

All of them follow the current reward model. The reward of a step is the predicted similarity, 0..1, of the
state *after* it to the demo there, times the demo steps that the phase moved on: ``r = s(c', x') (c' - c)``.
Its sum is the similarity integrated over the demo, however long the robot takes. The state after the step is
scored because that is what the action brought about. Each of the following can be switched off
(``RunConfig.practice``); without them all, the rules are the paper's.

- **Adaptive phase.** After each control step the demo moves on by 0 to 3 steps, to where it looks most
  like the robot, within a set time of the episode's own. With a fixed phase a robot that is a tenth of a
  second late is wrong from then on.
- **Reset buffer.** Of a large number of random states the reward model picks those most like each part of
  the demo; a share of the episodes starts there. This is reference-state initialisation (Peng et al. 2018,
  DeepMimic, section 6.2) where no reference states are known.
- **Early termination.** An episode ends once the running mean of the similarity falls below a share of what
  the reward model gives at best.

Shapes: N lanes, T control steps, C = 4 candidates, K restarting lanes, n states of the reset buffer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from onedemo.reward.model import CLASSES, Snapshot
from onedemo.reward.settings import PracticeConfig
from onedemo.rl.rollouts import EpisodeRules, Starts, Step, Transitions
from onedemo.types import Rollouts

_MOVES = np.arange(4)
_MOVE_COST = 0.02
"""Similarity that a move must gain to be taken over one step: without it the clock would tremble."""
_FRESH = 0.6
"""Running similarity at the start of an episode."""
_MEMORY_SECONDS = 0.2
"""Over which the running similarity is taken."""
_GRACE_SECONDS = 0.08
"""Before an episode may end early."""
_BUFFER_SECONDS = 0.16
"""Of the demo between entries of the reset buffer."""
_BUFFER_KEPT = 12
"""For each of them so many states are kept, the ones most like it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ResetBuffer:
    """States to start from, each with the demo step it resembles."""

    qpos: np.ndarray
    """(n, q)."""
    qvel: np.ndarray
    """(n, v)."""
    clock: np.ndarray
    """(n,), int32."""
    similarity: float
    """Of its states with the demo, as predicted, their mean, 0..1."""


def fill_reset_buffer(
    snapshot: Snapshot,
    states: Rollouts,
    frames_of: Callable[[np.ndarray], np.ndarray],
    demo_steps: int,
    rng: np.random.Generator,
    *,
    tries: int,
    dt: float,
) -> ResetBuffer:
    """Picks, for moments all over the demo, the states that the predictor rates best there.

    Args:
        snapshot: Judges.
        states: Random states to pick from, (N, T).
        frames_of: Demo frame at control steps.
        demo_steps: Control steps of the demo.
        rng: Draws the states that are tried.
        tries: How many at each moment.
        dt: Seconds of a control step.
    """
    flat = {name: getattr(states, name).reshape(-1, getattr(states, name).shape[-1]) for name in _STATE}
    every = steps_in(_BUFFER_SECONDS, dt)
    moments = np.arange(0, max(1, demo_steps - 2 * every), every)
    kept, ratings = [], []
    for moment in moments:
        tried = rng.integers(len(flat["obs"]), size=tries)
        frame = frames_of(np.full(1, moment))
        liked = snapshot.ratings(frame, flat["obs"][tried], flat["actions"][tried])
        best = np.argsort(-liked, kind="stable")[:_BUFFER_KEPT]
        kept.append(tried[best])
        ratings.append(liked[best])
    chosen = np.concatenate(kept)
    return ResetBuffer(
        qpos=flat["qpos"][chosen],
        qvel=flat["qvel"][chosen],
        clock=np.repeat(moments, _BUFFER_KEPT).astype(np.int32),
        similarity=float(similarity(np.concatenate(ratings)).mean()),
    )


_STATE = ("obs", "actions", "qpos", "qvel")


class PracticeRules(EpisodeRules):
    """The rules of one run, under its newest snapshot.

    Args:
        config: Which of them hold.
        lanes: N.
        dt: Seconds of a control step.
        demo_steps: Control steps of the demo.
        frames_of: Demo frame at control steps.
    """

    def __init__(
        self,
        config: PracticeConfig,
        *,
        lanes: int,
        dt: float,
        demo_steps: int,
        frames_of: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self._config = config
        self._slack = round(config.slack_seconds / dt)
        self._memory, self._grace = steps_in(_MEMORY_SECONDS, dt), steps_in(_GRACE_SECONDS, dt)
        self._demo_steps = demo_steps
        self._frames_of = frames_of
        self._snapshot: Snapshot | None = None
        self._buffer: ResetBuffer | None = None
        self._threshold = config.give_up
        # Else a batch is scored at once, when it is whole: that costs a tenth.
        self._step_by_step = config.elastic or config.give_up > 0
        self._running = np.full(lanes, _FRESH)
        self._age = np.zeros(lanes, np.int64)
        self._similar: list[np.ndarray] = []  # (N,) of each step of the batch so far

    def use(self, snapshot: Snapshot, buffer: ResetBuffer | None) -> None:
        """From now on similarity is what this snapshot says, and episodes may start in this reset buffer."""
        self._snapshot, self._buffer = snapshot, buffer
        self._threshold = self._config.give_up * (buffer.similarity if buffer is not None else 1.0)

    def start(self, lanes: np.ndarray, rng: np.random.Generator) -> Starts | None:
        """States of the reset buffer for a share of the lanes; the others stand."""
        self._running[lanes], self._age[lanes] = _FRESH, 0
        if self._buffer is None:
            return None
        lanes = lanes[rng.random(len(lanes)) < self._config.bank_share]
        chosen = rng.integers(len(self._buffer.clock), size=len(lanes))
        return Starts(
            lanes=lanes,
            qpos=self._buffer.qpos[chosen],
            qvel=self._buffer.qvel[chosen],
            clock=self._buffer.clock[chosen],
        )

    def advance(self, step: Step) -> np.ndarray:
        """Where the demo is after the step."""
        if not self._step_by_step:
            return step.clock + 1
        if not self._config.elastic:
            self._similar.append(self._similarity(step.clock + 1, step.next_obs, step.actions))
            return step.clock + 1
        moves = _MOVES[:, None]
        candidates = step.clock + moves
        similar = self._similarity(candidates, step.next_obs, step.actions)
        too_far = (np.abs(candidates - step.elapsed) > self._slack) & (moves != 1)
        value = np.where(too_far, -np.inf, similar - _MOVE_COST * np.abs(moves - 1))
        moved = value.argmax(axis=0)
        self._similar.append(np.take_along_axis(similar, moved[None], axis=0)[0])
        return step.clock + moved

    def stop(self, step: Step, next_clock: np.ndarray) -> np.ndarray:
        """True where the robot has been unlike the demo for a while."""
        if not self._config.give_up:
            return super().stop(step, next_clock)
        self._running += (self._similar[-1] - self._running) / self._memory
        self._age += 1  # not ``elapsed``, which begins in the middle of the demo with a state of the buffer
        return (self._running < self._threshold) & (self._age > self._grace)

    def score(self, batch: Transitions) -> np.ndarray:
        """Rewards of the steps since the last call: similarity, 0..1, times demo steps moved, (N, T)."""
        if self._step_by_step:
            similar, self._similar = np.stack(self._similar, axis=1), []
        else:
            similar = self._similarity(batch.next_clock, batch.next_obs, batch.actions)
        return similar * (batch.next_clock - batch.clock)

    def state_dict(self) -> dict[str, Any]:
        """What a resumed training needs besides snapshot and reset buffer; nothing without early ends."""
        if not self._config.give_up:
            return {}
        return {"running": torch.from_numpy(self._running.copy()), "age": torch.from_numpy(self._age.copy())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken."""
        if state:
            self._running, self._age = state["running"].numpy().copy(), state["age"].numpy().copy()

    def _similarity(self, clock: np.ndarray, next_obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """0..1, the shape of ``clock``: states after the step against the demo there."""
        assert self._snapshot is not None, "use(snapshot) comes before the first step"
        frames = self._frames_of(np.minimum(clock, self._demo_steps - 1))
        return similarity(self._snapshot.ratings(frames, next_obs, actions))


def steps_in(seconds: float, dt: float) -> int:
    """Control steps of ``dt`` seconds in some time, one at least."""
    return max(1, round(seconds / dt))


def similarity(ratings: np.ndarray) -> np.ndarray:
    """Ratings 1..5 as 0..1."""
    return np.clip((ratings - 1) / (CLASSES - 1), 0, 1)


def mean_rating(rewards: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """The predicted rating, 1..5, behind rewards of ``PracticeRules``: the mean over the demo steps passed.

    Args:
        rewards: Of each step, (..., T).
        moved: Demo steps passed in each, (..., T).

    Returns:
        (...); 1 where the demo did not move at all.
    """
    return 1 + (CLASSES - 1) * rewards.sum(axis=-1) / np.maximum(moved.sum(axis=-1), 1)
