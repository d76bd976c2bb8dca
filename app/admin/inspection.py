"""A database that may be anybody's, looked at without letting anything in it work.

A database can name code of SQLite's: a view that never ends, a trigger, a computed column; and a file
beside it can make SQLite delete another one (a hot journal names its super-journal). So it is opened as
it is, with no file beside it looked at, its schema is compared with ours before any other query, and
every query is ended when its time is over.
"""

from __future__ import annotations

import json
import sqlite3
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from onedemo.errors import UserError
from onedemo.storage.run_directory import check_run_name
from onedemo.storage.schema import check_schema
from onedemo.storage.segment_codec import unpack_segment

_SECONDS = 60.0
_BYTES_PER_S = 2e6
"""A slow disk reads and checks at least so many."""
_MOTION = (
    ("segments", "clip_id", "data"),
    ("pairs", "id", "left_segment, right_segment"),
)
"""Tables that hold motion: key and columns."""
_LARGEST = 1e6
"""Of what a robot does, in any unit: of random bytes, half are larger as numbers."""
_TIMES = {
    table: "created_at" for table in ("raters", "tokens", "runs", "clips", "snapshots", "iterations",
                                      "events", "pairs", "comparisons")
} | {"audit": "at"}  # fmt: skip
_TIME = "[0-9][0-9][0-9][0-9]-[0-9][0-9]-[0-9][0-9]T[0-9][0-9]:[0-9][0-9]:[0-9][0-9]*Z"
_STEPS = 10_000
"""Of SQLite's machine between two looks at the clock."""
_NUMBERS = {
    "runs": ("seed", "clips"),
    "snapshots": ("number", "last_event", "ratings"),
    "iterations": ("number", "snapshot", "env_steps"),
    "clips": ("demo_step", "steps", "iteration", "snapshot"),
    "events": ("snapshot", "latency_ms"),
    "pairs": ("demo_step", "steps", "iteration"),
    "comparisons": ("latency_ms",),
}
"""Columns in which SQLite would keep a text, too, if somebody wrote one."""


def opened_as_it_is(path: Path) -> sqlite3.Connection:
    """A connection that only reads, looks at no journal, and gives up after a minute and a size's worth.

    For a database that nobody else has open.

    Raises:
        sqlite3.Error: If it is no database.
    """
    db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    give_up_after(db, seconds_for(path))
    db.execute("PRAGMA trusted_schema = OFF")
    db.execute("PRAGMA cell_size_check = ON")
    return db


def seconds_for(path: Path) -> float:
    """How long looking at a database may take."""
    return _SECONDS + path.stat().st_size / _BYTES_PER_S


def give_up_after(db: sqlite3.Connection, seconds: float) -> None:
    """Lets every query of a connection end with an error once that much time has passed."""
    until = time.monotonic() + seconds
    db.set_progress_handler(lambda: time.monotonic() > until, _STEPS)


def check_contents(db: sqlite3.Connection) -> int:
    """How many ratings a database has that is ours and whole.

    Raises:
        ValueError: As ``check_schema``.
        UserError: If it is damaged, or something in it cannot be what it should be.
        sqlite3.Error: If it cannot be read, or not in time.
    """
    check_schema(db)
    (said,) = db.execute("PRAGMA integrity_check(1)").fetchone()
    if said != "ok":
        raise UserError(said)
    lost = db.execute("PRAGMA foreign_key_check").fetchone()
    if lost is not None:
        raise UserError(f"rows of {lost[0]} belong to nothing")
    for table, columns in _NUMBERS.items():
        where = " OR ".join(f"typeof({column}) != 'integer'" for column in columns)
        if db.execute(f"SELECT 1 FROM {table} WHERE {where} LIMIT 1").fetchone():
            raise UserError(f"its table {table} holds text in the place of a number")
    for (run,) in db.execute("SELECT id FROM runs"):
        check_run_name(run)
    return db.execute("SELECT COUNT(*) FROM ratings").fetchone()[0]


def faults_in_rows(db: sqlite3.Connection) -> Iterator[str]:
    """What is damaged in the rows of a database of ours, and not seen by SQLite, which keeps no checksums.

    Everything is read and decoded: motion must be finite, of one width and of a size that motion has, times
    must be times, and what is counted by triggers must be what the events say.
    """
    for table, key, blobs in _MOTION:
        for number, *data in db.execute(f"SELECT {key}, {blobs} FROM {table} ORDER BY {key}"):
            if any(_is_no_motion(one) for one in data):
                yield f"the motion of {table} {number} is damaged"
    for table, column in _TIMES.items():
        no_time = f"SELECT COUNT(*) FROM {table} WHERE {column} NOT GLOB ?"
        (wrong,) = db.execute(no_time, (_TIME,)).fetchone()
        if wrong:
            yield f"{wrong} times in {table} are not times"
    for table in ("snapshots", "iterations"):
        for run, number, stats in db.execute(f"SELECT run, number, stats FROM {table}"):
            try:
                json.loads(stats)
            except (ValueError, TypeError, RecursionError):
                yield f"what {table} {number} of run {run} says is damaged"
    for run, config in db.execute("SELECT id, config FROM runs"):
        try:
            tomllib.loads(config)
        except (ValueError, TypeError, AttributeError):
            yield f"the settings of run {run} are damaged"
    counted = (
        "SELECT c.run, e.rater_id, c.stage, e.value, COUNT(*) FROM ratings r JOIN events e ON e.id = r.id"
        " JOIN clips c ON c.id = e.clip_id WHERE e.repeat = 0 GROUP BY 1, 2, 3, 4"
    )
    kept = "SELECT run, rater_id, stage, value, ratings FROM tallies WHERE ratings != 0"
    if set(db.execute(counted)) != set(db.execute(kept)):
        yield "the counts of ratings are not those of the events"


def _is_no_motion(data: bytes) -> bool:
    try:
        segment = unpack_segment(data)
        arrays = [segment.obs, segment.actions, segment.qpos, segment.qvel]
        return not all(np.isfinite(array).all() and (abs(array) < _LARGEST).all() for array in arrays)
    except Exception:  # whatever NumPy says of a broken header
        return True
