"""Experiments and a table that take no time, for the tests of what runs and reports them."""

import os
import sys
import time
from pathlib import Path

import numpy as np

from onedemo.experiments.report.blocks import Text
from onedemo.experiments.runner import Job
from onedemo.experiments.tables import parts


def plan(seeds, *, quick):
    """The table: a method and its better half, each seed."""
    jobs = [("whole", {"slope": 2.0}), ("half", {"slope": 1.0})]
    return [
        Job(
            kind="helpers.tiny_jobs:climb",
            label=label,
            settings=settings | {"steps": 10 if quick else 20},
            seed=seed,
        )
        for label, settings in jobs
        for seed in seeds
    ]


def height(result):
    """How high it got."""
    return result["height"]


TABLE = parts.Experiment(
    title="onedemo: a tiny table",
    seeds=3,
    plan=plan,
    parts=[
        Text("How high."),
        parts.Figures({"height, m": height, "each seed": (height, parts.each)}, head="method"),
        parts.Curves("height", "heights", "Heights", "height, m"),
    ],
)


def climb(settings, seed, scratch):
    """Climbs, and leaves something behind in its scratch directory."""
    (scratch / "left").write_text("behind")
    if settings.get("log"):
        with open(settings["log"], "a") as file:
            file.write(f"{seed}\n")
    steps = np.arange(settings["steps"])
    heights = settings["slope"] * steps + seed
    curve = {"env_steps": steps, "height": heights, "nothing": np.full(3, np.nan)}
    return {"height": heights[-1], "curve": curve, "threads": os.environ["OMP_NUM_THREADS"]}


def falls(settings, seed, scratch):
    """Fails for odd seeds."""
    print("about to fall", file=sys.stderr)
    if seed % 2:
        raise RuntimeError(f"fell at step {seed}")
    return {"height": 0}


def dies(settings, seed, scratch):
    """Ends its process without a word."""
    os.kill(os.getpid(), 9)


def waits(settings, seed, scratch):
    """Says who it is, with a child of its own, and waits to be ended."""
    import subprocess

    child = subprocess.Popen(["sleep", "300"])
    file = Path(settings["at"]) / f"{seed}.pids"
    file.with_suffix(".part").write_text(f"{os.getpid()} {child.pid} {scratch}")
    file.with_suffix(".part").rename(file)
    time.sleep(300)


def naps(settings, seed, scratch):
    """Notes its beginning and end."""
    for word in ("begin", "end"):
        with open(settings["log"], "a") as file:
            file.write(f"{word}\n")
        time.sleep(0.5)
    return {}


def remembers(settings, seed, scratch, cache):
    """Counts the jobs that came before it to what all jobs share."""
    cache.mkdir(exist_ok=True)
    (cache / str(seed)).touch()
    return {"there": sorted(file.name for file in cache.iterdir())}
