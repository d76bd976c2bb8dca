"""Training: iterations of TRPO on the learned reward beside bare physics.

N lanes, T control steps, B = N T samples of an iteration.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from onedemo.config import RunConfig, load_config
from onedemo.core.cpu import cores
from onedemo.experiments.speed.figures import Result, by_turns, ratio, single
from onedemo.experiments.speed.physics import Bare, full_states
from onedemo.reward.model import Snapshot
from onedemo.storage.rating_records import RatedSegment
from onedemo.training.learner import Learner
from onedemo.types import Rollouts

LANES, STEPS = 64, 250
"""Of an iteration: the product's defaults."""
_FRAMES, _FPS = 240, 30.0


def measure(quick: bool = False) -> list[Result]:
    """Training beside bare physics, and the learned reward's share of it."""
    with one_thread():
        return _against_physics(*((2, 100) if quick else (25, STEPS)))


@contextmanager
def one_thread() -> Iterator[None]:
    """Networks on one thread, as the trainer has them; puts back what was set before."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def made_up_ratings(rollouts: Rollouts, count: int, clip_steps: int, seed: int = 0) -> list[RatedSegment]:
    """Clips of rollouts with ratings as skewed as those of a random policy.

    The ratings follow the torso's lean, so that there is something to learn; no demo is involved.

    Args:
        rollouts: Episodes, (N, T).
        count: How many.
        clip_steps: Control steps of a clip.
        seed: Of the choice.
    """
    rng = np.random.default_rng(seed)
    lanes = rng.integers(0, rollouts.clock.shape[0], count)
    starts = rng.integers(0, rollouts.clock.shape[1] - clip_steps, count)
    segments = [
        rollouts.segment(int(lane), int(start), clip_steps) for lane, start in zip(lanes, starts, strict=True)
    ]
    lean = np.array([np.cos(segment.obs[:, 1]).mean() for segment in segments])
    cuts = np.quantile(lean, (0.55, 0.75, 0.87, 0.95))
    values = 1 + (lean[:, None] > cuts).sum(1)
    return [
        RatedSegment(event=i, demo_step=int(start), segment=segment, value=int(value))
        for i, (start, segment, value) in enumerate(zip(starts, segments, values, strict=True))
    ]


def learner_and_snapshot(config: RunConfig, ratings: int = 350) -> tuple[Learner, Snapshot]:
    """A learner on an 8 s demo of made-up features, and a snapshot fitted on made-up ratings."""
    learner = Learner(config, _FRAMES, _FPS)
    learner.look_at(np.random.default_rng(0).standard_normal((_FRAMES, 1280)).astype(np.float32))
    given = made_up_ratings(learner.random_rollouts(), ratings, learner.clip_steps)
    return learner, learner.fit(given, 1)[0]


def _against_physics(turns: int, steps: int) -> list[Result]:
    config = load_config(
        None,
        {
            "method": "paper",
            "predictor.visual_dims": 24,
            "rollouts.lanes": LANES,
            "rollouts.steps": steps,
            "rollouts.threads": cores(),
        },
    )
    learner, snapshot = learner_and_snapshot(config)
    bare = Bare(LANES)
    latest: list[Any] = []
    shares: list[float] = []

    def ours() -> float:
        began = time.perf_counter()
        rollouts, _ = learner.iterate(snapshot)
        whole = time.perf_counter() - began
        latest[:] = [rollouts]
        began = time.perf_counter()
        snapshot.ratings(learner.frames_of(rollouts.clock), rollouts.obs, rollouts.actions)
        shares.append(100 * (time.perf_counter() - began) / whole)
        return rollouts.clock.size / whole

    def theirs() -> float:
        rollouts = latest[0]
        states = full_states(rollouts.qpos[:, 0], rollouts.qvel[:, 0])
        actions = rollouts.actions.swapaxes(0, 1).astype(np.float64)
        return rollouts.clock.size / bare.run(states, actions)

    rates = by_turns({"ours": ours, "bare": theirs}, turns)
    bare.close()
    return [
        ratio(
            "train_vs_physics", f"training: collection, scoring, TRPO update, {LANES} x {steps} steps",
            ours=rates["ours"], theirs=rates["bare"], against=f"mujoco.rollout bare, {cores()} threads",
            reach=0.75, unit="steps/s",
            equal="each turn, bare physics steps the lanes of the iteration before with the same actions",
        ),
        single(
            "reward_share", "learned reward, share of an iteration's time", shares[1:], unit="%", reach=3.0,
            how="the scoring of an iteration's rollouts, timed again by itself",
        ),
    ]  # fmt: skip
