"""A stored database of every released schema version opens with today's code, with all it holds."""

from __future__ import annotations

import io
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing

import numpy as np
import pytest

from helpers.paths import DATABASES
from onedemo.errors import UserError
from onedemo.storage.database import FILE_NAME
from onedemo.storage.schema import STEPS, migrate
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


@pytest.fixture(params=STEPS)
def version(request):
    return request.param


@pytest.fixture
def old(version, tmp_path):
    shutil.copy(STORED / f"v{version}.sqlite3", tmp_path / FILE_NAME)
    return tmp_path / FILE_NAME


@pytest.fixture
def stored(tmp_path):
    return _copy(tmp_path / "stored")


def _copy(directory):
    directory.mkdir()
    shutil.copy(STORED / f"v{NEXT - 1}.sqlite3", directory / FILE_NAME)
    return directory


def test_every_version_is_stored(version):
    with closing(sqlite3.connect(STORED / f"v{version}.sqlite3")) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (version,)
    assert all(rows for _, rows in read(STORED / f"v{version}.sqlite3").values())  # no table is empty


def test_every_row_survives_with_its_values(old, version):
    before = read(old)
    with closing(Store(old.parent)) as store:
        assert store.database.rows("PRAGMA user_version") == [(max(STEPS),)]
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
        assert sorted(held) == [(1, "ada", 4), (1, "bo", 4), (1, "bo", 5), (2, "bo", 2), (4, "oracle", 3)]
        assert sum(store.ratings.by_class("hop-1")) == 4  # second opinions are not counted
        marks = store.database.rows("SELECT mark_from, mark_to FROM events WHERE mark_from IS NOT NULL")
        assert marks == ([(3, 4)] if version < 6 else [(1, 3)])
        assert [clip.id for clip in store.clips.waiting("hop-1")] == [6]
        for number in range(1, 7):
            wanted, there = make.segment(number), store.clips.segment(number)
            for name in make.SIZES:
                np.testing.assert_allclose(getattr(there, name), getattr(wanted, name), rtol=1e-6)
        bo = next(rater for rater in store.accounts.raters() if rater.name == "bo")
        assert store.accounts.rater_of("a" * 64, "link") == bo
        assert store.accounts.rater_of("c" * 64, "link") is None
        assert store.runs.snapshots("hop-1")[0]["loss"] == 0.5
        assert store.runs.iterations("hop-1")[0]["predicted"] == 2.0
        event = store.ratings.rate(6, bo.id, 5, latency_ms=5)
        store.ratings.undo(1, bo.id)
        assert store.ratings.last_event() == event + 1
        assert sum(store.ratings.by_class("hop-1")) == 4


def put_marks(directory, steps, seconds):
    """A database of schema 5 with marks in seconds, on clips of so many steps from number 100 on."""
    shutil.copy(STORED / "v5.sqlite3", directory / FILE_NAME)
    with closing(sqlite3.connect(directory / FILE_NAME)) as db, db:
        for number, (start, end) in enumerate(seconds, start=100):
            db.execute(
                "INSERT INTO clips (id, run, demo_step, steps, stage, iteration, snapshot, created_at)"
                " VALUES (?, 'hop-1', 5, ?, 'online', 1, 1, '')",
                (number, steps),
            )
            db.execute(
                "INSERT INTO events (clip_id, rater_id, kind, value, mark_start, mark_end, snapshot,"
                " latency_ms, created_at) VALUES (?, 2, 'rate', 2, ?, ?, 1, 900, '')",
                (number, start, end),
            )


def marks_of(store):
    return [rating.mark for rating in store.ratings.for_training("hop-1") if rating.clip >= 100]


def test_marks_between_steps_are_rounded_as_they_were_read(tmp_path):
    put_marks(tmp_path, 37, [(0.1, 0.2), (0.108, 0.116), (1 / 60, 0.3), (0.3, 0.5)])
    with closing(Store(tmp_path)) as store:
        assert marks_of(store) == [(12, 25), (14, 15), (2, 37), (36, 37)]  # halves to even, within the clip


def test_marks_of_an_export_are_kept_within_their_clip(tmp_path):
    put_marks(tmp_path, 37, [(0.1, 0.2)])
    row = {"kind": "rate", "value": 2, "repeat": 1, "snapshot": 1, "latency_ms": 900, "created_at": ""}
    with closing(Store(tmp_path)) as store:
        for number, (start, end) in enumerate([(0.3, 0.333), (0.08, 0.08), (0.08, 0.16)], start=900):
            mark = {"id": number, "clip_id": 100, "rater_id": 2, "mark_start": start, "mark_end": end}
            store.ratings.restore(row | mark)
        kept = store.database.rows("SELECT mark_from, mark_to FROM events WHERE id >= 900 ORDER BY id")
    assert kept == [(36, 37), (10, 11), (10, 20)]


def test_marks_in_seconds_become_the_control_steps_that_they_were_made_of(tmp_path):
    marks = [(first, after) for first in range(0, 40, 3) for after in range(first + 1, 42, 4)]
    expected = [(round(first * 0.008, 6), round(after * 0.008, 6)) for first, after in marks]
    put_marks(tmp_path, 41, expected)
    with closing(Store(tmp_path)) as store:
        assert marks_of(store) == marks
        assert [(row[15], row[16]) for row in store.ratings.stream() if row[1] >= 100] == expected
        with (
            pytest.raises(sqlite3.IntegrityError, match="append-only"),
            store.database.transaction() as db,
        ):
            db.execute("UPDATE events SET mark_from = 0")


def test_a_segment_of_a_database_that_began_as_schema_1_is_read(stored):
    """Clips that were cut before segments were NPY kept their NPZ when the schema was brought to 5."""
    wanted, data = make.segment(3), io.BytesIO()
    np.savez(data, **{name: getattr(wanted, name).astype("f4") for name in make.SIZES})
    with closing(sqlite3.connect(stored / FILE_NAME)) as db:
        db.execute("UPDATE segments SET data = ? WHERE clip_id = 3", (data.getvalue(),))
        db.commit()
    with closing(Store(stored)) as store:
        there = store.clips.segment(3)
    for name in make.SIZES:
        assert getattr(there, name).dtype == np.float32
        np.testing.assert_allclose(getattr(there, name), getattr(wanted, name), rtol=1e-6)


def test_a_new_database_is_laid_out_as_the_stored_ones(tmp_path):
    """Also the order of columns: rows of segments, snapshots and iterations are inserted without names."""
    with closing(Store(tmp_path / "new")):
        pass
    shutil.copy(STORED / f"v{max(STEPS)}.sqlite3", tmp_path / FILE_NAME)
    new, stored = read(tmp_path / "new" / FILE_NAME), read(tmp_path / FILE_NAME)
    assert {name: columns for name, (columns, _) in new.items()} == {
        name: columns for name, (columns, _) in stored.items()
    }
    assert laws(tmp_path / "new" / FILE_NAME) == laws(tmp_path / FILE_NAME)


def laws(path):
    """Indices, triggers, views, and types and references of columns, however they came to be."""
    with closing(sqlite3.connect(path)) as db:
        said = {
            (kind, name): " ".join(sql.split())
            for kind, name, sql in db.execute("SELECT type, name, sql FROM sqlite_master WHERE sql NOT NULL")
            if kind != "table"
        }
        for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            said["columns", name] = db.execute(f"PRAGMA table_info({name})").fetchall()
            said["references", name] = db.execute(f"PRAGMA foreign_key_list({name})").fetchall()
    return said


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (1, "was written before onedemo 0.1.0 .schema version 1, this one reads 5 to 10.; open it with"),
        (4, "was written before onedemo 0.1.0 .schema version 4, "),
        (max(STEPS) + 1, "was written by a newer onedemo .*; update onedemo to open it"),
    ],
)
def test_a_database_of_another_time_is_refused_and_not_touched(tmp_path, number, said):
    file = tmp_path / FILE_NAME
    shutil.copy(STORED / f"v{max(STEPS)}.sqlite3", file)
    with closing(sqlite3.connect(file)) as db:
        db.execute(f"PRAGMA user_version = {number}")
    before = file.read_bytes()
    with pytest.raises(UserError, match=said):
        Store(tmp_path)
    assert file.read_bytes() == before and [path.name for path in tmp_path.iterdir()] == [FILE_NAME]


# The way to a later version, tried with a step that there is not

NEXT = max(STEPS) + 1
COUNT = 300_000
STEP = (
    "CREATE TABLE more (a); WITH RECURSIVE n (i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < "
    f"{COUNT}) INSERT INTO more SELECT i FROM n;"
)
MIGRATE = f"""
import sys
from pathlib import Path
from onedemo.storage import schema
from onedemo.storage.store import Store
schema.STEPS[{NEXT}] = "{STEP}"
print("now", flush=True)
Store(Path(sys.argv[1]))
"""


def _begun(directory):
    child = subprocess.Popen([sys.executable, "-c", MIGRATE, str(directory)], stdout=subprocess.PIPE)
    assert child.stdout.readline() == b"now\n"
    return child


@pytest.mark.slow
def test_a_migration_that_is_killed_leaves_a_whole_version(tmp_path, monkeypatch):
    """Killed at moments all over it, each database is of some version and goes on from there."""
    with _begun(_copy(tmp_path / "timed")) as child:
        began = time.monotonic()
        assert child.wait() == 0
        whole = time.monotonic() - began
    monkeypatch.setitem(STEPS, NEXT, STEP)
    seen = []
    for number in range(8):
        directory = _copy(tmp_path / f"{number}")
        with _begun(directory) as child:
            time.sleep(whole * (number + 0.5) / 8)
            child.send_signal(signal.SIGKILL)
        with closing(sqlite3.connect(directory / FILE_NAME)) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            seen += db.execute("PRAGMA user_version").fetchone()
            made = db.execute("SELECT 1 FROM sqlite_master WHERE name = 'more'").fetchone()
            assert (made is not None) == (seen[-1] == NEXT)
        with closing(Store(directory)) as store:
            assert store.database.rows("SELECT COUNT(*) FROM more") == [(COUNT,)]
            assert len(list(store.ratings.stream())) == 5
    assert NEXT - 1 in seen and set(seen) <= {NEXT - 1, NEXT}


@pytest.mark.parametrize("new", [True, False])
def test_a_directory_may_be_opened_by_several_at_once(stored, tmp_path, monkeypatch, new):
    monkeypatch.setitem(STEPS, NEXT, STEP)
    directory = tmp_path / "new" if new else stored
    stores, failures = [], []

    def open_it():
        try:
            stores.append(Store(directory))
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=open_it) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures and len(stores) == 4
    for store in stores:
        assert store.database.rows("PRAGMA user_version") == [(NEXT,)]
        assert store.database.rows("SELECT COUNT(*) FROM more") == [(COUNT,)]
        assert len(list(store.ratings.stream())) == (0 if new else 5)
        store.close()


def test_a_step_that_fails_leaves_the_database_as_it_was(stored, monkeypatch):
    monkeypatch.setitem(STEPS, NEXT, "CREATE TABLE half (a); CREATE TABLE raters (a);")
    before = read(stored / FILE_NAME)
    with closing(sqlite3.connect(stored / FILE_NAME, isolation_level=None)) as db:
        with pytest.raises(sqlite3.OperationalError, match="raters"):
            migrate(db)
        assert db.execute("PRAGMA user_version").fetchone() == (NEXT - 1,)
    assert read(stored / FILE_NAME) == before
