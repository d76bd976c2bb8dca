"""What the triggers keep is what the events say: after any presses, and after a migration."""

import io
import sqlite3
import threading
from contextlib import closing

import numpy as np
import pytest

from onedemo.storage import schema
from onedemo.storage.clips import NewClip
from onedemo.storage.database import FILE_NAME
from onedemo.storage.schema import STEPS, migrate
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
    store.database.rows("PRAGMA synchronous = OFF")  # thousands of commits
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
        store.database.rows(
            "INSERT INTO events (clip_id, rater_id, kind, value, snapshot, latency_ms, created_at)"
            " VALUES (?, ?, ?, ?, 0, 0, '')",
            (clips[int(rng.integers(4))].id, int(rng.integers(1, 3)), kind, value),
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


# Databases of the first version

_NPZ = io.BytesIO()
np.savez(_NPZ, obs=np.full((38, 11), 0.1), actions=np.ones((38, 3), "f4"), qpos=np.zeros((38, 6)),
         qvel=np.zeros((38, 6)))  # fmt: skip


def first_version(directory):
    """A database made by step 1 alone: two runs, three raters, ratings, skips, undos and second thoughts."""
    directory.mkdir(exist_ok=True)
    rng = np.random.default_rng(5)
    with closing(sqlite3.connect(directory / FILE_NAME)) as db:
        db.executescript(f"BEGIN; {STEPS[0]} PRAGMA user_version = 1; COMMIT;")
        for run in RUNS:
            db.execute("INSERT INTO runs VALUES (?, 'd', '0', 0, '', '0.1.0', '')", (run,))
        for name in ("Ann", "Bob", "Cy"):
            db.execute("INSERT INTO raters (name, role, created_at) VALUES (?, 'annotator', '')", (name,))
        for clip in range(1, 41):
            place = RUNS[clip % 2], ("pretrain", "online")[clip % 3 == 0], STATES[clip % 5 % 3]
            db.execute(
                "INSERT INTO clips (run, demo_step, steps, stage, iteration, snapshot, state, created_at)"
                " VALUES (?, 7, 38, ?, 0, 0, ?, '')",
                place,
            )
            db.execute("INSERT INTO segments VALUES (?, ?)", (clip, _NPZ.getvalue()))
        held = set()
        for _ in range(400):
            clip, rater = int(rng.integers(1, 31)), int(rng.integers(1, 4))  # ten clips nobody looked at
            kind = "undo" if (clip, rater) in held else ("rate", "rate", "skip")[int(rng.integers(3))]
            (held.discard if kind == "undo" else held.add)((clip, rater))
            value = int(rng.integers(1, 6)) if kind == "rate" else None
            db.execute(
                "INSERT INTO events (clip_id, rater_id, kind, value, snapshot, latency_ms, created_at)"
                " VALUES (?, ?, ?, ?, 0, 0, '')",
                (clip, rater, kind, value),
            )
        db.commit()
        return db.execute("SELECT * FROM ratings ORDER BY id").fetchall()


def test_a_database_of_the_first_version_is_migrated_with_all_it_holds(tmp_path):
    ratings = first_version(tmp_path)
    assert len(ratings) > 20
    with closing(Store(tmp_path)) as store:
        assert store.database.rows("PRAGMA user_version") == [(len(STEPS),)]
        assert [row[: len(ratings[0])] for row in store.ratings.stream()] == [tuple(row) for row in ratings]
        assert_kept_as_the_events_say(store)
        assert store.clips.segment(3).obs[0, 0] == 0.1 and store.clips.segment(3).actions.dtype == np.float32
        for clip in store.clips.waiting(RUNS[0]):
            store.ratings.rate(clip.id, 1, 5, latency_ms=1)
        store.ratings.undo(
            ratings[0][1], next(r.id for r in store.accounts.raters() if r.name == ratings[0][4])
        )
        assert_kept_as_the_events_say(store)
        assert store.database.rows("PRAGMA foreign_key_check") == []


def test_two_processes_may_open_an_old_database_at_once(tmp_path):
    first_version(tmp_path)
    stores, failures = [], []

    def open_it():
        try:
            stores.append(Store(tmp_path))
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=open_it) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures and len(stores) == 4
    for store in stores:
        assert_kept_as_the_events_say(store)
        store.close()


def test_a_step_that_fails_leaves_the_database_as_it_was(tmp_path, monkeypatch):
    first_version(tmp_path)
    monkeypatch.setattr(schema, "STEPS", (STEPS[0], "CREATE TABLE half (a); CREATE TABLE raters (a);"))
    with closing(sqlite3.connect(tmp_path / FILE_NAME, isolation_level=None)) as db:
        with pytest.raises(sqlite3.OperationalError, match="raters"):
            migrate(db)
        assert db.execute("PRAGMA user_version").fetchone() == (1,)
        assert not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'half'").fetchall()
