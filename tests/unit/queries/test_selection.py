from dataclasses import fields, replace

import numpy as np
import pytest

from onedemo.queries.selection import choose
from onedemo.types import Rollouts


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


# What a predictor says of the clips decides: the method's own choice


def test_a_round_is_a_mix_of_the_best_the_most_doubtful_and_any():
    """Lanes 0 to 9 are rated high, 10 to 19 doubted, of 100."""
    clock = np.tile(np.arange(400), (100, 1))

    def predict(lanes, starts, demo):
        return 5.0 * (lanes < 10) + 0.01 * starts, 1.0 * ((10 <= lanes) & (lanes < 20))

    shares = []
    for seed in range(5):
        chosen = choose(
            rollouts(clock), 20, 38, 400, np.random.default_rng(seed), any_time=True, predict=predict
        )
        assert len(chosen) == 20
        lanes = np.array([q.lane for q in chosen])
        assert (lanes[:8] < 10).all()  # 0.4 of 20 ...
        assert ((10 <= lanes[8:14]) & (lanes[8:14] < 20)).all()  # ... 0.3 ...
        shares.append((lanes[14:] >= 20).mean())  # ... and any, of which most lanes are neither
    assert np.mean(shares) > 0.6


def test_the_best_rated_come_first():
    clock = np.tile(np.arange(100), (30, 1))
    chosen = choose(
        rollouts(clock), 10, 38, 1000, np.random.default_rng(0), any_time=True,
        predict=lambda lanes, starts, demo: (demo / 1000.0, np.zeros(len(lanes))),
    )  # fmt: skip
    best = [q.demo_step for q in chosen[:4]]
    assert best == sorted(best, reverse=True) and best[0] > 940 and best[-1] > 900


def test_without_a_predictor_nothing_is_preferred():
    clock = np.tile(np.arange(400), (100, 1))
    chosen = choose(rollouts(clock), 300, 38, 400, np.random.default_rng(0), any_time=True)
    lanes = np.array([q.lane for q in chosen])
    counts, _ = np.histogram(lanes, bins=4, range=(0, 100))
    assert counts.min() > 40


def test_a_predictor_looks_at_some_clips_only_and_only_at_possible_ones():
    looked = []

    def predict(lanes, starts, demo):
        looked.append(len(lanes))
        assert demo.min() >= 0 and (demo + 38 <= 500).all() and starts.max() <= 1000 - 38
        return np.zeros(len(lanes)), np.zeros(len(lanes))

    clock = np.tile(np.arange(1000), (50, 1))
    for any_time in (True, False):
        choose(rollouts(clock), 10, 38, 500, np.random.default_rng(0), any_time=any_time, predict=predict)
    assert looked == [3000, 3000]


def test_any_time_pairs_clips_with_every_part_of_the_demo():
    """Though the robot's own clock never comes beyond 100."""
    clock = np.tile(np.arange(100), (40, 1))
    chosen = choose(rollouts(clock), 80, 38, 1000, np.random.default_rng(0), any_time=True)
    steps = np.array([q.demo_step for q in chosen])
    counts, _ = np.histogram(steps, bins=4, range=(0, 963))
    assert counts.min() > 8 and counts.sum() == 80
    assert np.corrcoef(steps, [q.start for q in chosen])[0, 1] < 0.5
    own = choose(rollouts(clock), 80, 38, 1000, np.random.default_rng(0))
    assert [q.demo_step for q in own] == [q.start for q in own]


def test_any_time_comes_to_the_demos_very_end_and_no_further():
    clock = np.tile(np.arange(100), (40, 1))
    chosen = choose(rollouts(clock), 200, 38, 42, np.random.default_rng(0), any_time=True)
    assert {q.demo_step for q in chosen} == {0, 1, 2, 3, 4}
    exact = choose(rollouts(clock), 5, 38, 38, np.random.default_rng(0), any_time=True)
    assert {q.demo_step for q in exact} == {0}


def loves_the_middle(lanes, starts, demo):
    return -np.abs(demo - 300.0), np.zeros(len(lanes))


def test_a_round_spreads_over_the_demo():
    clock = np.tile(np.arange(400), (60, 1))
    chosen = choose(
        rollouts(clock), 30, 38, 600, np.random.default_rng(0), any_time=True, predict=loves_the_middle
    )
    steps = np.array([q.demo_step for q in chosen])
    for i, step in enumerate(steps):
        assert (np.abs(steps[:i] - step) < 15).sum() < 2
    assert len(chosen) == 30 and np.abs(steps - 300).min() < 5


def test_where_the_demo_is_short_clips_crowd_before_they_overlap():
    clock = np.tile(np.arange(400), (16, 1))
    chosen = choose(
        rollouts(clock), 30, 38, 45, np.random.default_rng(0), any_time=True, predict=loves_the_middle
    )
    assert len(chosen) == 30
    for i, one in enumerate(chosen):
        assert all(one.lane != other.lane or abs(one.start - other.start) >= 38 for other in chosen[:i])


def test_beside_an_elastic_clock_the_middles_of_both_clips_meet():
    moves = np.random.default_rng(0).integers(0, 4, (20, 300))
    moves[:10] = np.minimum(moves[:10], 1)  # ten that are slow, and ten that come to about 450
    clock = np.cumsum(moves, axis=1) - moves
    chosen = choose(rollouts(clock), 300, 38, 420, np.random.default_rng(1))
    assert len(chosen) == 300
    early = late = 0
    for q in chosen:
        middle = clock[q.lane, q.start + 19]
        assert q.demo_step == max(0, middle - 19)
        assert 0 <= q.demo_step <= 420 - 38
        early, late = early + (middle < 19), late + (clock[q.lane, q.start + 37] > 400)
    assert early and late  # both ends of the demo were asked about


@pytest.mark.parametrize("kind", ["terminated", "truncated", "both"])
@pytest.mark.parametrize("judged", [False, True])
def test_no_clip_spans_the_end_of_an_episode(kind, judged):
    rng = np.random.default_rng(0)
    done = replace(rollouts(np.tile(np.arange(400), (20, 1))), truncated=rng.random((20, 400)) < 0.02)
    if kind != "truncated":
        done = replace(done, terminated=rng.random((20, 400)) < 0.02)
    if kind == "terminated":
        done = replace(done, truncated=np.zeros((20, 400), bool))
    predict = (lambda lanes, starts, demo: (-starts, starts)) if judged else None
    chosen = choose(done, 400, 38, 400, np.random.default_rng(1), any_time=True, predict=predict)
    assert len(chosen) > 100
    for q in chosen:
        done.segment(q.lane, q.start, 38)  # raises where a cut spans an end
    ended = done.terminated | done.truncated
    assert any(ended[q.lane, q.start + 37] for q in chosen)  # the last step of an episode may be the clip's


def test_the_same_generator_asks_the_same():
    clock = np.tile(np.arange(200), (10, 1))
    one, two, other = (
        choose(
            rollouts(clock), 20, 38, 600, np.random.default_rng(seed), any_time=True, predict=loves_the_middle
        )
        for seed in (3, 3, 4)
    )
    assert one == two != other


@pytest.mark.parametrize(("how", "score"), [("high", "rating"), ("disagreement", "doubt")])
def test_one_reason_alone_and_each_clip_knows_why(how, score):
    clock = np.tile(np.arange(400), (100, 1))
    told = {"rating": lambda lanes: 1.0 + lanes / 25, "doubt": lambda lanes: 1.0 - lanes / 100}

    def predict(lanes, starts, demo):
        return told["rating"](lanes), told["doubt"](lanes)

    chosen = choose(
        rollouts(clock), 12, 38, 400, np.random.default_rng(0), any_time=True, how=how, predict=predict
    )
    lanes = np.array([q.lane for q in chosen])
    assert {q.choice for q in chosen} == {how}
    assert [q.score for q in chosen] == told[score](lanes).tolist()
    assert (lanes > 80).all() if how == "high" else (lanes < 20).all()


def test_a_mix_says_of_each_clip_which_part_it_is_and_chance_has_no_score():
    clock = np.tile(np.arange(400), (100, 1))
    chosen = choose(
        rollouts(clock), 10, 38, 400, np.random.default_rng(0), any_time=True,
        predict=lambda lanes, starts, demo: (1.0 + lanes / 50, lanes / 100),
    )  # fmt: skip
    assert [q.choice for q in chosen] == ["high"] * 4 + ["disagreement"] * 3 + ["any"] * 3
    assert all((q.score is None) == (q.choice == "any") for q in chosen)
    plain = choose(rollouts(clock), 10, 38, 400, np.random.default_rng(0), how="uniform", predict=None)
    assert {(q.choice, q.score) for q in plain} == {("any", None)}
