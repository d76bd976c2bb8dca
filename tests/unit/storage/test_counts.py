"""One definition of each count: the parts are the whole, and are what the events and the CSV say."""

import random
import sqlite3

import numpy as np
import pytest

from onedemo.storage.clips import NewClip
from onedemo.storage.rating_counts import Counts
from onedemo.storage.store import Store
from onedemo.types import Segment

ZEROS = {name: np.zeros((38, size)) for name, size in (("obs", 11), ("actions", 3), ("qpos", 6), ("qvel", 6))}
SEGMENT = Segment(**ZEROS)


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    store.database._db.execute("PRAGMA synchronous = OFF")
    for run in ("r", "other"):
        store.runs.add(run=run, demo="d", demo_sha256="0", seed=0, config="", version="0")
    yield store
    store.close()


def clips(store, count, run="r", stage="pretrain"):
    new = [NewClip(demo_step=0, segment=SEGMENT, stage=stage, iteration=0)] * count
    return [clip.id for clip in store.clips.add(run, new)]


def whole(store, run="r"):
    return sum(store.ratings.counts(run).values(), Counts())


def from_the_events(store, run="r"):
    """The same, worked out anew from the views and streams that exports read."""
    rows = list(store.database.rows("SELECT value, repeat, left_out FROM ratings WHERE run = ?", (run,)))
    used = [value for value, repeat, out in rows if not repeat and not out]
    return Counts(
        classes=tuple(used.count(value) for value in range(1, 6)),
        repeats=sum(repeat for _, repeat, _ in rows),
        excluded=sum(1 for _, repeat, out in rows if out and not repeat),
        skipped=len(list(store.ratings.stream_skips(run))),
        withdrawn=len(store.ratings.given(run, withdrawn=True, most=10**6)),
    )


def test_every_place_that_counts_agrees(store):
    """A study with repeats, an exclusion, a withdrawal, undos and skips; nothing is counted twice or lost."""
    ann, bob, ada = (store.accounts.ensure(name, role).id for name, role in (
        ("Ann", "annotator"), ("Bob", "annotator"), ("Ada", "researcher")))  # fmt: skip
    first = clips(store, 12)
    for number, clip in enumerate(first):
        store.ratings.rate(clip, ann, 1 + number % 5, 900)
    for clip in first[:3]:
        store.ratings.rate(clip, ann, 2, 900, repeat=True)
        store.ratings.rate(clip, bob, 4, 900)
    store.ratings.rate(first[3], bob, 5, 900)
    store.ratings.rate(first[3], bob, 5, 900, repeat=True)
    store.ratings.undo(first[3], bob, repeat=True)
    for clip in clips(store, 2):
        store.ratings.skip(clip, bob, 900)
    store.ratings.skip(clip, bob, 0, reason="too dark")  # the reason of a skip, no second one
    store.ratings.undo(first[11], ann)
    store.ratings.withdraw(store.ratings.given("r", rater="Ann")[-1].event, "by mistake", by=ada)
    store.ratings.leave_out("r", bob, by=ada)

    counts = store.ratings.counts("r")
    assert counts[ann] == Counts(classes=(2, 2, 2, 2, 2), repeats=3, withdrawn=1)
    assert counts[bob] == Counts(excluded=4, skipped=2)
    everything = whole(store)
    assert everything == from_the_events(store)
    assert everything.given == everything.used + everything.repeats + everything.excluded == 17
    assert everything.given == len(list(store.ratings.stream("r")))  # the CSV
    assert everything.given == len(store.ratings.given("r", most=10**6)) - everything.withdrawn
    assert everything.used == store.ratings.count_for_training("r") == len(store.ratings.for_training("r"))
    store.ratings.leave_out("r", bob, by=ada, left_out=False)
    assert store.ratings.counts("r")[bob].used == 4 and whole(store).excluded == 0
    assert whole(store, "other") == Counts()


def test_the_counts_follow_any_presses(store):
    """Asked again and again, they stay what they would be if they were worked out for the first time."""
    rng = random.Random(3)
    raters = [store.accounts.ensure(name, "annotator").id for name in ("Ann", "Bob", "Cy")]
    for run in ("r", "other"):
        clips(store, 6, run)
    for press in range(600):
        clip, rater, repeat = rng.randrange(1, 13), rng.choice(raters), rng.random() < 0.3
        try:
            match rng.choice(("rate", "rate", "skip", "undo", "withdraw", "exclude")):
                case "rate":
                    store.ratings.rate(clip, rater, rng.randrange(1, 6), 0, repeat=repeat)
                case "skip":
                    store.ratings.skip(clip, rater, 0, repeat=repeat, reason=rng.choice((None, "why")))
                case "undo":
                    store.ratings.undo(clip, rater, repeat=repeat)
                case "withdraw":
                    store.ratings.withdraw(rng.randrange(1, press + 2), "why")
                case "exclude":
                    store.ratings.leave_out("r", rater, by=raters[0], left_out=rng.random() < 0.5)
        except ValueError:
            continue
        if press % 7 == 0:
            for run in ("r", "other"):
                assert whole(store, run) == from_the_events(store, run)


def test_counting_costs_no_more_with_more_ratings(store):
    """A page asks at every press: SQLite's own steps are counted, not seconds."""
    ann = store.accounts.ensure("Ann", "annotator").id

    def steps():
        taken = [0]
        db: sqlite3.Connection = store.database._reader
        db.set_progress_handler(lambda: taken.__setitem__(0, taken[0] + 1), 1)
        store.ratings.counts("r")
        db.set_progress_handler(None, 0)
        return taken[0]

    def press_and_count(count):
        for clip in clips(store, count):
            store.ratings.rate(clip, ann, 3, 0)
        store.ratings.counts("r")
        store.ratings.rate(clips(store, 1)[0], ann, 3, 0)
        return steps()

    small = press_and_count(20)
    assert 20 < small and press_and_count(800) < 1.2 * small
