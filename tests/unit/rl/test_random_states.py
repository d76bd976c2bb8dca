import numpy as np
import pytest

from onedemo.rl.random_states import HeldNoise, RandomStarts, random_states, wild_rollouts
from onedemo.robots.hopper import clearances

RANGES = np.radians([[-150, 0], [-150, 0], [-45, 45]])  # of thigh, leg and foot, hopper.xml


def test_random_states_are_what_the_robot_can_be_in_and_show_all_of_it():
    qpos, qvel = random_states(2000, np.random.default_rng(0))
    assert qpos.shape == qvel.shape == (2000, 6) and not qpos[:, 0].any()
    slack = 0.06  # radians: the joints' stops are soft
    assert (qpos[:, 3:] > RANGES[:, 0] - slack).all() and (qpos[:, 3:] < RANGES[:, 1] + slack).all()
    assert np.minimum.reduce(list(clearances(qpos).values())).min() > -0.06  # hardly in the ground
    headings, _ = np.histogram(qpos[:, 2], bins=8, range=(-np.pi, np.pi))
    assert headings.min() > 100 and headings.sum() == 2000
    heights, _ = np.histogram(qpos[:, 1], bins=4, range=(0, 2))
    assert heights.min() > 50 and heights.sum() == 2000
    assert (np.quantile(np.abs(qvel), 0.9, axis=0) > 2).all()
    assert (np.abs(qvel[:, 2]) > 8).mean() > 0.05  # faster than a backflip needs


def test_random_states_follow_their_seed_and_none_is_none():
    one, two, other = (random_states(20, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)
    assert [x.shape for x in random_states(0, np.random.default_rng(0))] == [(0, 6), (0, 6)]


@pytest.mark.parametrize(("standing", "least", "most"), [(0.0, 0, 0), (0.25, 60, 140), (1.0, 400, 400)])
def test_a_share_of_the_lanes_starts_standing(standing, least, most):
    starts = RandomStarts(standing).start(np.arange(400), np.random.default_rng(0))
    assert least <= 400 - len(starts.lanes) <= most
    assert len(starts.qpos) == len(starts.qvel) == len(starts.clock) == len(starts.lanes)
    assert not starts.clock.any()


def test_wild_rollouts_start_anew_all_the_time_and_run_their_time():
    rollouts = wild_rollouts("hopper", lanes=16, steps=60, every=20, seed=3, nthread=0)
    assert np.flatnonzero(rollouts.truncated.all(axis=0)).tolist() == [19, 39, 59]
    assert rollouts.truncated.sum() == 3 * 16 and not rollouts.terminated.any()
    np.testing.assert_array_equal(rollouts.clock, np.tile(np.arange(60) % 20, (16, 1)))
    first = rollouts.qpos[:, ::20, 2].ravel()
    assert np.ptp(first) > 5 and len(np.unique(first)) == 48  # any heading, another one each time
    assert np.isfinite(rollouts.qpos).all() and np.abs(rollouts.qvel).max() < 100  # nothing explodes


def test_wild_rollouts_are_those_of_their_seed_whatever_computes_them():
    one, two, other = (
        wild_rollouts("hopper", lanes=8, steps=30, every=10, seed=seed, nthread=threads)
        for seed, threads in ((1, 0), (1, 2), (2, 0))
    )
    np.testing.assert_array_equal(one.qpos, two.qpos)
    np.testing.assert_array_equal(one.actions, two.actions)
    assert (one.qpos[:, 0] != other.qpos[:, 0]).any()


def test_standing_starts_are_the_environments_own():
    rollouts = wild_rollouts("hopper", lanes=8, steps=20, every=10, seed=0, standing=1.0, nthread=0)
    np.testing.assert_allclose(rollouts.qpos[:, [0, 10], 1:], [[[1.25, 0, 0, 0, 0]] * 2] * 8, atol=6e-3)


def test_noise_is_held_and_ends_by_itself():
    noise, rng = HeldNoise(64, 3, hold=10), np.random.default_rng(0)
    seen = noise.inputs(np.zeros((64, 11)), np.zeros(64))
    assert seen.shape == (64, len(noise.mean))  # what a collector stores of it
    actions = np.stack([noise.act(seen, rng) for _ in range(400)], axis=1)
    assert np.abs(actions).max() == 1.0 and actions.dtype == np.float32
    changed = (np.diff(actions, axis=1) != 0).any(axis=-1)
    held = np.concatenate([np.diff(np.flatnonzero(lane)) for lane in changed])
    # Now and then the same motors are driven as far as they go twice running: it looks like one.
    assert (held > 10).mean() < 0.02 and (held == 10).mean() > 0.07
    assert 5.2 < held.mean() < 5.8  # 1 to 10, evenly: 5.5
    assert 0.05 < changed.mean(axis=0).min() and changed.mean(axis=0).max() < 0.5  # not all lanes at once
