"""Making a run, or finding the one to go on with."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass, replace
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

from onedemo.config import RunConfig, load_config, to_toml
from onedemo.core.files import write_atomic
from onedemo.core.names import check_name, check_new_name
from onedemo.errors import UserError
from onedemo.robots.registry import robot_named
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.training.learner import lengths
from onedemo.types import Demo


def program_version() -> str:
    """The installed version of onedemo."""
    return version("onedemo")


def disk_needed(config: RunConfig) -> float:
    """Bytes that a run takes on the disk when it is done, about.

    A rating takes a segment and its events; an iteration a snapshot, its best rollout and the segments of
    clips that nobody rated; to these come two checkpoints, SQLite's log, and the features of a demo.
    """
    ratings = config.ratings.pretrain + config.ratings.online
    iterations = config.rollouts.total_steps / (config.rollouts.lanes * config.rollouts.steps)
    return config.storage.pictures_gb * 1e9 + 10e3 * ratings + 55e3 * iterations + 30e6


def find_run(
    store: Store, data_dir: Path, demo: Demo, *, name: str | None, wanted: RunConfig | None
) -> tuple[str, RunConfig] | None:
    """The earlier run to go on with, and its settings; None if there is none.

    Args:
        store: Where runs are recorded.
        data_dir: Holds ``runs/<name>/config.toml``.
        demo: What is to be learned.
        name: Which run, or None: the newest of this demo.
        wanted: Settings that were asked for; None takes those the run was made with.

    Raises:
        UserError: If the run has other settings, or was made with another video or model of the robot.
    """
    runs = store.runs.all()
    found = [r for r in runs if (r["id"] == name if name else r["demo"] == demo.name)]
    if not found and name is None:  # the demo was renamed, and the database does not know
        found = [r for r in runs if r["demo_sha256"] == demo.sha256]
    if not found:
        return None
    run = found[-1]
    if run["demo_sha256"] != demo.sha256:
        raise UserError(
            f"run {run['id']!r} was made with another video than demo {demo.name!r} is now; put "
            f"demos/{run['demo_sha256']} back from a backup, or start a new run with --new-run"
        )
    file = RunDirectory(data_dir, run["id"]).config
    if not file.exists():  # lost with the directory; the database has it too
        write_atomic(file, run["config"].encode())
    config = load_config(file, _of_before(file))
    if config.env_sha256 not in ("", robot_named(config.env).sha256):
        raise UserError(
            f"run {run['id']!r} was made with another model of robot {config.env} than there is now; bring "
            "back the one that it was made with, or start a new run with --new-run"
        )
    config = replace(config, env_sha256="")  # has said what it had to
    if wanted is not None:  # where it computes, and what it leaves on the disk, is no part of what a run is
        config = replace(config, device=wanted.device, storage=wanted.storage)
        wanted = replace(wanted, env_sha256="")
    if wanted is not None and wanted != config:
        raise UserError(
            f"run {run['id']!r} has other settings than those given: {_differences(config, wanted)} "
            f"(see {file}); use the same or none, or start a new run with --new-run"
        )
    return run["id"], config


def _of_before(file: Path) -> dict[str, Any]:
    """What a legacy config without a method leaves out: those runs are the paper's."""
    text = file.read_text()
    if re.search(r"^method = ", text, re.MULTILINE):
        return {}
    max_kl = re.search(r"^max_kl = (\S+)$", text, re.MULTILINE)
    stayed = {"trpo.final_kl": float(max_kl[1])} if max_kl else {}
    return {"method": "paper"} | stayed


def _differences(made: RunConfig, wanted: RunConfig) -> str:
    """Where two configs differ: of other methods only that, of which the rest follows."""
    if made.method != wanted.method:
        return f"method is {made.method!r}, not {wanted.method!r}"
    theirs, ours = _leaves(made), _leaves(wanted)
    return ", ".join(
        f"{key} is {theirs[key]!r}, not {ours[key]!r}" for key in ours if ours[key] != theirs[key]
    )


def _leaves(config: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted key to value."""
    found: dict[str, Any] = {}
    for entry in fields(config):
        value = getattr(config, entry.name)
        nested = is_dataclass(value)
        found |= _leaves(value, f"{prefix}{entry.name}.") if nested else {prefix + entry.name: value}
    return found


def check_robot(demo: Demo, robot: str) -> None:
    """Raises UserError if the demo is of another robot than the one that would learn from it, by name."""
    if demo.robot and demo.robot != robot:
        raise UserError(
            f"demonstration {demo.name!r} shows robot {demo.robot!r}, but this run's robot is {robot!r}: "
            f"choose a demonstration of {robot!r}, or robot {demo.robot!r}"
        )


def add_run(store: Store, data_dir: Path, demo: Demo, config: RunConfig, *, name: str | None) -> str:
    """Records a new run and writes its settings; returns its name.

    Args:
        store: Where runs are recorded.
        data_dir: ``runs/<name>/config.toml`` is written in it.
        demo: What is to be learned.
        config: Its settings.
        name: What to call it, or None: ``<demo>-<number>``.

    Raises:
        UserError: If the demo is shorter than a clip or of another robot, the robot is unknown, or the name
            is taken or cannot be the name of a directory.
    """
    robot = robot_named(config.env)
    check_robot(demo, robot.name)
    if config.env_sha256 not in ("", robot.sha256):
        raise UserError(
            f"these settings are of a run with another model of robot {config.env} than there is now; leave "
            "env_sha256 out to use the one there is"
        )
    lengths(config, demo.frames, demo.fps)
    if name is not None:
        check_new_name(check_name(name))
    else:
        taken = {r["id"] for r in store.runs.all()}
        name = next(n for k in count(1) if (n := f"{demo.name}-{k}") not in taken)
    text = to_toml(replace(config, env_sha256=robot.sha256))
    store.runs.add(
        run=name,
        demo=demo.name,
        demo_sha256=demo.sha256,
        seed=config.seed,
        config=text,
        version=program_version(),
        step_seconds=robot.dt,
    )
    write_atomic(RunDirectory(data_dir, name).config, text.encode())
    return name
