"""Small trainings in processes that die: ``killed_training.py PLACE METHOD RATER MOMENT...``.

One in PLACE/whole is left alone. One in PLACE/broken ends by SIGKILL at each moment, goes on in the next
process from what is on disk, and comes to its end in the last. All are forks of a process that has
imported what they need and has done nothing yet: importing takes as long as such a training.
``outcome`` is what they leave behind. For ``test_resume.py``.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sqlite3
import sys
import traceback
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from helpers import small_world
from onedemo.core import files
from onedemo.reward.model import Snapshot
from onedemo.storage.clips import Clips
from onedemo.storage.database import FILE_NAME
from onedemo.storage.ratings import Ratings
from onedemo.storage.runs import Runs
from onedemo.storage.store import Store
from onedemo.training.learner import Learner
from onedemo.training.simulated_run import train
from onedemo.types import Demo

MOMENTS = {
    "amid the first ratings": ("ratings", "rate", 2, True),
    "in a fit": ("learner", "fit", 2, False),
    "between a snapshot and its row": ("snapshot", "save", 2, True),
    "in the first iteration": ("learner", "iterate", 1, False),
    "with half a checkpoint": ("os", "replace", 2, False),
    "between a checkpoint and its row": ("os", "replace", 1, True),
    "between two iterations": ("runs", "add_iteration", 2, True),
    "with questions asked and not answered": ("clips", "add", 1, True),
    "after an answer": ("ratings", "rate", 1, True),
}
"""Where a process dies: whose method, its name, at which call in that process, before or after it."""


def die() -> None:
    """Ends this process as a power cut would."""
    os.kill(os.getpid(), signal.SIGKILL)


def arm(moment: str) -> None:
    """Sees to it that this process dies at that moment."""
    owner, name, call, after = MOMENTS[moment]
    where = {
        "clips": Clips,
        "ratings": Ratings,
        "runs": Runs,
        "snapshot": Snapshot,
        "os": files.os,
        "learner": Learner,
    }[owner]
    whole, calls = getattr(where, name), 0

    def dying(*args, **kwargs):
        nonlocal calls
        calls += name != "replace" or Path(args[1]).name == "checkpoint.pt"
        if calls == call and not after:
            die()
        result = whole(*args, **kwargs)
        if calls == call:
            die()
        return result

    setattr(where, name, dying)


def practise(data_dir: Path, method: str, rater: str) -> None:
    """The training, from whatever is on disk."""
    config = small_world.small_config(
        method=method, ratings__rounds=3, ratings__online=4, rollouts__total_steps=1600,
        predictor__appearance=False, predictor__members=1,
    )  # fmt: skip
    demo = Demo(**json.loads((data_dir.parent / "demo.json").read_text()))
    demo = replace(demo, path=Path(demo.path))
    with closing(Store(data_dir)) as store:
        train(
            store=store, data_dir=data_dir, demo=demo, config=config, encoder=small_world.Thumbnail(),
            rater=rater, name="r", progress=False,
        )  # fmt: skip


def outcome(data_dir: Path) -> dict:
    """What a training leaves behind, but for times."""
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        rows = {
            "ratings": "SELECT clip_id, kind, value, mark_from, mark_to FROM events ORDER BY id",
            "clips": "SELECT id, demo_step, stage, iteration, snapshot, predicted, choice, score FROM clips",
            "segments": "SELECT clip_id, hex(data) FROM segments ORDER BY clip_id",
            "snapshots": "SELECT number, last_event, ratings FROM snapshots ORDER BY number",
        }
        found: dict[str, Any] = {name: [list(row) for row in db.execute(sql)] for name, sql in rows.items()}
        curve = db.execute("SELECT number, snapshot, env_steps, stats FROM iterations ORDER BY number")
        found["curve"] = [
            [*row, {**json.loads(stats), "steps_per_s": 0, "seconds": 0}] for *row, stats in curve
        ]
    found["segments"] = [
        [clip, hashlib.sha256(data.encode()).hexdigest()] for clip, data in found["segments"]
    ]
    saved = torch.load(data_dir / "runs" / "r" / "checkpoint.pt", weights_only=True)
    digest = hashlib.sha256()

    def add(value: object) -> None:
        if isinstance(value, dict):
            for key in value:
                digest.update(str(key).encode())
                add(value[key])
        elif isinstance(value, torch.Tensor):
            digest.update(value.contiguous().numpy().tobytes())
        else:
            digest.update(repr(value).encode())

    add(saved["learner"])
    found["learner"] = digest.hexdigest()
    return found


def begin(data_dir: Path, method: str, rater: str, moment: str = "") -> int:
    """The number of a process that trains there until it is done, or dies at that moment."""
    if child := os.fork():
        return child
    code = 1
    try:
        if moment:
            arm(moment)
        practise(data_dir, method, rater)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def end(child: int, expected: int, what: str) -> None:
    """Waits until it has ended, as it should."""
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code != expected:
        sys.exit(f"{what}: ended with {code}, not {expected}")


if __name__ == "__main__":
    place, method, rater, *moments = sys.argv[1:]
    whole = begin(Path(place) / "whole", method, rater)
    for moment in moments:
        end(begin(Path(place) / "broken", method, rater, moment), -signal.SIGKILL, moment)
    end(begin(Path(place) / "broken", method, rater), 0, "the last")
    end(whole, 0, "the one that was left alone")
