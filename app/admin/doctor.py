"""What is wrong with an installation and its data directory, in plain words. Changes nothing."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from importlib import metadata
from itertools import islice
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory

import numpy as np

from onedemo.app.admin.inspection import (
    check_contents,
    faults_in_rows,
    give_up_after,
    opened_as_it_is,
    seconds_for,
)
from onedemo.config import RunConfig, load_config
from onedemo.core.files import ON_SHARED, archive_fault, jpeg_fault
from onedemo.core.shared_disks import file_system, is_shared
from onedemo.demos.edits import Options
from onedemo.demos.library import is_whole, list_demos
from onedemo.demos.sandboxed_decoder import decode
from onedemo.demos.video import write_webm
from onedemo.errors import UserError
from onedemo.render.render_thread import RenderThread
from onedemo.render.renderer import HEIGHT, WIDTH
from onedemo.robots import registry
from onedemo.robots.library import load_robot, robots_in
from onedemo.storage.database import FILE_NAME, rescued_files
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.schema import STEPS, check_schema
from onedemo.training.runs import disk_needed
from onedemo.vision.encoders import make_encoder

_NAMED = 3
"""Files of a kind that are named; of more, the number."""
_FRAMES = 12
"""Of the video that is tried."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    what: str
    ok: bool
    said: str
    """What was found and, if it is not well, what would help."""


def examine(data_dir: Path, *, full: bool = False) -> Iterator[Finding]:
    """Looks at everything, one thing after another; a check that fails is a finding, too.

    Args:
        data_dir: May not be there yet: then only the installation is looked at.
        full: Read every row of the database, too, and decode what is in it.
    """
    checks: list[tuple[str, Callable[[], Iterator[Finding]]]] = [
        ("onedemo", _version),
        ("pictures", _pictures),
        ("videos", _videos),
        ("image network", lambda: _encoder(data_dir)),
        ("disk", lambda: _disk(data_dir)),
        ("privacy", lambda: _privacy(data_dir)),
        ("rescued", lambda: _rescued(data_dir)),
    ]
    if any(robots_in(data_dir)):
        checks.append(("robots", lambda: _robots(data_dir)))
    if (data_dir / FILE_NAME).exists():
        checks += [
            ("database", lambda: _database(data_dir, full)),
            ("files", lambda: _files(data_dir)),
            ("demonstrations", lambda: _demos(data_dir)),
            ("robots", lambda: _robots_of_runs(data_dir)),
        ]
    for what, check in checks:
        try:
            yield from check()
        except (UserError, OSError, sqlite3.Error) as error:
            yield Finding(what, False, str(error))
    if not (data_dir / FILE_NAME).exists():
        runs = sorted(path.parent for path in data_dir.glob("runs/*/config.toml"))
        yield Finding(
            "database", not runs,
            f"{data_dir / FILE_NAME} is missing, but {_name(runs)} is there: restore a backup into another "
            "directory, or put a rescued database in its place if there is one"
            if runs else f"none in {data_dir} yet",
        )  # fmt: skip


def _version() -> Iterator[Finding]:
    yield Finding("onedemo", True, f"{metadata.version('onedemo')}, Python {sys.version.split()[0]}")


def _pictures() -> Iterator[Finding]:
    qpos = np.array([[0.0, 1.25, 0.0, 0.0, 0.0, 0.0]])
    with RenderThread() as drawing:
        (picture,) = drawing.render(qpos).result()
    if picture.std() < 1:
        yield Finding(
            "pictures", False, "OpenGL draws nothing but one colour: update the graphics driver (Mesa)"
        )
    else:
        yield Finding("pictures", True, f"the robot can be drawn ({WIDTH} x {HEIGHT})")


def _videos() -> Iterator[Finding]:
    """Whether a video can be brought in: what decodes it has limits, which not every system grants."""
    moving = (np.roll(np.indices((48, 64)).sum(0, dtype=np.uint8), 4 * k) for k in range(_FRAMES))
    with TemporaryDirectory() as place:
        file = Path(place) / "small.webm"
        write_webm(file, (np.dstack([frame] * 3) for frame in moving), fps=30)
        try:
            with closing(decode(file, Options())) as frames:
                count = sum(1 for _ in frames)
        except UserError as error:
            said = str(error).replace(str(file), "a small one of onedemo's own")
            yield Finding("videos", False, f"no video can be brought in here: {said}")
            return
    yield Finding(
        "videos", count == _FRAMES,
        "videos can be brought in" if count == _FRAMES
        else f"of {_FRAMES} pictures of a video {count} are decoded: install av again",
    )  # fmt: skip


def _encoder(data_dir: Path) -> Iterator[Finding]:
    encoder = make_encoder("efficientnet-lite0")
    features = encoder.encode(iter([np.zeros((HEIGHT, WIDTH, 3), np.uint8)]))
    if features.shape != (1, encoder.dims) or not np.isfinite(features).all():
        yield Finding("image network", False, f"{encoder.name} gives no features: install onedemo again")
        return
    kept = [*data_dir.glob("demos/*/features-*.npz"), *data_dir.glob("robots/*.npz")]
    broken = sorted(_broken(kept, archive_fault))
    yield Finding(
        "image network", not broken,
        f"{_name(broken)} damaged: delete it, it is made anew" if broken
        else f"{encoder.name} works; {_count(len(kept), 'file')} of features kept",
    )  # fmt: skip


def _disk(data_dir: Path) -> Iterator[Finding]:
    there = data_dir.absolute()
    while not there.exists():
        there = there.parent
    free, kind = shutil.disk_usage(there).free, file_system(there)
    if not os.access(there, os.W_OK):
        yield Finding(
            "disk", False, f"{there} cannot be written to: change its owner or choose another --data-dir"
        )
    elif free < 2 * (needed := _needed(data_dir)):
        yield Finding(
            "disk", False,
            f"{free / 1e6:,.0f} MB free for {there}: make room, a run needs about {needed / 1e6:,.0f} MB",
        )  # fmt: skip
    else:
        what = f"{free / 1e9:,.1f} GB free{f', {kind}' if kind else ''}"
        yield Finding("disk", True, f"{what}; a run needs about {needed / 1e6:,.0f} MB")
    if is_shared(there):
        yield Finding("disk", False, f"{ON_SHARED.format(there)} ({kind})")


def _privacy(data_dir: Path) -> Iterator[Finding]:
    """What other users of the computer could read."""
    if data_dir.exists() and data_dir.stat().st_mode & 0o077:
        yield Finding(
            "privacy", False, f"others on this computer can look into {data_dir}: chmod -R go-rwx {data_dir}"
        )
    secret = data_dir / "link-secret"
    if secret.exists() and secret.stat().st_mode & 0o077:
        yield Finding(
            "secret", False, f"others may read {secret}, which is behind all links: chmod 600 {secret}"
        )


def _rescued(data_dir: Path) -> Iterator[Finding]:
    """What a server saved that had its database taken away: no run and no backup takes it up by itself."""
    place = data_dir / FILE_NAME
    for file in rescued_files(data_dir):
        try:
            with closing(opened_as_it_is(file)) as db:
                holds = f"holds {_count(check_contents(db), 'rating')}"
        except (ValueError, UserError, sqlite3.Error) as error:
            yield Finding("rescued", False, f"{file} is no whole database ({error}): delete it")
            continue
        yield Finding(
            "rescued", False,
            f"{file} {holds}; a server saved it when its database was deleted, and no backup holds it: to go "
            f"on with it, stop onedemo and run `rm -f {quote(f'{place}-wal')} {quote(f'{place}-shm')} && "
            f"mv {quote(str(file))} {quote(str(place))}`; if "
            f"{FILE_NAME} has all of it, delete it",
        )  # fmt: skip


def _needed(data_dir: Path) -> float:
    """Bytes that a run like the newest takes, or one with the defaults."""
    files = sorted(data_dir.glob("runs/*/config.toml"), key=lambda file: file.stat().st_mtime)
    try:
        return disk_needed(load_config(files[-1]) if files else RunConfig())
    except UserError:  # of a later version, or damaged: opening the run says so
        return disk_needed(RunConfig())


def _database(data_dir: Path, full: bool) -> Iterator[Finding]:
    path = data_dir / FILE_NAME
    with closing(_open(path)) as db:
        try:
            version = check_schema(db)
        except ValueError as error:
            yield Finding("database", False, f"{path} was {error}")
            return
        said = [line for (line,) in db.execute("PRAGMA integrity_check(5)")]
        if said != ["ok"]:
            yield Finding("database", False, f"{path} is damaged ({'; '.join(said)}): restore a backup")
            return
        lost = db.execute("PRAGMA foreign_key_check").fetchall()
        if lost:
            tables = ", ".join(sorted({row[0] for row in lost}))
            yield Finding(
                "database", False, f"{len(lost)} rows of {tables} belong to nothing: restore a backup"
            )
            return
        (ratings,) = db.execute("SELECT COUNT(*) FROM ratings").fetchone()
        if full and (wrong := list(islice(faults_in_rows(db), _NAMED))):
            yield Finding("database", False, f"{path} is damaged ({'; '.join(wrong)}): restore a backup")
            return
    schema = f"schema {version}"
    if version < max(STEPS):
        schema += f", which is brought to {max(STEPS)} when onedemo opens it"
    how = "whole, every row read" if full else "whole"
    yield Finding("database", True, f"{how}; {_count(ratings, 'rating')}; {schema}")


def _files(data_dir: Path) -> Iterator[Finding]:
    """What the database names and the disk lacks, and the other way round; what is damaged."""
    with closing(_open(data_dir / FILE_NAME)) as db:
        runs = [run for (run,) in db.execute("SELECT id FROM runs")]
        snapshots = db.execute("SELECT run, number FROM snapshots").fetchall()
        waiting = db.execute(
            "SELECT run, id FROM clips WHERE state = 'ready'"
            " AND id NOT IN (SELECT clip_id FROM events WHERE clip_id IS NOT NULL)"
        ).fetchall()
    root = data_dir / "runs"
    for run in runs:
        try:
            RunDirectory(data_dir, run)
        except UserError as error:  # a database of somebody else's: no path is made of it
            yield Finding("files", False, f"the database names a run that cannot be a directory: {error}")
            return
    named = {RunDirectory(data_dir, run).snapshot(number) for run, number in snapshots}
    there = set(root.glob("*/snapshots/*.pt"))
    clips = {RunDirectory(data_dir, run).clip(clip) for run, clip in waiting}
    pictures = set(root.glob("*/clips/*.jpg"))
    kept = [*there, *root.glob("*/checkpoint*.pt"), *root.glob("*/rollouts/*.npz")]
    orphans = [path for path in root.glob("*") if path.is_dir() and path.name not in runs]
    half = [path for path in data_dir.rglob(".*") if path.is_file()]
    faults = [
        ("lacks", named - there, "a predictor; the newest there is used, and the next fit makes another"),
        ("lacks", clips - pictures, "the picture of a clip; it is drawn again when onedemo starts"),
        ("holds a damaged", _broken(kept, archive_fault), "it will be set aside, and the one before used"),
        ("holds a damaged", _broken(clips & pictures, jpeg_fault), "delete it, it is drawn again"),
        ("set aside", set(data_dir.rglob("*.damaged")), "it was damaged and has been made anew: delete it"),
        ("does not know", set(orphans), "a directory of no run: delete it if nothing in it is wanted"),
        ("does not know", there - named, "a predictor that came too late: delete it if no server runs"),
        ("left half written", set(half), "delete it if no server runs"),
    ]  # fmt: skip
    well = True
    for verb, paths, advice in faults:
        if paths:
            well = False
            yield Finding("files", False, f"{data_dir} {verb} {_name(sorted(paths))}: {advice}")
    if well:
        total = len(named) + len(clips)
        yield Finding("files", True, f"{_count(len(runs), 'run')}, {_count(total, 'file')} where they belong")


def _demos(data_dir: Path) -> Iterator[Finding]:
    there = [path.parent for path in (data_dir / "demos").glob("*/demo.json")]
    demos = list_demos(data_dir / "demos")
    known = {demo.path.parent: demo for demo in demos}
    broken = [path for path in there if path not in known or not is_whole(known[path])]
    with closing(_open(data_dir / FILE_NAME)) as db:
        wanted = db.execute("SELECT id, demo, demo_sha256 FROM runs").fetchall()
    whole = {demo.sha256 for demo in demos}
    lost = [(run, demo, sha256) for run, demo, sha256 in wanted if sha256 not in whole]
    for run, demo, sha256 in lost[:_NAMED]:
        yield Finding(
            "demonstrations", False,
            f"run {run} cannot go on, its demo {demo} is gone: put demos/{sha256} back from a backup",
        )  # fmt: skip
    if broken:
        yield Finding("demonstrations", False, f"{_name(broken)} damaged: delete it and add the video again")
    elif not lost:
        yield Finding("demonstrations", True, f"{_count(len(there), 'video')} of your own, as brought in")


def _robots(data_dir: Path) -> Iterator[Finding]:
    """Whether a person's own robots are what was added."""
    whole = 0
    for _, file in robots_in(data_dir):
        try:
            load_robot(file)
            whole += 1
        except UserError as error:
            yield Finding("robots", False, str(error))
    if whole:
        yield Finding("robots", True, f"{_count(whole, 'robot')} of your own, as added")


def _robots_of_runs(data_dir: Path) -> Iterator[Finding]:
    """Runs that cannot go on because their robot is gone or another."""
    registry.use(data_dir)
    with closing(_open(data_dir / FILE_NAME)) as db:
        runs = db.execute("SELECT id, config FROM runs").fetchall()
    for run, text in runs:
        try:
            config = tomllib.loads(text)
            robot = registry.robot_named(str(config.get("env", registry.DEFAULT)))
            if config.get("env_sha256", "") not in ("", robot.sha256):
                raise UserError(f"robot {robot.name} has another model than it was made with")
        except (UserError, tomllib.TOMLDecodeError) as error:
            yield Finding("robots", False, f"run {run} cannot go on, {error}: put robots/ back from a backup")


def _open(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=10)
    give_up_after(db, seconds_for(path))
    return db


def _broken(paths: Iterable[Path], fault: Callable[[bytes], str]) -> set[Path]:
    return {path for path in paths if _fault(path, fault)}


def _fault(path: Path, fault: Callable[[bytes], str]) -> bool:
    try:
        return bool(fault(path.read_bytes()))
    except FileNotFoundError:  # replaced meanwhile
        return False
    except OSError:
        return True


def _name(paths: list[Path]) -> str:
    first = ", ".join(str(path) for path in paths[:_NAMED])
    return first if len(paths) <= _NAMED else f"{first} and {len(paths) - _NAMED} more"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"
