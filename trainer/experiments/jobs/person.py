"""The job behind the case study: a video of a real person, and a rater that goes by hand-made marks.

Settings of a job are those of ``onedemo.experiments.jobs.method`` without ``demo``; the rater "script",
which errors may follow, goes by the marks beside this file. The video is not part of this program.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from onedemo.core.files import hold
from onedemo.demos.library import import_video
from onedemo.errors import UserError
from onedemo.experiments.jobs import method
from onedemo.experiments.jobs.method import whole_config
from onedemo.experiments.runner import Job
from onedemo.types import Demo

VIDEO = "person_backflip_480.mp4"
VARIABLE = "ONEDEMO_PERSON_VIDEO"
MARKS = Path(__file__).with_name("person_backflip.json")

_DEMO = "person-backflip"


def video() -> Path:
    """The person's video, which the environment variable ``ONEDEMO_PERSON_VIDEO`` names.

    Raises:
        UserError: If it is not there.
    """
    named = os.environ.get(VARIABLE, "")
    if not named:
        raise UserError(
            f"the video of the person ({VIDEO}) is no part of onedemo; name its file with the environment "
            f"variable {VARIABLE}"
        )
    if not Path(named).is_file():
        raise UserError(f"there is no video at {VARIABLE}={named}")
    return Path(named)


def person_demo(demos_dir: Path) -> Demo:
    """The video as a demo, brought in if it is not yet.

    Raises:
        UserError: If it is not there or cannot be read.
    """
    return import_video(video(), name=_DEMO, demos_dir=demos_dir)


def person_job(
    label: str, seed: int, *, method: str = "onedemo", rater: str = "script", ratings: int = 350, steps: int,
    changes: Mapping[str, Any] | None = None,
) -> Job:  # fmt: skip
    """A job of kind "person". Arguments as ``onedemo.experiments.jobs.method.method_job``."""
    settings = {
        "method": method, "rater": rater, "ratings": ratings, "steps": steps, "set": dict(changes or {}),
    }  # fmt: skip
    return Job(kind="person", label=label, settings=settings | whole_config(settings), seed=seed)


def run(settings: Mapping[str, Any], seed: int, scratch: Path, cache: Path | None = None) -> dict[str, Any]:
    """Trains on the person's video and evaluates: arguments and result as ``jobs.method.run``."""
    cache = cache or scratch
    with hold(cache / "lock", wait=True):
        demo = person_demo(cache / "demos")
    kind, *errors = settings["rater"].split("+")
    rater = "+".join([f"script:{MARKS}" if kind == "script" else kind, *errors])
    return method.run({**settings, "demo": demo.name, "rater": rater}, seed, scratch, cache)
