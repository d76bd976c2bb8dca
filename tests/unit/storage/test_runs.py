"""Runs in the database: what they are called, and their end."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest

from helpers.segments import noise
from onedemo.storage.clips import NewClip
from onedemo.storage.comparisons import NewPair
from onedemo.storage.schema import check_schema
from onedemo.storage.store import Store

OF_RUNS = (
    "runs",
    "clips",
    "segments",
    "events",
    "tallies",
    "pairs",
    "comparisons",
    "snapshots",
    "iterations",
)


@pytest.fixture
def store(tmp_path):
    """Two runs with something in every table."""
    rng = np.random.default_rng(0)
    with closing(Store(tmp_path)) as store:
        ann = store.accounts.ensure("Ann", "annotator").id
        for run in ("kept", "gone"):
            store.runs.add(run=run, demo="hop", demo_sha256="0", seed=0, config="", version="0")
            new = NewClip(demo_step=0, segment=noise(rng, 5), stage="pretrain", iteration=0)
            clips = [clip.id for clip in store.clips.add(run, [new] * 3)]
            store.ratings.rate(clips[0], ann, 4, 900)
            store.ratings.undo(clips[0], ann)
            store.ratings.rate(clips[0], ann, 2, 900)
            store.ratings.skip(clips[1], ann, 100)
            store.ratings.leave_out(run, ann, by=ann)
            pair = NewPair(
                demo_step=0, left=noise(rng, 5), right=noise(rng, 5), stage="pretrain", iteration=0
            )
            (made,) = store.comparisons.add_pairs(run, [pair])
            store.comparisons.compare(made.id, ann, "left", 50)
            store.runs.add_snapshot(run, 1, last_event=1, ratings=1, stats={})
            store.runs.add_iteration(run, 1, snapshot=1, env_steps=16000, stats={"predicted": 2.0})
        yield store


def counted(store):
    return {table: store.database.rows(f"SELECT COUNT(*) FROM {table}")[0][0] for table in OF_RUNS}


def test_of_a_deleted_run_nothing_is_left_and_of_the_others_all(store):
    before = counted(store)
    assert all(count % 2 == 0 and count for count in before.values())
    store.runs.delete("gone")
    assert counted(store) == {table: count // 2 for table, count in before.items()}
    assert [run["id"] for run in store.runs.all()] == ["kept"]
    assert store.ratings.by_class("kept") == [0, 1, 0, 0, 0]
    # Numbers of what is gone are not given again: an export may name them.
    rng = np.random.default_rng(1)
    new = NewClip(demo_step=0, segment=noise(rng, 5), stage="pretrain", iteration=0)
    assert store.clips.add("kept", [new])[0].id == 7


def test_events_stay_append_only(store):
    store.runs.delete("gone")
    check_schema(store.database._db)
    for table in ("events", "comparisons"):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"), store.database.transaction() as db:
            db.execute(f"DELETE FROM {table}")


def test_a_delete_that_fails_leaves_everything_and_the_guards(store):
    before = counted(store)
    with store.database.transaction() as db:
        db.execute("CREATE TABLE others (run TEXT REFERENCES runs (id))")
        db.execute("INSERT INTO others VALUES ('gone')")
    with pytest.raises(sqlite3.IntegrityError):
        store.runs.delete("gone")
    assert counted(store) == before
    with pytest.raises(sqlite3.IntegrityError, match="append-only"), store.database.transaction() as db:
        db.execute("DELETE FROM events")
