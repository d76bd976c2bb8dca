"""How the policy practises: where episodes start, how the demo's clock moves, when one is given up.

All three follow the current similarity predictor, and each can be switched off (``RolloutConfig``).

- **Elastic clock.** After each control step the demo moves on by 0 to 3 steps, to where it looks most
  like the robot, within a set time of the episode's own. The reward is similarity times steps moved:
  ``r = s(c', x') (c' - c)``, whose sum is the similarity integrated over the demo, however long the robot
  takes. With a fixed clock a robot that is a tenth of a second late is wrong from then on.
- **Bank.** Of a large number of random states the predictor picks those most like each part of the
  demo; a share of the episodes starts there. This is reference-state initialisation (Peng et al. 2018,
  DeepMimic, section 6.2) where no reference states are known.
- **Giving up.** An episode ends once the running mean of the similarity falls below a share of what
  the predictor gives at best.

Shapes: N lanes, C = 4 candidates, K restarting lanes, n states of the bank.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from onedemo.reward.model import CLASSES, Snapshot
from onedemo.reward.settings import PracticeConfig
from onedemo.rl.rollouts import EpisodeRules, Rollouts, Starts, Step

_MOVES = np.arange(4)
_MOVE_COST = 0.02
"""Similarity that a move must gain to be taken over one step: without it the clock would tremble."""
_FRESH = 0.6
"""Running similarity at the start of an episode."""
_MEMORY = 25.0
"""Control steps over which the running similarity is taken."""
_GRACE = 10
"""Control steps before an episode may be given up."""
_BANK_EVERY = 20
"""Control steps of the demo between entries of the bank."""
_BANK_TRIES = 8000
"""Random states compared with each of them."""
_BANK_KEPT = 12
"""Of these, the ones most like it are kept."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Bank:
    """States to start from, each with the demo step it resembles."""

    qpos: np.ndarray
    """(n, q)."""
    qvel: np.ndarray
    """(n, v)."""
    clock: np.ndarray
    """(n,), int32."""
    similarity: float
    """Of its states with the demo, as predicted, their mean, 0..1."""


def fill_bank(
    snapshot: Snapshot,
    states: Rollouts,
    frames_of: Callable[[np.ndarray], np.ndarray],
    demo_steps: int,
    rng: np.random.Generator,
) -> Bank:
    """Picks, for moments all over the demo, the states that the predictor rates best there.

    Args:
        snapshot: Judges.
        states: Random states to pick from, (N, T).
        frames_of: Demo frame at control steps.
        demo_steps: Control steps of the demo.
        rng: Draws the states that are tried.
    """
    flat = {name: getattr(states, name).reshape(-1, getattr(states, name).shape[-1]) for name in _STATE}
    moments = np.arange(0, max(1, demo_steps - 2 * _BANK_EVERY), _BANK_EVERY)
    kept, ratings = [], []
    for moment in moments:
        tried = rng.integers(len(flat["obs"]), size=_BANK_TRIES)
        frame = frames_of(np.full(1, moment))
        liked = snapshot.ratings(frame, flat["obs"][tried], flat["actions"][tried])
        best = np.argsort(-liked, kind="stable")[:_BANK_KEPT]
        kept.append(tried[best])
        ratings.append(liked[best])
    chosen = np.concatenate(kept)
    return Bank(
        qpos=flat["qpos"][chosen],
        qvel=flat["qvel"][chosen],
        clock=np.repeat(moments, _BANK_KEPT).astype(np.int32),
        similarity=float(_similarity(np.concatenate(ratings)).mean()),
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
        self._demo_steps = demo_steps
        self._frames_of = frames_of
        self._snapshot: Snapshot | None = None
        self._bank: Bank | None = None
        self._threshold = config.give_up
        self._running = np.full(lanes, _FRESH)
        self._age = np.zeros(lanes, np.int64)
        self._similar = np.zeros(lanes)
        self._rewards: list[np.ndarray] = []
        self.mean_similarity = 0.0
        """Of the steps whose rewards were taken last, 0..1."""
        self._similarities: list[float] = []

    def use(self, snapshot: Snapshot, bank: Bank | None) -> None:
        """From now on similarity is what this snapshot says, and episodes may start in this bank."""
        self._snapshot, self._bank = snapshot, bank
        self._threshold = self._config.give_up * (bank.similarity if bank is not None else 1.0)

    def take_rewards(self) -> np.ndarray:
        """Rewards of the steps since the last call, (N, T): similarity, 0..1, times steps moved."""
        rewards, self._rewards = np.stack(self._rewards, axis=1), []
        self.mean_similarity, self._similarities = float(np.mean(self._similarities)), []
        return rewards

    def start(self, lanes: np.ndarray, rng: np.random.Generator) -> Starts | None:
        """States of the bank for a share of the lanes; the others stand."""
        self._running[lanes], self._age[lanes] = _FRESH, 0
        if self._bank is None:
            return None
        lanes = lanes[rng.random(len(lanes)) < self._config.bank_share]
        chosen = rng.integers(len(self._bank.clock), size=len(lanes))
        return Starts(
            lanes=lanes,
            qpos=self._bank.qpos[chosen],
            qvel=self._bank.qvel[chosen],
            clock=self._bank.clock[chosen],
        )

    def advance(self, step: Step) -> np.ndarray:
        """Where the demo is after the step; notes the reward."""
        assert self._snapshot is not None, "use(snapshot) comes before practice"
        if not self._config.elastic:
            clock = step.clock + 1
            self._similar = self._similarity(clock, step)
            moved = np.ones(len(clock))
        else:
            moves = _MOVES[:, None]
            candidates = step.clock + moves
            similar = self._similarity(candidates, step)
            too_far = (np.abs(candidates - step.elapsed) > self._slack) & (moves != 1)
            value = np.where(too_far, -np.inf, similar - _MOVE_COST * np.abs(moves - 1))
            moved = value.argmax(axis=0)
            clock = step.clock + moved
            self._similar = np.take_along_axis(similar, moved[None], axis=0)[0]
        self._rewards.append(self._similar * moved)
        self._similarities.append(float(self._similar.mean()))
        return clock

    def stop(self, step: Step, next_clock: np.ndarray) -> np.ndarray:
        """True where the robot has been unlike the demo for a while."""
        self._running += (self._similar - self._running) / _MEMORY
        self._age += 1  # not ``elapsed``, which begins in the middle of the demo with a state of the bank
        return (self._running < self._threshold) & (self._age > _GRACE)

    def state_dict(self) -> dict[str, Any]:
        """What a resumed practice needs besides snapshot and bank."""
        return {"running": torch.from_numpy(self._running.copy()), "age": torch.from_numpy(self._age.copy())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken."""
        self._running, self._age = state["running"].numpy().copy(), state["age"].numpy().copy()

    def _similarity(self, clock: np.ndarray, step: Step) -> np.ndarray:
        """0..1, the shape of ``clock``: states after the step against the demo there."""
        assert self._snapshot is not None
        frames = self._frames_of(np.minimum(clock, self._demo_steps - 1))
        ratings = self._snapshot.ratings(frames, step.next_obs, step.actions)
        return _similarity(ratings)


def _similarity(ratings: np.ndarray) -> np.ndarray:
    """Ratings 1..5 as 0..1."""
    return np.clip((ratings - 1) / (CLASSES - 1), 0, 1)
