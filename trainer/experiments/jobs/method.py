"""The job behind most tables: one training from ratings, and what came of it.

Settings of a job: ``demo``, ``method``, ``rater``, ``ratings`` (in all), ``steps`` (of practice) and
``set``, more settings by their dotted names; ``config`` is a digest of all that follows from them. The
result, which the controls have in the same form:

- ``figures``: of the final policy, name to {mean, best, worst, each}, each of 16 episodes;
- ``curve``: name to means over 16 episodes, at about 12 points of ``env_steps``;
- ``errors``: squared error of the states over time, of the best episode and the mean;
- ``episode``: positions of the best episode at the demo's frames, and which one it is;
- ``ratings``, ``ratings_by_class``, ``env_steps`` and ``seconds`` by what they were spent on.

Shapes: N = 16 episodes, T control steps, q positions.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from onedemo.annotators.oracle import Oracle
from onedemo.config import RunConfig, load_config, split_ratings, to_toml
from onedemo.core.files import hold
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.ground_truth import HiddenStates, hidden_path, load_hidden
from onedemo.demos.library import find_demo
from onedemo.evaluation.episodes import per_episode, perform, predicted_similarity, spread, state_errors
from onedemo.experiments.runner import Job
from onedemo.reward.model import Snapshot
from onedemo.rl.rollouts import Episodes
from onedemo.robots.registry import robot_named
from onedemo.storage.store import Store
from onedemo.training.learner import Learner
from onedemo.training.simulated_run import train
from onedemo.types import Demo
from onedemo.vision.encoders import demo_features, make_encoder
from onedemo.vision.silhouette import seen_in

POINTS = 12
"""Of a learning curve."""
CURVES = (
    "net_turns", "clean_turns", "landings", "backflip_reward", "hop_return", "aligned_similarity", "travel",
)  # fmt: skip
"""Figures that are followed during a training, where the robot has them."""

_ERROR_EVERY = 10
"""Control steps over which the error of the states is averaged."""


def method_job(
    label: str, seed: int, *, demo: str = "hopper-backflip", method: str = "onedemo", rater: str = "oracle",
    ratings: int = 350, steps: int, changes: Mapping[str, Any] | None = None,
) -> Job:  # fmt: skip
    """A job of kind "method"; the same arguments give the same job in every table.

    Args:
        label: What the table calls it.
        seed: Of everything random.
        demo: A demo's name.
        method: "onedemo" or "paper".
        rater: Name of a simulated rater.
        ratings: Its budget.
        steps: Control steps of practice.
        changes: More settings, by their dotted names.
    """
    settings = {
        "demo": demo, "method": method, "rater": rater, "ratings": ratings, "steps": steps,
        "set": dict(changes or {}),
    }  # fmt: skip
    return Job(kind="method", label=label, settings=settings | whole_config(settings), seed=seed)


_ONCE_CONSTANT = {"practice": {"random_lanes": 64, "bank_tries": 8000}}
"""Settings that are newer than reported runs, with the values of before: at these, the job is the same."""


def whole_config(settings: Mapping[str, Any]) -> dict[str, str]:
    """``{"config": digest}`` of all settings of a run, defaults too: a changed default makes another job."""
    config = asdict(run_config({"ratings": 350, "set": {}, **settings}, 0))
    del config["storage"]  # what a run leaves on the disk changes no result
    if not config["env_sha256"]:  # the model is the one that comes with the program
        del config["env_sha256"]
    for section, constants in _ONCE_CONSTANT.items():
        for name, value in constants.items():
            if config[section][name] == value:
                del config[section][name]
    return {"config": hashlib.sha256(to_toml(config).encode()).hexdigest()[:10]}


def run(
    settings: Mapping[str, Any], seed: int, scratch: Path, cache: Path | None = None,
    start: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Trains with a simulated rater and evaluates on the way and at the end.

    Args:
        settings: See above.
        seed: Of everything random.
        scratch: Takes the ratings and the run.
        cache: Holds what is known of demos and robots, for all jobs; the scratch directory if None.
        start: Snapshot of another run that the predictor starts from.

    Returns:
        The result, see above. ``demo_rated`` is what the final predictor says of the demo's own states
        beside its own frames, ``demo_shuffled`` of the same states in random order.
    """
    began = time.monotonic()
    cache = cache or scratch
    config = run_config(settings, seed)
    demo = find_demo(settings["demo"], cache / "demos")
    encoder = prepare(demo, config, cache)
    hidden = hidden_of(demo)
    watch = Watch(hidden, config.rollouts.total_steps, config.env)
    prepared = time.monotonic()
    store = Store(scratch)
    try:
        summary = train(
            store=store, data_dir=scratch, demo=demo, config=config, encoder=encoder,
            rater=settings["rater"], name="bench", progress=False, cache_dir=cache, watch=watch,
            start=start,
        )  # fmt: skip
    finally:
        store.close()
    learner, snapshot = watch.learner, watch.snapshot
    return {
        **watch.result(demo),
        **_own_states(learner, snapshot, hidden),
        "ratings": summary["ratings"],
        "ratings_by_class": summary["ratings_by_class"],
        "env_steps": learner.env_steps,
        "seconds": {
            "preparation": round(prepared - began, 1),
            "training": round(watch.ended - prepared - watch.seconds, 1),
            "evaluation": round(watch.seconds, 1),
        },
    }


def run_config(settings: Mapping[str, Any], seed: int) -> RunConfig:
    """The settings of the run behind a job: on one core, ratings split as the paper splits its 350."""
    pretrain, online = split_ratings(settings["ratings"])
    given = {
        "method": settings["method"],
        "seed": seed,
        "ratings.pretrain": pretrain,
        "ratings.online": online,
        "rollouts.total_steps": settings["steps"],
        "rollouts.threads": 1,
    }
    return load_config(None, given | settings["set"])


def prepare(demo: Demo, config: RunConfig, cache: Path) -> Any:
    """Looks at the demo and learns what the robot looks like, unless it is known; the encoder.

    One job at a time: the others wait, and find it done.
    """
    encoder = make_encoder(config.encoder)
    with hold(cache / "demos" / "lock", wait=True):
        demo_features(demo, encoder, cache / "demos")
    if config.predictor.appearance:
        with hold(cache / "robots" / "lock", wait=True):
            seen_in(demo, config.env, cache / "robots")
    return encoder


def hidden_of(demo: Demo) -> HiddenStates | None:
    """The demo's hidden states, for evaluation and ceilings; None if it has none."""
    file = hidden_path(demo.path)
    return load_hidden(file) if file.exists() else None


class Watch:
    """Follows a training: called after each iteration, it evaluates at some of them and at the last.

    Args:
        hidden: The demo's states; None leaves out what compares with them.
        total_steps: Control steps at which the training ends.
        robot: Name of the robot.
    """

    learner: Learner
    """As of the last call."""
    snapshot: Snapshot

    def __init__(self, hidden: HiddenStates | None, total_steps: int, robot: str = "hopper") -> None:
        self._oracle, self._robot = oracle_of(hidden, robot), robot
        self._total_steps = total_steps
        self._curve: dict[str, list[float | None]] = {name: [] for name in ("env_steps", *CURVES)}
        self._last: tuple[Episodes, dict[str, np.ndarray | None]] | None = None
        self.seconds = 0.0
        """Spent on evaluation."""
        self.ended = 0.0
        """When the last call returned."""

    def __call__(self, learner: Learner, snapshot: Snapshot) -> None:
        """After an iteration."""
        began = time.monotonic()
        self.learner, self.snapshot = learner, snapshot
        due = (len(self._curve["env_steps"]) + 1) * self._total_steps / POINTS
        if learner.env_steps >= min(due, self._total_steps):
            episodes = perform(learner, snapshot)
            values = per_episode(episodes, self._oracle, self._robot)
            values["predicted_similarity"] = predicted_similarity(episodes)
            self._last = episodes, values
            self._curve["env_steps"].append(learner.env_steps)
            for name in CURVES:
                each = values.get(name)
                self._curve[name].append(None if each is None else round(float(np.mean(each)), 4))
        self.ended = time.monotonic()
        self.seconds += self.ended - began

    def result(self, demo: Demo) -> dict[str, Any]:
        """``curve``, and what ``outcome`` gives for the last evaluation."""
        assert self._last is not None, "the training has not come to its end"
        return {"curve": self._curve, **outcome(*self._last, demo, self._oracle, self._robot)}


def oracle_of(hidden: HiddenStates | None, robot: str = "hopper") -> Oracle | None:
    """An oracle that gives no ratings and only evaluates."""
    return None if hidden is None else Oracle(hidden, robot, budget=0)


def outcome(
    episodes: Episodes, values: Mapping[str, np.ndarray | None], demo: Demo, oracle: Oracle | None,
    robot: str = "hopper",
) -> dict[str, Any]:  # fmt: skip
    """What there is to keep of the final policy's episodes: ``figures``, ``errors``, ``episode``.

    The best episode is the one most like the demo after alignment; where that is not known, the one with
    the most turns, or which went farthest.
    """
    by = ("aligned_similarity", "net_turns", "travel")
    known = [each for name in by if (each := values.get(name)) is not None]
    best = int(np.argmax(known[0]))
    steps = steps_of_frames(demo.frames, robot_named(robot).dt, demo.fps)
    steps = np.minimum(steps, episodes.qpos.shape[1] - 1)
    return {
        "figures": {name: _figure(name, each) for name, each in values.items()},
        "errors": _errors(episodes, oracle, best),
        "episode": {"which": best, "qpos": np.round(episodes.qpos[best, steps], 4)},
    }


def _figure(name: str, values: np.ndarray | None) -> dict[str, Any] | None:
    figure = spread(name, values)
    if figure is None or values is None:
        return None
    return {**figure, "each": np.round(values.astype(float), 4)}


def _errors(episodes: Episodes, oracle: Oracle | None, best: int) -> dict[str, Sequence[float]] | None:
    if oracle is None:
        return None
    errors = state_errors(episodes.obs, oracle.hidden.obs, oracle.body.robot.name)
    points = errors.shape[1] // _ERROR_EVERY
    errors = errors[:, : points * _ERROR_EVERY].reshape(len(errors), points, _ERROR_EVERY).mean(axis=-1)
    seconds = (np.arange(points) + 0.5) * _ERROR_EVERY * oracle.body.robot.dt
    figures = {"seconds": seconds, "best": errors[best], "mean": errors.mean(axis=0)}
    return {name: [round(float(x), 4) for x in values] for name, values in figures.items()}


def _own_states(learner: Learner, snapshot: Snapshot, hidden: HiddenStates | None) -> dict[str, Any]:
    if hidden is None:
        return {"demo_rated": None, "demo_shuffled": None}
    steps = np.arange(min(learner.demo_steps, len(hidden.actions)))
    frames = learner.frames_of(steps)
    shuffled = np.random.default_rng(0).permutation(steps)
    rated, other = (
        float(snapshot.ratings(frames, hidden.obs[order], hidden.actions[order]).mean())
        for order in (steps, shuffled)
    )
    return {"demo_rated": round(rated, 4), "demo_shuffled": round(other, 4)}
