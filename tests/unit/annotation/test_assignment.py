"""Which clip next: leases, and the rules of the Rate tab on a real store."""

from __future__ import annotations

import random
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from onedemo.app.annotation.assignment import REPEAT_AFTER, Again, Assignment, to_repeat, to_share
from onedemo.app.annotation.rating_session import AnsweredElsewhere, RatingSession
from onedemo.config import RatingsConfig, RunConfig
from onedemo.storage.clips import NewClip
from onedemo.storage.rating_records import Answered
from onedemo.storage.store import Store
from onedemo.training.rating_queue import RatingQueue
from onedemo.types import Demo, Segment


def test_the_first_free_clip_is_leased_and_stays_with_its_page():
    assignment = Assignment()
    assert assignment.take("a", [1, 2, 3], now=0.0) == 1
    assert assignment.take("b", [1, 2, 3], now=0.0) == 2
    assert assignment.take("a", [1, 2, 3], now=0.0) == 1
    assert assignment.take("a", [1, 2, 3], now=0.0, avoid=(1,)) == 3
    assert assignment.take("c", [1, 2, 3], now=0.0) is None
    assignment.release("a", 3)
    assert assignment.take("c", [1, 2, 3], now=0.0) == 3
    assert assignment.take("c", [], now=0.0) is None


def test_lease_ends_after_two_minutes_or_with_the_page():
    assignment = Assignment()
    assert assignment.take("a", [1], now=0.0) == 1
    assert assignment.take("b", [1], now=119.0) is None
    assert assignment.take("b", [1], now=120.0) == 1
    assignment.release("b")
    assert assignment.take("c", [1], now=121.0) == 1


def test_asking_again_does_not_lengthen_a_lease():
    assignment = Assignment()
    assignment.take("a", [1], now=0.0)
    assignment.take("a", [1], now=100.0)
    assert assignment.take("b", [1], now=121.0) == 1


def test_shared_are_clips_of_others_with_the_fewest_raters_first():
    answers = [Answered(4, 1, "skip", False)]
    answers += [Answered(1, rater, "rate", False) for rater in (2, 3, 4)]  # enough people
    answers += [Answered(2, rater, "rate", False) for rater in (2, 3)]
    answers += [Answered(3, 2, "rate", False), Answered(4, 2, "rate", False), Answered(5, 2, "skip", False)]
    answers += [Answered(6, 1, "rate", False), Answered(7, 2, "rate", False), Answered(7, 1, "undo", False)]
    assert to_share(answers, 1) == [3, 7, 2]
    assert to_share(answers, 5) == [3, 4, 6, 7, 2]


def test_repeated_are_own_clips_of_some_time_ago_once():
    mine = [Answered(clip, 1, "rate", False) for clip in range(20, 0, -1)]  # newest first
    assert to_repeat(mine, 1) == [1, 2, 3, 4, 5]
    assert to_repeat(mine, 2) == []
    mine[-1] = Answered(1, 1, "skip", False)
    assert to_repeat([Answered(2, 1, "rate", True), *mine], 1) == [3, 4, 5]
    assert to_repeat(mine[:REPEAT_AFTER], 1) == []


@pytest.mark.parametrize("share", [-0.1, 0.6, float("nan")])
def test_shares_are_shares(share):
    with pytest.raises(ValueError, match=r"0\.\.0\.5"):
        Again(shared=share)


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    store.runs.add(run="r", demo="d", demo_sha256="0", seed=0, config="", version="0")
    yield store
    store.close()


def add_clips(store, count):
    zeros = np.zeros((3, 1))
    segment = Segment(obs=zeros, actions=zeros, qpos=zeros, qvel=zeros)
    clips = store.clips.add("r", [NewClip(demo_step=0, segment=segment, stage="online", iteration=1)] * count)
    store.clips.set_state([clip.id for clip in clips], "ready")
    return [clip.id for clip in clips]


DEMO = Demo(name="d", sha256="0", path=Path(), fps=100.0, frames=240, width=9, height=9)


class Clock:
    def __init__(self):
        self.now = 10.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def make_desk(store, clock, name="bo", assignment=None, holder=None, **more):
    assignment = assignment or Assignment(again=Again(shared=0, repeated=0))
    rater = store.accounts.ensure(name, "annotator")
    return RatingSession(
        store, "r", rater, assignment, holder or name, dt=0.01, demo=DEMO, clock=clock, **more
    )


@pytest.fixture
def session(store, clock):
    session = make_desk(store, clock)
    add_clips(store, 3)
    session.refill()
    return session


def test_rating_is_in_the_database_before_the_next_clip(session, store, clock):
    assert (session.current, session.upcoming) == (1, 2)
    clock.now += 1.5
    assert session.rate(1, 4)
    assert (session.current, session.upcoming) == (2, 3)
    assert [(row[1], row[5], row[9]) for row in store.ratings.stream()] == [(1, 4, 1500)]


def test_press_for_another_clip_or_too_soon_counts_for_nothing(session, store, clock):
    assert not session.rate(1, 4)  # No 0.3 s since it came.
    clock.now += 0.31
    assert not session.rate(2, 4)  # Not the one on screen.
    assert session.rate(1, 4)
    assert not session.rate(1, 4)
    assert not session.rate(2, 4)  # The held key's next repeat.
    assert store.ratings.by_class() == [0, 0, 0, 1, 0]


def test_undo_brings_clips_back_one_by_one(session, store, clock):
    for clip in (1, 2):
        clock.now += 1
        session.rate(clip, 5)
    assert not session.undo(1)  # not the last one
    assert session.undoable == 2 and session.undo(2)
    assert (session.current, session.upcoming) == (2, 3)
    assert not session.undo(2)  # sent twice
    assert session.undo(1)
    assert session.current == 1
    assert session.undoable is None and not session.undo(1)
    clock.now += 1
    assert session.rate(1, 2)
    assert (session.current, session.upcoming) == (2, 3)
    assert store.ratings.by_class() == [0, 1, 0, 0, 0]


def test_skip_moves_on_without_a_rating(session, store, clock):
    clock.now += 1
    assert session.skip(1)
    assert session.current == 2
    assert store.ratings.by_class() == [0] * 5
    assert session.undo(1)
    assert session.current == 1 and session.taken_back.value is None


def test_how_soon_a_press_may_come_is_a_setting(store, clock):
    session = make_desk(store, clock, guard_seconds=0.05)
    add_clips(store, 2)
    session.refill()
    assert not session.rate(1, 4)
    clock.now += 0.06
    assert session.rate(1, 4)


def test_clip_stays_if_the_rating_cannot_be_saved(session, store, clock, monkeypatch):
    def fail(*_, **__):
        raise sqlite3.OperationalError("disk is full")

    clock.now += 1
    with monkeypatch.context() as patch:
        patch.setattr(store.ratings, "rate", fail)
        with pytest.raises(sqlite3.OperationalError):
            session.rate(1, 3)
    assert session.current == 1
    assert session.rate(1, 3)


def test_waiting_desk_takes_clips_when_they_come(store, clock):
    session = make_desk(store, clock)
    assert not session.refill()
    assert session.current is None
    first, second = add_clips(store, 2)
    assert session.refill()
    assert (session.current, session.upcoming) == (first, second)


def test_two_raters_never_see_the_same_clip(store, clock):
    assignment = Assignment(again=Again(shared=0, repeated=0))
    sessions = [make_desk(store, clock, name, assignment) for name in ("bo", "cy")]
    add_clips(store, 6)
    seen = []
    for _ in range(3):
        for session in sessions:
            session.refill()
            clock.now += 1
            seen.append(session.current)
            session.rate(session.current, 1)
    assert sorted(seen) == sorted(set(seen))
    sessions[0].close()


def test_a_mark_is_of_the_clip_that_is_rated_and_comes_back_when_it_is_taken_back(session, store, clock):
    clock.now += 1
    for mark in ((2, 1), (2, 9), (-1, 2)):
        with pytest.raises(ValueError, match="3 pictures"):
            session.rate(1, 2, mark)
    assert session.current == 1
    assert session.rate(1, 2, (0, 2)) and session.mark is None
    clock.now += 1
    assert session.rate(2, 3)
    assert [row[15:17] for row in store.ratings.stream()] == [(0.0, 0.016), (None, None)]
    assert session.undo(2) and session.mark is None
    assert session.undo(1) and session.mark == (0, 2)


def test_the_reason_for_a_skip_may_be_said_until_the_next_press(session, store, clock):
    clock.now += 1
    session.skip(1)
    assert not session.skip(2) and session.skipped == 1  # too soon
    assert not session.explain(2, "dark") and session.explain(1, "dark") and not session.explain(1, "again")
    assert session.explained
    clock.now += 1
    session.skip(2)
    assert not session.explained
    clock.now += 1
    session.rate(3, 3)
    assert not session.explain(2, "too late")
    assert store.database.rows("SELECT clip_id, reason FROM events WHERE kind = 'skip' ORDER BY id") == [
        (1, None), (1, "dark"), (2, None),
    ]  # fmt: skip


def test_what_was_rated_may_be_taken_back_at_another_page_and_after_a_restart(store, clock):
    add_clips(store, 4)
    first = make_desk(store, clock)
    first.refill()
    for clip in (1, 2):
        clock.now += 1
        first.rate(clip, 5, (0, 1))
    first.close()
    other = make_desk(store, clock, "cy")
    other.refill()
    assert other.undoable is None and not other.undo(2)  # what others said stays
    again = make_desk(store, clock)
    again.refill()
    assert again.current == 3 and again.undo(2) and (again.current, again.upcoming) == (2, 3)
    assert again.mark == (0, 1) and again.taken_back.value == 5
    with closing(Store(store.path.parent)) as later:
        restarted = make_desk(later, clock)
        restarted.refill()
        assert restarted.undoable == 1 and restarted.undo(1)
        assert restarted.undoable is None
    assert store.ratings.by_class() == [0] * 5


class Always:
    """Draws one kind."""

    def __init__(self, kind):
        self.kind = kind

    def choices(self, kinds, weights):
        return [self.kind]


def test_a_shared_clip_is_rated_by_the_second_person_too_and_both_count(store, clock):
    assignment = Assignment()
    add_clips(store, 3)
    bo = make_desk(store, clock, "bo", assignment, rng=Always("fresh"))
    bo.refill()
    clock.now += 1
    bo.rate(1, 4)
    cy = make_desk(store, clock, "cy", assignment, rng=Always("shared"))
    cy.refill()
    assert cy.current == 1
    clock.now += 1
    assert cy.rate(1, 5)
    assert [(row[1], row[4], row[5]) for row in store.ratings.stream()] == [(1, "bo", 4), (1, "cy", 5)]
    assert [rating.value for rating in store.ratings.for_training("r")] == [4, 5]
    assert cy.current is None  # bo holds the other two, and nothing else is shared


def test_shared_clips_do_not_lead_beyond_what_was_asked_for(store, clock):
    target, queue, assignment = 24, 4, Assignment()

    def wanted():
        return target - store.ratings.count_for_training("r")

    people = [
        make_desk(store, clock, name, assignment, rng=Always("shared"), wanted=wanted)
        for name in ("ann", "bo", "cy")
    ]
    for _ in range(target):  # each time as the trainer does it: what waits and what is there are the target
        if (missing := min(queue, wanted()) - len(store.clips.waiting("r"))) > 0:
            add_clips(store, missing)
        clock.now += 1
        for person in people:
            person.refill()
            clock.now += 1
            if person.current is not None:
                assert person.rate(person.current, 3)
    assert store.ratings.count_for_training("r") == target
    assert len({row[1] for row in store.ratings.stream()}) < target  # and some were shared
    assert all(person.current is None for person in people)


def test_a_rating_that_is_given_again_after_undo_withdraws_no_clip(store, clock):
    add_clips(store, 3)
    person = make_desk(store, clock, "ann", Assignment(), wanted=lambda: 0)  # whatever waits is too much
    person.refill()
    for back in (True, False):
        clip = person.current
        clock.now += 1
        assert person.rate(clip, 3)
        assert len(store.clips.waiting("r")) == 2
        clock.now += 1
        assert not back or person.undo(clip)


def test_a_repeated_clip_is_a_second_opinion_that_undo_takes_back(store, clock):
    add_clips(store, REPEAT_AFTER + 3)
    rng = Always("fresh")
    session = make_desk(store, clock, assignment=Assignment(), rng=rng)
    session.refill()
    for _ in range(REPEAT_AFTER + 1):
        rng.kind = "repeated"  # too early, but once
        clock.now += 1
        session.rate(session.current, 4)
    assert session.current == REPEAT_AFTER + 2 and session.upcoming == 1
    clock.now += 1
    session.rate(session.current, 4)
    assert session.current == 1
    clock.now += 1
    assert session.rate(1, 2)
    rows = [(row[1], row[5], row[14]) for row in store.ratings.stream()]
    assert rows[0] == (1, 4, 0) and rows[-1] == (1, 2, 1)
    assert session.undoable == 1 and session.undo(1) and session.current == 1
    assert [(row[1], row[5], row[14]) for row in store.ratings.stream()] == rows[:-1]


def test_shares_of_what_is_asked_again_are_as_set():
    rng = random.Random(1)
    kinds = [Again(shared=0.1, repeated=0.05).draw(rng) for _ in range(20_000)]
    assert kinds.count("shared") / kinds.count("fresh") == pytest.approx(0.1, abs=0.01)
    assert kinds.count("repeated") / kinds.count("fresh") == pytest.approx(0.05, abs=0.01)


def test_as_many_clips_come_to_several_people_and_twice_to_one_as_are_meant_to(store, clock):
    store.database._db.execute("PRAGMA synchronous = OFF")
    add_clips(store, 400)
    assignment = Assignment()
    sessions = [
        make_desk(store, clock, name, assignment, rng=random.Random(seed))
        for seed, name in enumerate(("bo", "cy", "di"))
    ]
    while store.clips.waiting("r"):
        for session in sessions:
            session.refill()
            clock.now += 1
            if session.current is not None:
                assert session.rate(session.current, 3)
    rows = [(row[1], row[4], row[14]) for row in store.ratings.stream()]
    firsts = [(clip, rater) for clip, rater, repeat in rows if not repeat]
    repeats = [(clip, rater) for clip, rater, repeat in rows if repeat]
    assert len({clip for clip, _ in firsts}) == 400 and len(set(firsts)) == len(firsts)
    assert (len(firsts) - 400) / 400 == pytest.approx(0.10, abs=0.045)
    assert len(repeats) / 400 == pytest.approx(0.04, abs=0.03)
    assert set(repeats) <= set(firsts) and len(set(repeats)) == len(repeats)


def test_clips_that_nobody_rated_in_time_are_taken_back(store):
    ids = add_clips(store, 3)  # all of iteration 1
    store.ratings.rate(ids[0], store.accounts.ensure("bo", "annotator").id, 4, 900)
    config = RunConfig(ratings=RatingsConfig(stale_iterations=10))
    asking = RatingQueue(store, "r", config, None)
    asking.withdraw_stale(11)
    assert [clip.id for clip in store.clips.waiting("r")] == ids[1:]
    asking.withdraw_stale(12)
    assert store.clips.waiting("r") == [] and [row[1] for row in store.ratings.stream()] == ids[:1]


def test_while_nothing_fresh_waits_nothing_is_asked_again(store, clock):
    assignment = Assignment()
    add_clips(store, 1)
    bo = make_desk(store, clock, "bo", assignment, rng=Always("fresh"))
    bo.refill()
    clock.now += 1
    bo.rate(1, 4)
    cy = make_desk(store, clock, "cy", assignment, rng=Always("shared"))
    for _ in range(20):
        assert not cy.refill() and cy.current is None
    add_clips(store, 2)
    cy.refill()
    assert cy.current == 1


def test_a_clip_that_was_rated_at_another_page_of_the_same_person_is_let_go(store, clock):
    add_clips(store, 6)
    assignment = Assignment(again=Again(shared=0, repeated=0))
    first, second = (make_desk(store, clock, "bo", assignment, holder) for holder in ("desk", "phone"))
    first.refill()
    clock.now += 121  # the lease has ended
    second.refill()
    assert second.current == first.current == 1
    clock.now += 1
    assert second.rate(1, 4)
    with pytest.raises(AnsweredElsewhere, match="on another page"):
        first.rate(1, 2)
    assert first.current != 1
    clock.now += 1
    assert first.rate(first.current, 3)
    assert [row[5] for row in store.ratings.stream()] == [4, 3]


def test_repeats_come_however_many_others_rate(store, clock):
    ids = add_clips(store, 60)
    rater = store.accounts.ensure("bo", "annotator").id
    for clip in ids[:20]:
        store.ratings.rate(clip, rater, 3, 900)
    for number in range(20):
        other = store.accounts.ensure(f"other {number}", "annotator").id
        for clip in ids[20:50]:
            store.ratings.rate(clip, other, 3, 900)
    session = make_desk(store, clock, "bo", Assignment(), rng=Always("repeated"))
    session.refill()
    assert session.current == ids[0]


def test_what_has_no_picture_is_not_taken_back(session, store, clock):
    """Clips of an import are rated, and cannot be shown."""
    clock.now += 1
    assert session.rate(1, 4) and session.undoable == 1
    store.clips.set_state([1], "withdrawn")
    assert session.undoable is None and not session.undo(1)
    assert [row[1] for row in store.ratings.stream()] == [1]


def test_why_the_last_clip_was_skipped_may_be_said_while_nothing_waits(store, clock):
    add_clips(store, 1)
    session = make_desk(store, clock)
    session.refill()
    clock.now += 1
    assert session.skip(1) and session.current is None
    session.refill()
    assert session.skipped == 1 and session.explain(1, "too dark")
    assert [row[5] for row in store.ratings.stream_skips()] == ["too dark"]


def test_a_skip_that_was_taken_back_elsewhere_is_not_explained(store, clock):
    add_clips(store, 1)
    first, second = make_desk(store, clock), make_desk(store, clock)
    first.refill()
    clock.now += 1
    assert first.skip(1) and second.undo(1)
    assert not first.explain(1, "too dark")
    clock.now += 1
    assert second.rate(1, 4)


def test_an_answer_counts_where_no_next_clip_can_be_looked_for(session, store, clock, monkeypatch):
    clock.now += 1
    with monkeypatch.context() as patch:
        patch.setattr(store.clips, "waiting", lambda *_: (_ for _ in ()).throw(sqlite3.OperationalError()))
        assert session.rate(1, 4) and session.current is None
    assert session.refill() and session.current == 2


def test_leases_of_clips_that_have_gone_are_forgotten():
    """At a page that stays open for weeks, whose clips were withdrawn before it came to them."""
    leases = Assignment(lease_seconds=10)
    for clip in range(5000):
        assert leases.take("page", [clip], now=float(clip)) == clip
    assert len(leases._leases) <= 1001
    assert leases.take("other", [4999], now=5000.0) is None  # one that holds, still holds
