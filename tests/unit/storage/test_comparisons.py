"""Pairs: which of two clips is nearer. Store, rules of the tab, how they are made, what learns."""

import csv
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from helpers.small_world import falling_demo, falling_states, small_config
from onedemo.app.annotation.assignment import Assignment
from onedemo.app.annotation.comparison_session import ComparisonSession
from onedemo.app.annotation.rating_session import AnsweredElsewhere
from onedemo.app.cli.main import main
from onedemo.app.dataset.columns import COMPARISONS
from onedemo.baselines.preferences import PreferencesConfig, stored_comparisons, train_preferences
from onedemo.errors import UserError
from onedemo.render.clip_image import read_about
from onedemo.render.render_thread import RenderThread
from onedemo.render.renderer import CloseUp
from onedemo.robots.registry import robot_named
from onedemo.storage.comparisons import COMPARISON_COLUMNS, NewPair
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.training.comparison_queue import ComparisonQueue, draw_pairs
from onedemo.training.learner import Learner
from onedemo.training.pictures import PictureFiles
from onedemo.types import Segment
from unit.queries.test_selection import rollouts
from unit.training.test_trainer import wait_for


def segment(value=0.0, steps=38):
    sizes = {"obs": 11, "actions": 3, "qpos": 6, "qvel": 6}
    return Segment(**{name: np.full((steps, size), value) for name, size in sizes.items()})


@pytest.fixture
def store(tmp_path):
    with closing(Store(tmp_path)) as store:
        store.runs.add(run="r", demo="d", demo_sha256="0", seed=0, config="", version="0")
        yield store


@pytest.fixture
def pairs(store):
    new = [
        NewPair(demo_step=7 * i, left=segment(i), right=segment(-i), stage="online", iteration=3)
        for i in range(4)
    ]
    ids = [pair.id for pair in store.comparisons.add_pairs("r", new)]
    store.comparisons.set_pair_state(ids, "ready")
    return ids


def test_answers_hold_until_they_are_taken_back(store, pairs):
    ann, bob = (store.accounts.ensure(name, "annotator").id for name in ("Ann", "Bob"))
    store.comparisons.compare(pairs[0], ann, "left", 900)
    store.comparisons.compare(pairs[1], ann, "skip", 900)
    store.comparisons.compare(pairs[2], bob, "equal", 900)
    assert [p.id for p in store.comparisons.waiting_pairs("r")] == [pairs[3]]
    with pytest.raises(ValueError, match="answered already"):
        store.comparisons.compare(pairs[0], ann, "right", 900)
    store.comparisons.compare(pairs[0], ann, "undo", 0)
    with pytest.raises(ValueError, match="nothing to take back"):
        store.comparisons.compare(pairs[0], ann, "undo", 0)
    store.comparisons.compare(pairs[0], ann, "right", 700)
    rows = [dict(zip(COMPARISON_COLUMNS, row, strict=True)) for row in store.comparisons.stream("r")]
    assert [(row["pair_id"], row["rater"], row["answer"]) for row in rows] == [
        (pairs[2], "Bob", "equal"), (pairs[0], "Ann", "right"),
    ]  # fmt: skip
    assert store.comparisons.count("r") == 2 and store.comparisons.count("other") == 0
    bob_skips = store.comparisons.compare(pairs[1], bob, "skip", 800)
    with pytest.raises(ValueError, match="answered already"):
        store.comparisons.compare(pairs[1], bob, "skip", 800)
    assert store.comparisons.compare(pairs[1], bob, "skip", 0, reason="too dark") > bob_skips
    for answer, reason in (("skip", "again"), ("left", "why"), ("skip", ""), ("skip", "x" * 201)):
        with pytest.raises(ValueError, match=r"answered already|a reason is"):
            store.comparisons.compare(pairs[1], bob, answer, 0, reason=reason)
    assert store.comparisons.last_compared("r", bob) == (pairs[1], "skip")
    store.comparisons.compare(pairs[1], bob, "undo", 0)
    assert store.comparisons.last_compared("r", bob) == (pairs[2], "equal")
    reasons = [
        row[10] for row in store.comparisons.stream_history("r") if row[2] == pairs[1] and row[4] == "Bob"
    ]
    assert reasons == [None, "too dark", None]
    for answer in ("both", "", None):
        with pytest.raises(ValueError, match="left, right, equal"):
            store.comparisons.compare(pairs[3], ann, answer, 0)
    with pytest.raises(ValueError, match="no pair 99"):
        store.comparisons.compare(99, ann, "left", 0)
    for change in ("UPDATE comparisons SET answer = 'left'", "DELETE FROM comparisons"):
        with (
            pytest.raises(sqlite3.IntegrityError, match="append-only"),
            store.database.transaction() as db,
        ):
            db.execute(change)
    left, right = store.comparisons.pair_segments(pairs[1])
    assert left.qpos[0, 0] == 1 and right.qpos[0, 0] == -1


class Clock:
    now = 10.0

    def __call__(self):
        return self.now


def test_the_desk_of_pairs_has_the_rules_of_that_of_clips(store, pairs):
    clock, assignment = Clock(), Assignment()
    bo, cy = (
        ComparisonSession(store, "r", store.accounts.ensure(name, "annotator"), assignment, name, clock=clock)
        for name in ("bo", "cy")
    )
    bo.refill()
    cy.refill()
    assert (bo.current, bo.upcoming, cy.current, cy.upcoming) == tuple(pairs)
    assert not bo.answer(pairs[0], "left")  # too soon
    clock.now += 0.4
    assert not bo.answer(pairs[1], "left")  # not on screen
    assert bo.answer(pairs[0], "left") and bo.current == pairs[1] and bo.upcoming is None
    clock.now += 0.4
    assert bo.answer(pairs[1], "skip") and bo.current is None
    assert not bo.undo(pairs[0])  # not the last one
    assert bo.undoable == pairs[1] and bo.undo(pairs[1]) and bo.current == pairs[1]
    assert bo.undo(pairs[0]) and bo.current == pairs[0]
    assert bo.upcoming == pairs[1] and bo.undoable is None and not bo.undo(pairs[0])
    clock.now += 0.4
    assert bo.answer(pairs[0], "right") and bo.current == pairs[1]
    cy.close()
    clock.now += 0.4
    assert bo.answer(pairs[1], "equal") and bo.current == pairs[2]


def test_the_reason_for_a_skipped_pair_may_be_said_until_the_next_press(store, pairs):
    clock, ann = Clock(), store.accounts.ensure("ann", "annotator")
    here, there = (ComparisonSession(store, "r", ann, Assignment(), page, clock=clock) for page in (1, 2))
    here.refill()
    clock.now += 1
    assert not here.explain(pairs[0], "not skipped")
    assert here.answer(pairs[0], "skip") and here.skipped == pairs[0]
    assert not here.explain(pairs[1], "dark") and here.explain(pairs[0], "dark") and here.explained
    assert not here.explain(pairs[0], "again")
    clock.now += 1
    assert here.answer(pairs[1], "skip") and not here.explained
    assert there.undo(pairs[1]) and not here.explain(pairs[1], "it was taken back elsewhere")
    clock.now += 1
    assert here.answer(pairs[2], "left") and here.skipped is None
    said = store.database.rows("SELECT pair_id, answer, reason FROM comparisons ORDER BY id")
    assert said == [
        (pairs[0], "skip", None), (pairs[0], "skip", "dark"), (pairs[1], "skip", None),
        (pairs[1], "undo", None), (pairs[2], "left", None),
    ]  # fmt: skip


def test_nobody_waits_for_themselves_and_what_was_fetched_ahead_is_asked_for_again(store, pairs):
    clock, assignment = Clock(), Assignment()
    bo, cy = (store.accounts.ensure(name, "annotator") for name in ("bo", "cy"))
    gone = ComparisonSession(store, "r", bo, assignment, 1, clock=clock)
    gone.refill()  # and its line breaks without a word
    back = ComparisonSession(store, "r", bo, assignment, 2, clock=clock)
    other = ComparisonSession(store, "r", cy, assignment, 3, clock=clock)
    other.refill()
    assert (other.current, other.upcoming) == (pairs[2], pairs[3])
    back.refill()
    assert (back.current, back.upcoming) == (pairs[0], pairs[1])
    clock.now += 200
    late = ComparisonSession(store, "r", store.accounts.ensure("di", "annotator"), assignment, 4, clock=clock)
    late.refill()
    assert (late.current, late.upcoming) == (pairs[0], pairs[1])  # the leases have ended
    assert back.answer(pairs[0], "left") and back.current not in (pairs[0], pairs[1])


def test_a_pair_that_was_compared_at_another_page_of_the_same_person_is_let_go(store, pairs):
    clock, assignment = Clock(), Assignment()
    bo = store.accounts.ensure("bo", "annotator")
    laptop, phone = (
        ComparisonSession(store, "r", bo, assignment, page, clock=clock) for page in ("laptop", "phone")
    )
    laptop.refill()
    clock.now += 121  # the lease has ended
    phone.refill()
    clock.now += 1
    assert phone.current == laptop.current == pairs[0] and phone.answer(pairs[0], "left")
    with pytest.raises(AnsweredElsewhere, match="on another page"):
        laptop.answer(pairs[0], "right")
    moved_to = laptop.current
    assert moved_to not in (None, pairs[0]) and laptop.undoable == pairs[0]
    clock.now += 1
    assert laptop.answer(moved_to, "equal")
    assert [(row[1], row[5]) for row in store.comparisons.stream()] == [
        (pairs[0], "left"),
        (moved_to, "equal"),
    ]


def test_pairs_are_beside_one_moment_of_the_demo_and_no_clip_is_in_two():
    clock = np.tile(np.arange(200), (16, 1)) + 10 * np.arange(16)[:, None]
    whole = rollouts(clock)
    rng = np.random.default_rng(0)
    for any_time in (False, True):
        drawn = draw_pairs(whole, 6, 38, 1000, rng, any_time=any_time)
        assert len(drawn) == 6
        places = [place for _, left, right in drawn for place in (left, right)]
        assert len(set(places)) == 12
        for demo_step, left, right in drawn:
            assert 0 <= demo_step <= 1000 - 38
            if not any_time:
                for lane, start in (left, right):
                    assert abs(clock[lane, start] - demo_step) <= 8
    assert draw_pairs(whole, 0, 38, 1000, rng, any_time=True) == []


@pytest.mark.seam
def test_pairs_are_made_and_drawn_while_somebody_looks(store, tmp_path):
    import cv2

    demo = falling_demo(tmp_path / "demo")
    learner = Learner(small_config(), demo.frames, demo.fps)
    with RenderThread() as drawing:
        pictures = PictureFiles(drawing, demo, robot_named("hopper"))
        queue = ComparisonQueue(store, "r", RunDirectory(tmp_path, "r").pair, pictures, seed=0)
        queue.fill(learner, learner.random_rollouts())
        assert store.comparisons.waiting_pairs("r", "cut") == []  # nobody looks
        queue.want()
        queue.fill(learner, None)
        queue.fill(learner, learner.random_rollouts())
        drawing.submit(lambda renderer: None).result()
        wait_for(lambda: len(store.comparisons.waiting_pairs("r")) == 6)
        ready = store.comparisons.waiting_pairs("r")
        picture = cv2.imread(str(RunDirectory(tmp_path, "r").pair(ready[0].id)))
        about = read_about(RunDirectory(tmp_path, "r").pair(ready[0].id).read_bytes())
        _, *sides = about["sides"]
        assert len(sides) == 2 and sides[0]["width"] == sides[1]["width"]
        robots = [picture[:540, side["at"] : side["at"] + 720].astype(int) for side in sides]
        assert np.abs(robots[0] - robots[1]).max() > 60
        left, _ = store.comparisons.pair_segments(ready[0].id)
        _, first = np.unique(
            learner.frames_of(ready[0].demo_step + np.arange(ready[0].steps)), return_index=True
        )
        close = CloseUp(width=720, height=540, scale=720 / sides[0]["width"], bottom=sides[0]["bottom"])
        seen = left.qpos[first], np.array(sides[0]["eye"]), close
        drawn = drawing.submit(lambda renderer: renderer.close_ups(*seen)).result()[0]
        apart = [np.abs(robot[..., ::-1] - drawn.astype(int)).mean() for robot in robots]
        assert apart[0] < 2 < apart[1]  # the left one is on the left
        queue.fill(learner, learner.random_rollouts())
        assert len(store.comparisons.waiting_pairs("r")) == 6  # the queue is full

        # A process that died: one pair answered, one without its picture, one with a damaged one, one that
        # was still to be drawn.
        answered, lost, damaged, *rest = (pair.id for pair in ready)
        content = bytearray(RunDirectory(tmp_path, "r").pair(damaged).read_bytes())
        content[len(content) // 2] ^= 1
        RunDirectory(tmp_path, "r").pair(damaged).write_bytes(content)
        store.comparisons.compare(answered, store.accounts.ensure("Ann", "annotator").id, "left", 900)
        RunDirectory(tmp_path, "r").pair(lost).unlink()
        new = NewPair(demo_step=0, left=segment(), right=segment(), stage="pretrain", iteration=0)
        undrawn = store.comparisons.add_pairs("r", [new])[0].id
        after = ComparisonQueue(store, "r", RunDirectory(tmp_path, "r").pair, pictures, seed=0)
        after.want()
        after.fill(learner, learner.random_rollouts())
        drawing.submit(lambda renderer: None).result()
        wait_for(lambda: len(store.comparisons.waiting_pairs("r")) == 6)
        waiting = [pair.id for pair in store.comparisons.waiting_pairs("r")]
        assert waiting[:3] == rest and len(waiting) == 6 and min(waiting[3:]) > undrawn
        assert all(RunDirectory(tmp_path, "r").pair(pair).exists() for pair in waiting)
        assert store.comparisons.waiting_pairs("r", "cut") == [] and store.comparisons.count("r") == 1


def test_a_policy_learns_from_what_people_compared(store):
    states = falling_states()
    rater = store.accounts.ensure("Ann", "annotator").id
    rng = np.random.default_rng(0)
    cuts = [int(t) for t in rng.integers(0, 200, size=40)]

    def cut(t):
        noise = rng.normal(size=(38, 11)) * 0.1
        return Segment(
            obs=states.obs[t : t + 38] + noise, actions=np.zeros((38, 3)), qpos=states.qpos[t : t + 38],
            qvel=states.qpos[t : t + 38],
        )  # fmt: skip

    new = [
        NewPair(demo_step=0, left=cut(a), right=cut(b), stage="pretrain", iteration=0)
        for a, b in zip(cuts[::2], cuts[1::2], strict=True)
    ]
    for pair, (a, b) in zip(
        store.comparisons.add_pairs("r", new), zip(cuts[::2], cuts[1::2], strict=True), strict=True
    ):
        store.comparisons.compare(pair.id, rater, "left" if a > b else "right", 900)
    given = stored_comparisons(store, "r")
    assert [c.preference for c in given] == [float(a > b) for a, b in zip(cuts[::2], cuts[1::2], strict=True)]
    config = PreferencesConfig(
        steps=2000, lanes=4, batch=250, horizon=250, threads=1, evaluate_every=9, segment_seconds=0.3
    )
    trained = train_preferences(config, given=given, progress=False)
    assert trained.curve[-1].comparisons == len(given) == 20
    late, early = (
        trained.reward.rewards(states.obs[t][None], np.zeros((1, 38, 3))).mean() for t in (LATE, EARLY)
    )
    assert late > early
    for run, words in (("none", "there are: r"), ("q", "nobody has compared")):
        if run == "q":
            store.runs.add(run="q", demo="d", demo_sha256="0", seed=0, config="", version="0")
        with pytest.raises(UserError, match=words):
            stored_comparisons(store, run)


EARLY, LATE = slice(0, 38), slice(200, 238)


def test_comparisons_are_exported(store, pairs, tmp_path):
    store.comparisons.compare(pairs[0], store.accounts.ensure("=Ann", "annotator").id, "left", 900)
    out = tmp_path / "pairs.csv"
    assert main(["export", "--data-dir", str(store.path.parent), "--comparisons", str(out)]) == 0
    with out.open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert tuple(row) == tuple(COMPARISONS) == COMPARISON_COLUMNS
    assert (row["answer"], row["rater"], row["steps"]) == ("left", "'=Ann", "38")
