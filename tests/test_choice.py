from dataclasses import fields

import numpy as np

from trainer.choice import choose
from trainer.records import Rollouts


def rollouts(clock):
    lanes, steps = clock.shape
    sizes = {"obs": 11, "actions": 3, "qpos": 6, "qvel": 6, "inputs": 4, "next_inputs": 4}
    arrays = {
        field.name: np.zeros((lanes, steps, sizes[field.name]) if field.name in sizes else (lanes, steps))
        for field in fields(Rollouts)
    }
    ends = np.zeros(clock.shape, bool)
    ends[:, :-1] = np.diff(clock, axis=1) < 0
    return Rollouts(**(arrays | {"clock": clock, "truncated": ends, "terminated": np.zeros_like(ends)}))


def test_clips_are_whole_time_aligned_and_inside_the_demo():
    # Lane 0 restarts at step 60; lane 1 runs towards the end of a demo of 300 steps.
    clock = np.stack([np.r_[np.arange(100, 160), np.arange(40)], np.arange(210, 310)])
    rng = np.random.default_rng(0)
    for question in choose(rollouts(clock), 500, 38, 300, rng):
        piece = clock[question.lane, question.start : question.start + 38]
        assert (np.diff(piece) == 1).all()
        assert question.demo_step == piece[0]
        assert piece[-1] < 300


def test_clips_do_not_overlap_while_there_is_room():
    clock = np.tile(np.arange(200), (4, 1))
    chosen = choose(rollouts(clock), 8, 38, 1000, np.random.default_rng(0))
    starts = [(q.lane, q.start) for q in chosen]
    assert len(chosen) == 8
    for lane, start in starts:
        others = [s for one, s in starts if one == lane and s != start]
        assert all(abs(start - other) >= 38 for other in others)


def test_more_than_fit_overlap_rather_than_fail():
    clock = np.arange(60)[None]
    assert len(choose(rollouts(clock), 10, 38, 1000, np.random.default_rng(0))) == 10
    assert len(choose(rollouts(clock), 100, 38, 1000, np.random.default_rng(0))) == 60 - 37


def test_nothing_to_cut():
    assert choose(rollouts(np.arange(20)[None]), 5, 38, 1000, np.random.default_rng(0)) == []


def test_all_parts_of_the_demo_are_asked_about():
    clock = np.tile(np.arange(1000), (16, 1))
    chosen = choose(rollouts(clock), 200, 38, 1000, np.random.default_rng(1))
    counts, _ = np.histogram([q.demo_step for q in chosen], bins=5, range=(0, 962))
    assert counts.min() > 20
