"""A run without a browser, rated by a simulated rater, and its summary."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from onedemo.annotators.oracle import Oracle, make_rater, marker
from onedemo.config import RunConfig
from onedemo.core.files import hold
from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.evaluation.episodes import summarise
from onedemo.reward.model import Snapshot
from onedemo.robots.registry import robot_named
from onedemo.storage.store import Store
from onedemo.training.learner import Learner
from onedemo.training.rating_queue import Simulated
from onedemo.training.runs import add_run, check_robot, find_run, program_version
from onedemo.training.training_run import TrainingRun
from onedemo.types import Demo
from onedemo.vision.encoders import Encoder


def train(
    *,
    store: Store,
    data_dir: Path,
    demo: Demo,
    config: RunConfig,
    encoder: Encoder,
    rater: str = "oracle",
    name: str | None = None,
    progress: bool = True,
    cache_dir: Path | None = None,
    watch: Callable[[Learner, Snapshot], None] | None = None,
    start: Path | None = None,
) -> dict[str, Any]:
    """Trains with a simulated rater from the first rating to the last step.

    Args:
        store: Takes the ratings.
        data_dir: Of the run.
        demo: What is to be learned; the oracle needs its hidden states.
        config: ``ratings.pretrain + ratings.online`` is the rater's budget.
        encoder: Looks at the demo's frames.
        rater: Name of the simulated rater, see ``onedemo.annotators.oracle.make_rater``.
        name: Of the run; an unfinished run of that name goes on.
        progress: Show a progress bar on standard error.
        cache_dir: Holds what is known of demos and robots; the data directory if None.
        watch: Called with learner and snapshot after each iteration, for a learning curve.
        start: Snapshot of another run that the predictor starts from, see ``onedemo.reward.warm_start``.

    Returns:
        The summary, ready for JSON: ratings, figures over 16 episodes of the final policy, costs.

    Raises:
        UserError: If the rater or the demo is not fit for it.
    """
    began = time.monotonic()
    check_robot(demo, robot_named(config.env).name)
    hidden_file = hidden_path(demo.path)
    hidden = load_hidden(hidden_file) if hidden_file.exists() else None
    given = sum(store.ratings.by_class(name)) if name else 0
    budget = config.ratings.pretrain + config.ratings.online
    simulated = make_rater(
        rater, hidden, demo=demo, budget=budget, given=given, seed=config.seed, robot=config.env
    )
    found = find_run(store, data_dir, demo, name=name, wanted=config) if name else None
    run = found[0] if found else add_run(store, data_dir, demo, config, name=name)
    training = TrainingRun(
        store=store, data_dir=data_dir, run=run, demo=demo, config=config, encoder=encoder,
        simulated=Simulated(name=rater, rate=simulated.rate, mark=marker(simulated)),
        cache_dir=cache_dir, watch=watch, start=start,
    )  # fmt: skip
    threads = torch.get_num_threads()
    try:
        with hold(training.files.lock):
            _work(training, progress)
    finally:
        simulated.close()
        torch.set_num_threads(threads)
    practised = time.monotonic() - began
    learner, snapshot = training.learner, training.snapshot
    assert learner is not None
    oracle = Oracle(hidden, config.env, budget=0) if hidden is not None else None
    by_class = store.ratings.by_class(run)
    return {
        "run": run,
        "demo": demo.name,
        "ratings": sum(by_class),
        "ratings_by_class": by_class,
        **summarise(learner, snapshot, oracle),
        "env_steps": learner.env_steps,
        "steps_per_s": round(learner.env_steps / practised, 1),
        "wall_s": round(time.monotonic() - began, 2),
        **({"unstable_episodes": training.unstable} if training.unstable else {}),
        "seed": config.seed,
        "deterministic": not (why := chance(config, rater)),
        "not_deterministic_because": why,
        "version": program_version(),
    }


def chance(config: RunConfig, rater: str) -> str:
    """Why the same settings and seed may give another result on the same machine; "" if they may not."""
    if config.device != "cpu":
        return f"sums on {config.device} have no fixed order"
    if config.rollouts.physics != "mujoco":
        return "contacts on a GPU have no fixed order"
    if ":" in rater and not rater.startswith(("oracle", "script")):
        return f"nobody knows what the rater {rater} does"
    return ""


def _work(training: TrainingRun, progress: bool) -> None:
    """The whole run, with a bar that shows how far it is."""
    total = training.config.rollouts.total_steps
    with tqdm(total=total, unit="step", unit_scale=True, disable=not progress) as bar:
        bar.set_postfix_str("starting")
        training.prepare()
        while (phase := training.step()) != "done":
            snapshot = training.snapshot.number if training.snapshot is not None else 0
            bar.set_postfix_str(f"{phase}, {training.queue.given()} ratings, snapshot {snapshot}")
            bar.update(min(training.env_steps, total) - bar.n)
