"""One trial of Table 1: 400 ratings of the oracle, and what each kind of predictor makes of half of them.

The oracle, and the demo's hidden states with it, is asked for ratings as any rater is, and again to judge
the finished predictors; no predictor gets to see it.

Shapes: n clips, W control steps a clip, T control steps of the demo.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from onedemo.annotators.oracle import Oracle
from onedemo.config import load_config
from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.demos.library import find_demo
from onedemo.experiments.jobs.method import prepare
from onedemo.experiments.jobs.predictor_exam import Exam
from onedemo.experiments.predictor_scores import calibration_error, confusion, f1, macro_f1, reliability
from onedemo.reward.model import CLASSES, Snapshot
from onedemo.storage.rating_records import RatedSegment
from onedemo.training.learner import Learner
from onedemo.types import Demo
from onedemo.vision.encoders import demo_features
from onedemo.vision.pose_estimator import Track
from onedemo.vision.silhouette import seen_in

_NETWORK = {"method": "paper"}
_ONE_LAYER_LESS = _NETWORK | {"predictor.additional_layer": False}
VARIANTS: dict[str, dict[str, Any]] = {
    "random sampling": _ONE_LAYER_LESS | {"predictor.sampling": "random"},
    "sampling equally": _ONE_LAYER_LESS,
    "class weights": _ONE_LAYER_LESS | {"predictor.sampling": "random", "predictor.class_weights": True},
    "equal + weights": _ONE_LAYER_LESS | {"predictor.class_weights": True},
    "additional layer": _NETWORK,
    "principal components": _NETWORK | {"predictor.visual_dims": 24},
    "ordinal loss": _NETWORK | {"predictor.ordinal": True},
    "ordinal, 3 networks": _NETWORK | {"predictor.ordinal": True, "predictor.members": 3},
    "metric": {"method": "onedemo"},
    "additional layer, marks": _NETWORK,
    "metric, marks": {"method": "onedemo"},
}
"""Settings of each predictor: the paper's five, then its network with one more change, then onedemo's; and
two of them with marks where clips go wrong, from the same number of ratings."""
MARKED = ("additional layer, marks", "metric, marks")

OTHER_MOVES = ("hopper-backflip", "hopper-flip-clean", "hopper-hop")
"""Demos whose disturbed moves stand for what other policies do; the one that is rated is left out."""
_ELSEWHERE = 50_000
"""Added to the seed of what predictors are judged on, so that none of it has been rated."""


def run(settings: dict[str, Any], seed: int, scratch: Path, cache: Path | None = None) -> dict[str, Any]:
    """Collects ratings, splits them, fits all predictors on one part, judges them on the others.

    Args:
        settings: ``demo``; ``data``: "paper" (a random policy from standing, time-aligned) or "onedemo"
            (what it would ask for); ``split``: ratings to fit, to validate and to test; ``rounds`` in
            which onedemo asks; ``clips`` of each other policy; ``config``: dotted settings of all predictors.
        seed: Of everything random.
        scratch: For what is kept of demo and robot, where there is no cache.
        cache: Keeps it for other jobs.

    Returns:
        ``classes``: how many ratings of each class there are to fit, to validate and to test; ``truth``: the
        true rating of what the predictors are asked besides; ``marked``: how many of the fitted ratings
        have a mark where they are used; ``variants``: the figures of each, by name.
    """
    torch.set_num_threads(1)
    demo = find_demo(settings["demo"], scratch)
    scene = _look(demo, cache or scratch)
    moves = {
        name: load_hidden(hidden_path(find_demo(name, scratch).path)) for name in {*OTHER_MOVES, demo.name}
    }
    hidden = moves.pop(demo.name)
    common = settings["config"]

    def learner(variant: Mapping[str, Any], seed: int) -> Learner:
        config = load_config(None, {**common, **variant, "seed": seed})
        made = Learner(config, demo.frames, demo.fps)
        made.look_at(scene.features, scene.track if config.predictor.appearance else None)
        return made

    split = settings["split"]
    rater = Oracle(hidden, budget=sum(split))
    if settings["data"] == "onedemo":
        rated = ask(learner({"method": "onedemo"}, seed), rater, sum(split), settings["rounds"])
    else:  # a run's random rollouts hold 200 clips that do not overlap, not 400: those of two runs
        halves = [sum(split) // 2, sum(split) - sum(split) // 2]
        rated = [
            r for i, n in enumerate(halves) for r in ask(learner(_NETWORK, 2 * seed + i), rater, n, rounds=1)
        ]
    order = np.random.default_rng([seed, _ELSEWHERE]).permutation(len(rated))
    fitted, validation, tested = ([rated[i] for i in part] for part in np.split(order, np.cumsum(split)[:-1]))
    exam = Exam(
        Oracle(hidden, budget=0), hidden, [moves[name] for name in sorted(moves)],
        learner({"method": "onedemo"}, _ELSEWHERE + seed),
        learner(_NETWORK, _ELSEWHERE + seed).random_rollouts(), clips=settings["clips"], seed=seed,
    )  # fmt: skip
    variants = {}
    for name, variant in VARIANTS.items():
        student = learner(variant, seed)
        given = [replace(r, mark=rater.mark(r.segment, r.demo_step)) if name in MARKED else r for r in fitted]
        began = time.process_time()
        snapshot, _ = student.fit(given, 1)
        fit_s = time.process_time() - began
        variants[name] = {
            **unseen(student, snapshot, validation, tested), **exam.figures(snapshot), "fit_s": fit_s,
        }  # fmt: skip
    classes = {
        "fitted": by_class(fitted), "validation": by_class(validation), "test": by_class(tested)
    }  # fmt: skip
    marked = sum(rater.mark(r.segment, r.demo_step) is not None for r in fitted)
    return {"classes": classes, "truth": exam.truth, "marked": marked, "variants": variants}


def ask(learner: Learner, rater: Oracle, count: int, rounds: int) -> list[RatedSegment]:
    """Ratings before practice as the trainer's loop asks for them: rounds, with a refit after each.

    Args:
        learner: Chooses by its run's settings.
        rater: Answers.
        count: Ratings.
        rounds: In so many.
    """
    rollouts, snapshot = learner.random_rollouts(), None
    rated: list[RatedSegment] = []
    for number in range(1, rounds + 1):
        due = round(count * number / rounds) - len(rated)
        rng = np.random.default_rng([learner.config.seed, 0, len(rated)])
        for q in learner.choose(rollouts, snapshot, due, rng):
            segment = rollouts.segment(q.lane, q.start, learner.clip_steps)
            value = rater.rate(segment, q.demo_step)
            assert value is not None, "an oracle without errors declines nothing"
            rated.append(
                RatedSegment(event=len(rated) + 1, demo_step=q.demo_step, segment=segment, value=value)
            )
        if number < rounds:
            snapshot, _ = learner.fit(rated, number)
    return rated


def by_class(rated: Sequence[RatedSegment]) -> list[int]:
    """How many ratings of 1, 2, ... 5."""
    return np.bincount([r.value - 1 for r in rated], minlength=CLASSES).tolist()


def unseen(
    learner: Learner, snapshot: Snapshot, validation: Sequence[RatedSegment], tested: Sequence[RatedSegment]
) -> dict[str, Any]:
    """Figures on rated clips that were not fitted: accuracy of both parts, the rest of both together."""
    clips = [*validation, *tested]
    given = np.array([r.value for r in clips])
    chances = snapshot.probabilities(
        learner.frames_of(np.array([r.demo_step for r in clips])[:, None] + np.arange(learner.clip_steps)),
        np.stack([r.segment.obs for r in clips]),
        np.stack([r.segment.actions for r in clips]),
    ).mean(axis=1)
    predicted = chances.argmax(axis=-1) + 1
    hit, away = predicted == given, np.abs(predicted - given)
    bins = reliability(chances[:, 2:].sum(axis=-1), given >= 3)
    return {
        "validation": hit[: len(validation)].mean(),
        "test": hit[len(validation) :].mean(),
        "f1_3": f1(given, predicted, 3),
        "f1_4": f1(given, predicted, 4),
        "macro_3": macro_f1(given, predicted, 3),
        "macro_4": macro_f1(given, predicted, 4),
        "error_3": (away == 3).mean(),
        "error_4": (away == 4).mean(),
        "confusion": confusion(given, predicted),
        "reliability": bins,
        "calibration": calibration_error(bins),
    }


@dataclass(frozen=True, kw_only=True, slots=True)
class _Scene:
    features: np.ndarray
    track: Track


def _look(demo: Demo, kept: Path) -> _Scene:
    """What onedemo sees of a demo: frame features, and poses in them."""
    encoder = prepare(demo, load_config(), kept)  # one job at a time
    features = demo_features(demo, encoder, kept / "demos")
    track = seen_in(demo, load_config().env, kept / "robots")
    assert track is not None, "the demo shows the robot"
    return _Scene(features=features, track=track)
