"""The jobs behind Table 3: a predictor of one move, fine-tuned to another with few ratings.

Settings of a job: ``source`` and ``target``, each the settings of ``onedemo.experiments.jobs.method``, and
``demo``, the target's. The source run
is trained first, for its ratings and its predictor alone; the target run starts from its newest snapshot.
The result is that of the target run, with what the source cost.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from onedemo.demos.library import find_demo
from onedemo.experiments.jobs import method
from onedemo.experiments.runner import Job
from onedemo.reward.warm_start import newest_snapshot
from onedemo.storage.store import Store
from onedemo.training.simulated_run import train

_RUN = "source"


def transfer_job(label: str, seed: int, *, source: Job, target: Job) -> Job:
    """A job of kind "transfer".

    Args:
        label: What the table calls it.
        seed: Of everything random, in both runs.
        source: Of kind "method": what the predictor is made for.
        target: Of kind "method": what it is fine-tuned to.
    """
    settings = {"demo": target.settings["demo"], "source": source.settings, "target": target.settings}
    return Job(kind="transfer", label=label, settings=settings, seed=seed)


def run(settings: Mapping[str, Any], seed: int, scratch: Path, cache: Path | None = None) -> dict[str, Any]:
    """Trains the source run, then the target run from its predictor.

    Args:
        settings: See above.
        seed: Of both.
        scratch: Takes both.
        cache: As for ``onedemo.experiments.jobs.method.run``.

    Returns:
        What ``onedemo.experiments.jobs.method.run`` gives of the target run; ``source`` holds the ratings,
        control steps and seconds of the other.
    """
    cache = cache or scratch
    given, before = settings["source"], scratch / "source"
    began = time.monotonic()
    config = method.run_config(given, seed)
    demo = find_demo(given["demo"], cache / "demos")
    encoder = method.prepare(demo, config, cache)
    store = Store(before)
    try:
        made = train(
            store=store, data_dir=before, demo=demo, config=config, encoder=encoder, rater=given["rater"],
            name=_RUN, progress=False, cache_dir=cache,
        )  # fmt: skip
        start = newest_snapshot(store, before, _RUN)
    finally:
        store.close()
    source = {
        "ratings": made["ratings"],
        "ratings_by_class": made["ratings_by_class"],
        "env_steps": made["env_steps"],
        "seconds": round(time.monotonic() - began, 1),
    }
    result = method.run(settings["target"], seed, scratch / "target", cache, start)
    return {**result, "source": source}
