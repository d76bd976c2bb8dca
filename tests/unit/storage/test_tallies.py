"""What the triggers keep is what the events say, after any presses."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest

from onedemo.storage.clips import NewClip
from onedemo.storage.store import Store
from onedemo.types import Segment

RUNS = ("first", "second")
STATES = ("cut", "ready", "withdrawn")

# The full queries that were asked at every press before there were triggers.
_HOLDS = (
    "NOT EXISTS (SELECT 1 FROM events l WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id"
    " AND l.id > e.id)"
)
_WAITING = (
    "SELECT id FROM clips c WHERE run = ? AND state = ? AND NOT EXISTS ("
    f" SELECT 1 FROM events e WHERE e.clip_id = c.id AND e.kind != 'undo' AND {_HOLDS}) ORDER BY id"
)
_TALLIES = "SELECT rater, stage, value, COUNT(*) FROM ratings WHERE run = ? GROUP BY rater, stage, value"
_ANSWERS = (
    "SELECT c.id, (SELECT COUNT(*) FROM events e WHERE e.clip_id = c.id AND e.kind != 'undo'"
    f" AND {_HOLDS}) FROM clips c ORDER BY c.id"
)


def assert_kept_as_the_events_say(store):
    with closing(sqlite3.connect(store.path)) as db:
        for run in RUNS:
            truth = {}
            for rater, stage, value, count in db.execute(_TALLIES, (run,)):
                truth.setdefault((rater, stage), [0] * 5)[value - 1] = count
            assert store.ratings.tallies(run) == truth
            assert store.ratings.by_class(run) == [sum(row[v] for row in truth.values()) for v in range(5)]
            for state in STATES:
                waiting = [clip for (clip,) in db.execute(_WAITING, (run, state))]
                assert [clip.id for clip in store.clips.waiting(run, state)] == waiting
            (clips,) = db.execute("SELECT COUNT(*) FROM clips WHERE run = ?", (run,)).fetchone()
            assert store.clips.count(run) == clips
        answers = db.execute(_ANSWERS).fetchall()
        assert db.execute("SELECT id, answers FROM clips ORDER BY id").fetchall() == answers
        assert sum(store.ratings.by_class()) == db.execute("SELECT COUNT(*) FROM ratings").fetchone()[0]


def add_clips(store, run, count, stage):
    rows = np.zeros((38, 11)), np.zeros((38, 3)), np.zeros((38, 6)), np.zeros((38, 6))
    segment = Segment(**dict(zip(("obs", "actions", "qpos", "qvel"), rows, strict=True)))
    return store.clips.add(run, [NewClip(demo_step=0, segment=segment, stage=stage, iteration=0)] * count)


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    store.database._db.execute("PRAGMA synchronous = OFF")  # thousands of commits
    for run in RUNS:
        store.runs.add(run=run, demo="d", demo_sha256="0", seed=0, config="", version="0")
    yield store
    store.close()


@pytest.mark.parametrize("seed", [0, 1])
def test_after_thousands_of_presses_of_several_raters(store, seed):
    rng = np.random.default_rng(seed)
    raters = [store.accounts.ensure(name, "annotator").id for name in ("Ann", "Bob", "Cy", "'; DROP TABLE")]
    clips, done = [], {"rate": 0, "skip": 0, "undo": 0, "refused": 0}
    for step in range(3000):
        if step % 60 == 0:
            clips += add_clips(store, RUNS[int(rng.integers(2))], 3, ("pretrain", "online")[step % 120 // 60])
            assert_kept_as_the_events_say(store)
        clip, rater = clips[int(rng.integers(len(clips)))].id, raters[int(rng.integers(4))]
        kind = ("rate", "rate", "skip", "undo", "undo", "state")[int(rng.integers(6))]
        try:
            if kind == "rate":
                store.ratings.rate(clip, rater, int(rng.integers(1, 6)), latency_ms=1)
            elif kind == "skip":
                store.ratings.skip(clip, rater, latency_ms=1)
            elif kind == "undo":
                store.ratings.undo(clip, rater)
            else:
                store.clips.set_state([clip], STATES[int(rng.integers(3))])
                continue
        except ValueError:  # rated already, or nothing to take back
            kind = "refused"
        done[kind] += 1
    assert min(done.values()) > 100, done
    assert_kept_as_the_events_say(store)


def test_after_events_that_the_store_would_refuse(store):
    """Another program may write a second rating over a first, or an undo of nothing."""
    rng = np.random.default_rng(3)
    for name in ("Ann", "Bob"):
        store.accounts.ensure(name, "annotator")
    clips = add_clips(store, RUNS[0], 2, "pretrain") + add_clips(store, RUNS[1], 2, "online")
    for _ in range(300):
        kind = ("rate", "skip", "undo")[int(rng.integers(3))]
        value = int(rng.integers(1, 6)) if kind == "rate" else None
        row = (clips[int(rng.integers(4))].id, int(rng.integers(1, 3)), kind, value)
        with store.database.transaction() as db:
            db.execute(
                "INSERT INTO events (clip_id, rater_id, kind, value, snapshot, latency_ms, created_at)"
                " VALUES (?, ?, ?, ?, 0, 0, '')",
                row,
            )
        assert_kept_as_the_events_say(store)


def test_a_press_that_fails_counts_for_nothing(store):
    ann = store.accounts.ensure("Ann", "annotator")
    (clip,) = add_clips(store, RUNS[0], 1, "pretrain")
    with pytest.raises(RuntimeError), store.database.transaction() as db:
        db.execute(
            "INSERT INTO events (clip_id, rater_id, kind, value, snapshot, latency_ms, created_at)"
            " VALUES (?, ?, 'rate', 4, 0, 0, '')",
            (clip.id, ann.id),
        )
        raise RuntimeError
    assert sum(store.ratings.by_class()) == 0
    assert_kept_as_the_events_say(store)
