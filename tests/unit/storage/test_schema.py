"""A stored database of every schema version opens with today's code, with all it holds."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing

import numpy as np
import pytest

from helpers.paths import DATABASES
from onedemo.errors import UserError
from onedemo.storage.database import FILE_NAME
from onedemo.storage.schema import STEPS
from onedemo.storage.store import Store

STORED = DATABASES
sys.path.insert(0, str(STORED))
import make  # noqa: E402

COUNTED = ("tallies",)  # by triggers; looked at by itself


def read(path):
    """Every table: its columns and rows."""
    with closing(sqlite3.connect(path)) as db:
        names = [
            n for (n,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")
        ]
        names = [name for name in names if not name.startswith("sqlite_")]
        return {
            name: ([row[1] for row in db.execute(f"PRAGMA table_info({name})")],
                   db.execute(f"SELECT * FROM {name} ORDER BY 1, 2").fetchall())
            for name in names
        }  # fmt: skip


@pytest.fixture(params=range(1, len(STEPS) + 1))
def version(request):
    return request.param


@pytest.fixture
def old(version, tmp_path):
    shutil.copy(STORED / f"v{version}.sqlite3", tmp_path / FILE_NAME)
    return tmp_path / FILE_NAME


def test_every_version_is_stored(version):
    with closing(sqlite3.connect(STORED / f"v{version}.sqlite3")) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (version,)
    assert all(rows for _, rows in read(STORED / f"v{version}.sqlite3").values())  # no table is empty


def test_every_row_survives_with_its_values(old, version):
    before = read(old)
    with closing(Store(old.parent)) as store:
        assert store.database.rows("PRAGMA user_version") == [(len(STEPS),)]
        assert store.database.rows("PRAGMA integrity_check") == [("ok",)]
        assert store.database.rows("PRAGMA foreign_key_check") == []
    after = read(old)
    for table, (columns, rows) in before.items():
        if table in COUNTED:
            continue
        new_columns, new_rows = after[table]
        kept = [new_columns.index(name) for name in columns]
        assert sorted([tuple(row[i] for i in kept) for row in new_rows], key=str) == sorted(rows, key=str), (
            table
        )


def test_what_was_said_is_read_and_said_on(old, version):
    with closing(Store(old.parent)) as store:
        held = [(row[1], row[4], row[5]) for row in store.ratings.stream()]
        expected = [(1, "bo", 5), (1, "ada", 4), (2, "bo", 2), (4, "oracle", 3)]
        assert sorted(held) == sorted(expected + ([(1, "bo", 4)] if version >= 3 else []))
        assert sum(store.ratings.by_class("hop-1")) == 4  # second opinions are not counted
        marks = store.database.rows("SELECT mark_from, mark_to FROM events WHERE mark_from IS NOT NULL")
        assert marks == ([] if version < 3 else [(3, 4)] if version < 6 else [(1, 3)])
        assert [clip.id for clip in store.clips.waiting("hop-1")] == [5, 6] if version < 3 else [6]
        for number in range(1, 7):
            wanted, there = make.segment(number), store.clips.segment(number)
            for name in make.SIZES:
                np.testing.assert_allclose(getattr(there, name), getattr(wanted, name), rtol=1e-6)
        bo = next(rater for rater in store.accounts.raters() if rater.name == "bo")
        assert (
            store.accounts.rater_of("a" * 64, "link") == bo
            and store.accounts.rater_of("c" * 64, "link") is None
        )
        assert (
            store.runs.snapshots("hop-1")[0]["loss"] == 0.5
            and store.runs.iterations("hop-1")[0]["predicted"] == 2.0
        )
        event = store.ratings.rate(6, bo.id, 5, latency_ms=5)
        store.ratings.undo(1, bo.id)
        assert store.ratings.last_event() == event + 1
        assert sum(store.ratings.by_class("hop-1")) == 4


def test_marks_in_seconds_become_the_control_steps_that_they_were_made_of(tmp_path):
    file = tmp_path / FILE_NAME
    shutil.copy(STORED / "v5.sqlite3", file)
    marks = [(first, after) for first in range(0, 40, 3) for after in range(first + 1, 42, 4)]
    with closing(sqlite3.connect(file)) as db, db:
        for number, (first, after) in enumerate(marks, start=100):
            db.execute(
                "INSERT INTO clips (id, run, demo_step, steps, stage, iteration, snapshot, created_at)"
                " VALUES (?, 'hop-1', 5, 41, 'online', 1, 1, '')",
                (number,),
            )
            db.execute(
                "INSERT INTO events (clip_id, rater_id, kind, value, mark_start, mark_end, snapshot,"
                " latency_ms, created_at) VALUES (?, 2, 'rate', 2, ?, ?, 1, 900, '')",
                (number, round(first * 0.008, 6), round(after * 0.008, 6)),
            )
    with closing(Store(tmp_path)) as store:
        assert [r.mark for r in store.ratings.for_training("hop-1") if r.clip >= 100] == marks
        seconds = [(row[15], row[16]) for row in store.ratings.stream() if row[1] >= 100]
        assert seconds == [(round(first * 0.008, 6), round(after * 0.008, 6)) for first, after in marks]
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            store.database.rows("UPDATE events SET mark_from = 0")


def test_a_newer_database_is_refused_and_not_touched(tmp_path):
    file = tmp_path / FILE_NAME
    shutil.copy(STORED / f"v{len(STEPS)}.sqlite3", file)
    with closing(sqlite3.connect(file)) as db:
        db.execute(f"PRAGMA user_version = {len(STEPS) + 1}")
    before = file.read_bytes()
    with pytest.raises(UserError, match="written by a newer onedemo"):
        Store(tmp_path)
    assert file.read_bytes() == before and [path.name for path in tmp_path.iterdir()] == [FILE_NAME]


MIGRATE = (
    "import sys; from pathlib import Path; from onedemo.storage.store import Store; Store(Path(sys.argv[1]))"
)


@pytest.mark.slow
def test_a_migration_that_is_killed_leaves_a_whole_version(tmp_path):
    """Killed at moments all over it, each database is of some version and goes on from there."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", MIGRATE, str(_copy(tmp_path / "timed"))], check=True)
    whole = time.monotonic() - began
    seen = set()
    for number in range(8):
        directory = _copy(tmp_path / f"{number}")
        child = subprocess.Popen([sys.executable, "-c", MIGRATE, str(directory)])
        time.sleep(whole * (0.86 + 0.02 * number))
        child.send_signal(signal.SIGKILL)
        child.wait()
        with closing(sqlite3.connect(directory / FILE_NAME)) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            seen.add(db.execute("PRAGMA user_version").fetchone()[0])
        with closing(Store(directory)) as store:
            assert len(list(store.ratings.stream())) == 4
    assert seen <= set(range(1, len(STEPS) + 1))


def _copy(directory):
    directory.mkdir()
    shutil.copy(STORED / "v1.sqlite3", directory / FILE_NAME)
    return directory
