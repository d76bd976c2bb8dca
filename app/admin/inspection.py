"""A database that may be anybody's, looked at without letting anything in it work.

A database can name code of SQLite's: a view that never ends, a trigger, a computed column; and a file
beside it can make SQLite delete another one (a hot journal names its super-journal). So it is opened as
it is, with no file beside it looked at, its schema is compared with ours before any other query, and
every query is ended when its time is over.
"""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path

from onedemo.errors import UserError
from onedemo.storage.run_directory import check_run_name
from onedemo.storage.schema import check_schema

_SECONDS = 60.0
_BYTES_PER_S = 2e6
"""A slow disk reads and checks at least so many."""
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
    give_up_after(db, _SECONDS + path.stat().st_size / _BYTES_PER_S)
    db.execute("PRAGMA trusted_schema = OFF")
    db.execute("PRAGMA cell_size_check = ON")
    return db


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
            raise UserError(f"a number in its table {table} is none")
    for (run,) in db.execute("SELECT id FROM runs"):
        check_run_name(run)
    return db.execute("SELECT COUNT(*) FROM ratings").fetchone()[0]
