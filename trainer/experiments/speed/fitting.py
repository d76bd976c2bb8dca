"""Refits: how long the similarity predictor takes to learn from all ratings, and how that grows."""

from __future__ import annotations

import time

import numpy as np

from onedemo.config import load_config
from onedemo.experiments.speed.figures import Growth, Result, single
from onedemo.experiments.speed.training import learner_and_snapshot, made_up_ratings, one_thread
from onedemo.storage.rating_records import RatedSegment
from onedemo.training.learner import Learner

_DISTINCT = 350


def measure(quick: bool = False) -> list[Result]:
    """The time of a refit on 350 ratings, and of refits on 100 to 100,000."""
    with one_thread():
        learner, _ = learner_and_snapshot(
            load_config(None, {"method": "paper", "predictor.visual_dims": 24})
        )  # the first fit of a process loads torch's optimisers
        rollouts = learner.random_rollouts()
        distinct = made_up_ratings(rollouts, _DISTINCT, learner.clip_steps)
        turns = 3 if quick else 9
        times = [_seconds(learner, distinct) for _ in range(turns)]
        sizes = (100, 1_000, 5_000) if quick else (100, 1_000, 10_000, 100_000)
        repeats = range(1 if quick else 3)
        growth = [np.median([_seconds(learner, _many(distinct, n)) for _ in repeats]) for n in sizes]
    return [
        single(
            "refit_s", f"refit on {_DISTINCT} ratings", times, unit="s", reach=1.5,
            how="every refit is the full fit, from scratch on all ratings, so its accuracy is the full fit's",
        ),
        Growth(
            name="refit_ratings", title="Refit by ratings", x_label="ratings", y_label="seconds", x=sizes,
            y={"fit from scratch": [float(seconds) for seconds in growth]},
        ),
    ]  # fmt: skip


def _seconds(learner: Learner, ratings: list[RatedSegment]) -> float:
    began = time.perf_counter()
    learner.fit(ratings, 1)
    return time.perf_counter() - began


def _many(distinct: list[RatedSegment], count: int) -> list[RatedSegment]:
    """As many ratings as asked for, of the same segments: a fit's cost does not depend on what is in them."""
    return (distinct * (-(-count // len(distinct))))[:count]
