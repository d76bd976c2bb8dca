"""Which clip next: leases, and the rules of the Rate tab on a real store."""

from __future__ import annotations

import sqlite3

import numpy as np
import pytest

from app.assignment import Assignment, Lease, choose
from app.desk import Desk
from trainer.records import Segment
from trainer.store import NewClip, Store


def test_oldest_free_clip_first():
    leases = {1: Lease("a", 100.0)}
    assert choose([1, 2, 3], leases, holder="b", now=0.0) == [2, 3]
    assert choose([1, 2, 3], leases, holder="a", now=0.0) == [1, 2]
    assert choose([1, 2, 3], leases, holder="b", now=0.0, avoid={2}, count=1) == [3]
    assert choose([], leases, holder="b", now=0.0) == []


def test_lease_ends_after_two_minutes_or_with_the_page():
    assignment = Assignment()
    assert assignment.take("a", [1, 2], now=0.0) == [1, 2]
    assert assignment.take("b", [1, 2], now=119.0) == []
    assert assignment.take("b", [1, 2], now=120.0) == [1, 2]
    assignment.release("b")
    assert assignment.take("c", [1, 2], now=121.0) == [1, 2]


def test_asking_again_does_not_lengthen_a_lease():
    assignment = Assignment()
    assignment.take("a", [1], now=0.0)
    assignment.take("a", [1], now=100.0)
    assert assignment.take("b", [1], now=121.0) == [1]


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    store.add_run(run="r", demo="d", demo_sha256="0", seed=0, config="", version="0")
    yield store
    store.close()


def add_clips(store, count):
    zeros = np.zeros((3, 1))
    segment = Segment(obs=zeros, actions=zeros, qpos=zeros, qvel=zeros)
    clips = store.add_clips("r", [NewClip(demo_step=0, segment=segment, stage="online", iteration=1)] * count)
    store.set_clip_state([clip.id for clip in clips], "ready")
    return [clip.id for clip in clips]


class Clock:
    def __init__(self):
        self.now = 10.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def desk(store, clock):
    desk = Desk(store, "r", store.ensure_rater("bo", "annotator"), Assignment(), "page", clock)
    add_clips(store, 3)
    desk.refill()
    return desk


def test_rating_is_in_the_database_before_the_next_clip(desk, store, clock):
    assert (desk.current, desk.upcoming) == (1, 2)
    clock.now += 1.5
    assert desk.rate(1, 4)
    assert (desk.current, desk.upcoming) == (2, 3)
    assert [(row[1], row[5], row[9]) for row in store.iter_ratings()] == [(1, 4, 1500)]


def test_press_for_another_clip_or_too_soon_counts_for_nothing(desk, store, clock):
    assert not desk.rate(1, 4)  # No 0.3 s since it came.
    clock.now += 0.31
    assert not desk.rate(2, 4)  # Not the one on screen.
    assert desk.rate(1, 4)
    assert not desk.rate(1, 4)
    assert not desk.rate(2, 4)  # The held key's next repeat.
    assert store.ratings_by_class() == [0, 0, 0, 1, 0]


def test_undo_brings_clips_back_one_by_one(desk, store, clock):
    for clip in (1, 2):
        clock.now += 1
        desk.rate(clip, 5)
    assert desk.undo()
    assert (desk.current, desk.upcoming) == (2, 3)
    assert desk.undo()
    assert desk.current == 1
    assert not desk.undo()
    clock.now += 1
    assert desk.rate(1, 2)
    assert (desk.current, desk.upcoming) == (2, 3)
    assert store.ratings_by_class() == [0, 1, 0, 0, 0]


def test_skip_moves_on_without_a_rating(desk, store, clock):
    clock.now += 1
    assert desk.skip(1)
    assert desk.current == 2
    assert store.ratings_by_class() == [0] * 5
    assert desk.undo()
    assert desk.current == 1


def test_clip_stays_if_the_rating_cannot_be_saved(desk, store, clock, monkeypatch):
    def fail(*_):
        raise sqlite3.OperationalError("disk is full")

    clock.now += 1
    with monkeypatch.context() as patch:
        patch.setattr(store, "rate", fail)
        with pytest.raises(sqlite3.OperationalError):
            desk.rate(1, 3)
    assert desk.current == 1
    assert desk.rate(1, 3)


def test_waiting_desk_takes_clips_when_they_come(store, clock):
    desk = Desk(store, "r", store.ensure_rater("bo", "annotator"), Assignment(), "page", clock)
    assert not desk.refill()
    assert desk.current is None
    first, second = add_clips(store, 2)
    assert desk.refill()
    assert (desk.current, desk.upcoming) == (first, second)


def test_two_raters_never_see_the_same_clip(store, clock):
    assignment = Assignment()
    desks = [
        Desk(store, "r", store.ensure_rater(name, "annotator"), assignment, name, clock)
        for name in ("bo", "cy")
    ]
    add_clips(store, 6)
    seen = []
    for _ in range(3):
        for desk in desks:
            desk.refill()
            clock.now += 1
            seen.append(desk.current)
            desk.rate(desk.current, 1)
    assert sorted(seen) == sorted(set(seen))
    desks[0].close()
