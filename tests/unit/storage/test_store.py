import sqlite3
import subprocess
import sys
import threading

import numpy as np
import pytest

from onedemo.errors import UserError
from onedemo.storage.clips import NewClip
from onedemo.storage.database import FILE_NAME
from onedemo.storage.rating_records import RATING_COLUMNS
from onedemo.storage.schema import STEPS
from onedemo.storage.store import Store
from onedemo.types import Segment


def segment(value=0.0):
    return Segment(
        obs=np.full((38, 11), value),
        actions=np.full((38, 3), value + 1),
        qpos=np.full((38, 6), value + 2),
        qvel=np.full((38, 6), value + 3),
    )


def new_clip(**changes):
    known = {"demo_step": 7, "segment": segment(), "stage": "pretrain", "iteration": 0}
    return NewClip(**(known | changes))


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    store.runs.add(run="r", demo="d", demo_sha256="00", seed=0, config="", version="0")
    yield store
    store.close()


@pytest.fixture
def clips(store):
    clips = store.clips.add("r", [new_clip(segment=segment(i), predicted=2.5, snapshot=3) for i in range(3)])
    store.clips.set_state([c.id for c in clips], "ready")
    return clips


@pytest.fixture
def ann(store):
    return store.accounts.ensure("Ann", "annotator")


def test_a_rating_is_a_row_of_the_documented_view(store, clips, ann):
    event = store.ratings.rate(clips[0].id, ann.id, 4, latency_ms=812)
    row = dict(zip(RATING_COLUMNS, *store.ratings.stream(), strict=True))
    created = row.pop("created_at")
    assert created.endswith("Z") and created.startswith("20")
    assert row == {
        "id": event, "clip_id": clips[0].id, "run": "r", "demo": "d", "rater": "Ann", "value": 4,
        "stage": "pretrain", "iteration": 0, "latency_ms": 812, "snapshot": 3, "predicted": 2.5,
        "demo_step": 7, "steps": 38, "repeat": 0, "mark_start": None, "mark_end": None, "choice": "",
        "score": None, "left_out": 0,
    }  # fmt: skip


def test_another_program_reads_the_view(store, clips, ann):
    store.ratings.rate(clips[1].id, ann.id, 2, latency_ms=1)
    with sqlite3.connect(store.path) as other:
        assert other.execute("SELECT clip_id, value FROM ratings").fetchall() == [(clips[1].id, 2)]
    other.close()


def test_durability_settings(store):
    assert store.database.rows("PRAGMA journal_mode") == [("wal",)]
    assert store.database._db.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL


@pytest.mark.parametrize("value", [0, 6, 2.5, "3", None, True, float("nan")])
def test_only_whole_numbers_from_1_to_5(store, clips, ann, value):
    with pytest.raises(ValueError, match="whole number from 1 to 5"):
        store.ratings.rate(clips[0].id, ann.id, value, latency_ms=1)
    assert sum(store.ratings.by_class()) == 0


def test_a_clip_is_rated_once_per_rater(store, clips, ann):
    store.ratings.rate(clips[0].id, ann.id, 4, latency_ms=1)
    with pytest.raises(ValueError, match="rated already"):
        store.ratings.rate(clips[0].id, ann.id, 5, latency_ms=1)
    bob = store.accounts.ensure("Bob", "annotator")
    store.ratings.rate(clips[0].id, bob.id, 5, latency_ms=1)
    assert store.ratings.by_class("r") == [0, 0, 0, 1, 1]


def test_a_rating_of_no_clip_is_refused(store, ann):
    with pytest.raises(ValueError, match="no clip 99"):
        store.ratings.rate(99, ann.id, 3, latency_ms=1)


def test_events_cannot_be_changed_or_removed(store, clips, ann):
    store.ratings.rate(clips[0].id, ann.id, 4, latency_ms=1)
    for sql in ("UPDATE events SET value = 1", "DELETE FROM events"):
        with (
            pytest.raises(sqlite3.IntegrityError, match="append-only"),
            store.database.transaction() as db,
        ):
            db.execute(sql)
    assert store.ratings.by_class() == [0, 0, 0, 1, 0]


def test_undo_brings_the_clip_back_and_keeps_the_event(store, clips, ann):
    store.ratings.rate(clips[0].id, ann.id, 4, latency_ms=1)
    assert [c.id for c in store.clips.waiting("r")] == [clips[1].id, clips[2].id]
    store.ratings.undo(clips[0].id, ann.id)
    assert [c.id for c in store.clips.waiting("r")] == [c.id for c in clips]
    with pytest.raises(ValueError, match="nothing to take back"):
        store.ratings.undo(clips[0].id, ann.id)
    store.ratings.rate(clips[0].id, ann.id, 5, latency_ms=1)
    assert store.ratings.by_class() == [0, 0, 0, 0, 1]
    assert store.database.rows("SELECT COUNT(*) FROM events") == [(3,)]


def test_a_skipped_clip_does_not_wait_and_is_no_rating(store, clips, ann):
    store.ratings.skip(clips[0].id, ann.id, latency_ms=1)
    assert clips[0].id not in [c.id for c in store.clips.waiting("r")]
    assert sum(store.ratings.by_class()) == 0


def test_withdrawn_and_uncut_clips_do_not_wait(store, clips):
    store.clips.set_state([clips[0].id], "withdrawn")
    store.clips.set_state([clips[1].id], "cut")
    assert [c.id for c in store.clips.waiting("r")] == [clips[2].id]


def test_training_set_as_of_an_event(store, clips, ann):
    first = store.ratings.rate(clips[0].id, ann.id, 4, latency_ms=1)
    second = store.ratings.rate(clips[1].id, ann.id, 2, latency_ms=1)
    store.ratings.undo(clips[0].id, ann.id)
    assert [r.value for r in store.ratings.for_training("r", as_of=first)] == [4]
    assert [r.value for r in store.ratings.for_training("r", as_of=second)] == [4, 2]
    assert [r.value for r in store.ratings.for_training("r")] == [2]
    assert store.ratings.for_training("r") == [(second, clips[1].id, 7, 2, None)]
    np.testing.assert_array_equal(store.clips.segment(clips[1].id).obs, segment(1).obs)


def test_newer_predictions_reach_the_rating(store, clips, ann):
    store.clips.set_predictions(9, {clips[0].id: 4.5})
    store.ratings.rate(clips[0].id, ann.id, 4, latency_ms=1)
    row = dict(zip(RATING_COLUMNS, *store.ratings.stream(), strict=True))
    assert (row["snapshot"], row["predicted"]) == (9, 4.5)


def test_tokens_are_of_a_kind_and_can_be_revoked(store, ann):
    store.accounts.add_token("aa", ann.id, "link")
    assert store.accounts.rater_of("aa", "link") == ann
    assert store.accounts.rater_of("aa", "session") is None
    assert store.accounts.revoke_tokens(ann.id) == 1
    assert store.accounts.rater_of("aa", "link") is None


def test_a_name_has_one_role(store, ann):
    assert store.accounts.ensure("Ann", "annotator") == ann
    with pytest.raises(UserError, match="exists already as annotator"):
        store.accounts.ensure("Ann", "researcher")


def test_everything_is_there_after_reopening(store, clips, ann, tmp_path):
    store.ratings.rate(clips[0].id, ann.id, 4, latency_ms=1)
    store.runs.add_iteration("r", 1, snapshot=2, env_steps=100, stats={"kl": 0.5})
    store.runs.add_snapshot("r", 2, last_event=1, ratings=1, stats={"loss": 0.1})
    store.close()
    again = Store(tmp_path)
    assert again.ratings.by_class("r") == [0, 0, 0, 1, 0]
    assert again.runs.iterations("r") == [{"number": 1, "snapshot": 2, "env_steps": 100, "kl": 0.5}]
    assert again.runs.snapshots("r") == [{"number": 2, "last_event": 1, "ratings": 1, "loss": 0.1}]
    again.close()


def test_many_threads_rate_at_once(store, ann):
    clips = store.clips.add("r", [new_clip() for _ in range(40)])

    def work(part):
        for clip in part:
            store.ratings.rate(clip.id, ann.id, 3, latency_ms=1)

    threads = [threading.Thread(target=work, args=(clips[i::4],)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.ratings.by_class("r") == [0, 0, 40, 0, 0]


def test_a_newer_database_is_left_alone(tmp_path):
    Store(tmp_path).close()
    with sqlite3.connect(tmp_path / FILE_NAME) as db:
        db.execute(f"PRAGMA user_version = {max(STEPS) + 1}")
    db.close()
    before = (tmp_path / FILE_NAME).read_bytes()
    with pytest.raises(UserError, match="newer onedemo"):
        Store(tmp_path)
    assert (tmp_path / FILE_NAME).read_bytes() == before


def test_a_directory_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="not writable"):
        Store(tmp_path / "file" / "data")


def test_a_file_that_is_no_database(tmp_path):
    (tmp_path / FILE_NAME).write_text("not a database, not at all " * 100)
    with pytest.raises(UserError, match="cannot be opened"):
        Store(tmp_path)


_RATE_AND_DIE = """
import os, sys
from pathlib import Path
from onedemo.storage.store import Store
store = Store(Path(sys.argv[1]))
for clip in range(1, 1000):
    store.ratings.rate(clip, 1, 3, latency_ms=1)
    print(clip, flush=True)
"""


@pytest.mark.seam
def test_acknowledged_ratings_survive_kill_9(store, ann, tmp_path):
    store.clips.add("r", [new_clip() for _ in range(1000)])
    store.close()
    child = subprocess.Popen(
        [sys.executable, "-c", _RATE_AND_DIE, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    acknowledged = [int(child.stdout.readline()) for _ in range(60)]
    child.kill()
    acknowledged += [int(line) for line in child.stdout.read().split()]
    child.stdout.close()
    child.wait()
    again = Store(tmp_path)
    kept = [row[1] for row in again.ratings.stream()]
    assert set(acknowledged) <= set(kept) and len(kept) == len(set(kept))
    assert again.database.rows("PRAGMA integrity_check") == [("ok",)]
    again.close()


def row_of(store):
    return [dict(zip(RATING_COLUMNS, row, strict=True)) for row in store.ratings.stream()]


def test_where_it_goes_wrong_is_kept_with_the_rating(store, clips, ann):
    store.ratings.rate(clips[0].id, ann.id, 2, 900, mark=(13, 25))
    (row,) = row_of(store)
    assert (row["mark_start"], row["mark_end"]) == (0.104, 0.2)  # seconds
    (rating,) = store.ratings.for_training("r")
    assert (rating.value, rating.mark) == (2, (13, 25))
    for mark in ((2, 2), (3, 1), (-1, 1), (0, 39)):
        with pytest.raises(ValueError, match="stretch of the clip"):
            store.ratings.rate(clips[1].id, ann.id, 2, 900, mark=mark)
    assert len(row_of(store)) == 1


def test_a_reason_may_follow_a_skip(store, clips, ann):
    store.ratings.skip(clips[0].id, ann.id, 900)
    with pytest.raises(ValueError, match="rated already"):
        store.ratings.skip(clips[0].id, ann.id, 900)
    store.ratings.skip(clips[0].id, ann.id, 900, reason="nothing to see")
    with pytest.raises(ValueError, match="rated already"):
        store.ratings.skip(clips[0].id, ann.id, 900, reason="again")
    with pytest.raises(ValueError, match="1 to 200 characters"):
        store.ratings.skip(clips[1].id, ann.id, 900, reason="x" * 201)
    assert store.database.rows("SELECT reason FROM events ORDER BY id") == [(None,), ("nothing to see",)]
    assert [c.id for c in store.clips.waiting("r")] == [clips[1].id, clips[2].id]
    store.ratings.undo(clips[0].id, ann.id)
    assert len(store.clips.waiting("r")) == 3
    store.ratings.rate(clips[0].id, ann.id, 3, 900)
    with pytest.raises(ValueError, match="rated already"):
        store.ratings.skip(clips[0].id, ann.id, 900, reason="too late")


def test_a_second_opinion_stands_beside_the_first_and_is_not_learned_from(store, clips, ann):
    first = store.ratings.rate(clips[0].id, ann.id, 2, 900)
    store.ratings.rate(clips[0].id, ann.id, 4, 900, repeat=True)
    with pytest.raises(ValueError, match="rated already"):
        store.ratings.rate(clips[0].id, ann.id, 4, 900, repeat=True)
    assert [(row["value"], row["repeat"]) for row in row_of(store)] == [(2, 0), (4, 1)]
    assert [rating.event for rating in store.ratings.for_training("r")] == [first]
    assert store.ratings.by_class("r") == [0, 1, 0, 0, 0]
    store.ratings.undo(clips[0].id, ann.id, repeat=True)
    assert [(row["value"], row["repeat"]) for row in row_of(store)] == [(2, 0)]
    assert [(a.clip, a.kind, a.repeat) for a in store.ratings.answered("r")] == [
        (clips[0].id, "undo", True), (clips[0].id, "rate", False),
    ]  # fmt: skip


def test_any_rating_is_withdrawn_with_a_reason_and_nothing_learns_from_it(store, clips, ann):
    ada, bob = store.accounts.ensure("Ada", "researcher"), store.accounts.ensure("Bob", "annotator")
    first, others = store.ratings.rate(clips[0].id, ann.id, 5, 900), clips[1].id
    store.ratings.rate(others, ann.id, 2, 900)
    shared = store.ratings.rate(others, bob.id, 4, 900)
    second = store.ratings.rate(clips[2].id, ann.id, 3, 900)
    before = store.ratings.last_event()
    withdrawn = store.ratings.withdraw(first, " fell asleep ", by=ada.id)
    assert withdrawn[:4] == (first, clips[0].id, "Ann", 5)
    store.ratings.withdraw(shared, "another browser")
    held = [rating.event for rating in store.ratings.for_training("r")]
    assert first not in held and shared not in held and len(held) == 2
    assert len(store.ratings.for_training("r", before)) == 4  # what was fitted then can be fitted again
    assert store.ratings.by_class("r") == [0, 1, 1, 0, 0] and store.ratings.count_for_training("r") == 2
    assert [row[0] for row in store.ratings.stream()] == held
    # Nobody is asked that clip again; one that somebody else has rated stays.
    assert clips[0].id not in [clip.id for clip in store.clips.waiting("r")]
    assert store.ratings.last_answer("r", ann.id).clip == clips[2].id
    listed = store.ratings.given("r")
    assert [row.event for row in listed] == [second, shared, second - 2, first]
    assert (listed[3].withdrawn, listed[3].by) == ("fell asleep", "Ada") and listed[0].withdrawn is None
    assert [row.event for row in store.ratings.given("r", rater="Ann", before=second)] == [second - 2, first]
    assert store.ratings.given("r", withdrawn=True) == [listed[1], listed[3]]
    for event, reason, words in (
        (first, "again", "does not hold any more"), (10**6, "x", "there is no rating"),
        (before + 1, "an undo", "there is no rating"), (second, "  ", "a reason is one line"),
        (second, "a\nb", "a reason is one line"), (second, "x" * 201, "a reason is one line"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            store.ratings.withdraw(event, reason)
    assert store.ratings.last_event() == before + 2


def test_a_rater_is_left_out_and_taken_in_again_and_every_event_can_be_gone_back_to(store, clips, ann):
    bob, ada = store.accounts.ensure("Bob", "annotator"), store.accounts.ensure("Ada", "researcher")
    mine = store.ratings.rate(clips[0].id, ann.id, 2, 900)
    his = store.ratings.rate(clips[0].id, bob.id, 5, 900)
    out = store.ratings.leave_out("r", bob.id, by=ada.id)
    assert out == store.ratings.last_event() and store.ratings.left_out("r") == {bob.id}
    later = store.ratings.rate(clips[1].id, bob.id, 5, 900)
    back = store.ratings.leave_out("r", bob.id, by=ada.id, left_out=False)

    def learned(event=None):
        return [rating.event for rating in store.ratings.for_training("r", event)]

    assert learned(his) == [mine, his]
    assert learned(out) == learned(later) == [mine]
    assert learned(back) == learned() == [mine, his, later]
    assert store.ratings.left_out("r") == set()
    store.ratings.leave_out("r", bob.id, by=ada.id)
    assert [(row["rater"], row["left_out"]) for row in row_of(store)] == [("Ann", 0), ("Bob", 1), ("Bob", 1)]
    assert sum(store.ratings.by_class("r")) == 3  # nothing is deleted
    store.runs.add(run="q", demo="d", demo_sha256="00", seed=0, config="", version="0")
    assert store.ratings.left_out("q") == set()


def test_who_has_practised(store, clips, ann):
    bob = store.accounts.ensure("Bob", "annotator")
    assert not store.accounts.has_practised(ann.id)
    store.accounts.set_practised(ann.id)
    assert store.accounts.has_practised(ann.id) and not store.accounts.has_practised(bob.id)
    store.ratings.skip(clips[0].id, bob.id, 900)
    assert store.accounts.has_practised(bob.id)
