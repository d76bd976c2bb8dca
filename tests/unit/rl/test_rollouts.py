"""What the collector records, how episodes start and end, and that it resumes exactly."""

import io

import numpy as np
import pytest
import torch

from onedemo.errors import UserError
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import Collector, EpisodeRules, Starts, evaluate
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env

HORIZON = 40


def policy(seed=0, horizon=HORIZON):
    built = Policy(PolicyConfig(), obs_size=11, action_size=3, horizon=horizon, seed=seed)
    with torch.no_grad():
        built.mean[-1].weight.mul_(50)
    return built.snapshot()


def collector(lanes=4, seed=0, **options):
    env = vector_env.make("hopper", lanes, horizon=HORIZON, nthread=0)
    return Collector(env, seed=seed, **options)


def test_shapes_and_kinds():
    batch = collector().collect(policy(), 30)
    for name, last, kind in (
        ("obs", 11, np.float64),
        ("next_obs", 11, np.float64),
        ("actions", 3, np.float32),
        ("qpos", 6, np.float64),
        ("qvel", 6, np.float64),
        ("inputs", 23, np.float32),
        ("next_inputs", 23, np.float32),
    ):
        array = getattr(batch, name)
        assert array.shape == (4, 30, last), name
        assert array.dtype == kind, name
    for name in ("clock", "next_clock", "rewards", "terminated", "truncated"):
        assert getattr(batch, name).shape == (4, 30), name


def test_each_step_follows_from_the_one_before():
    lanes = collector(stagger=False)
    snapshot = policy()
    batch = lanes.collect(snapshot, 100)
    expected = np.tile(np.arange(100) % HORIZON, (4, 1))
    np.testing.assert_array_equal(batch.clock, expected)
    np.testing.assert_array_equal(batch.truncated, expected == HORIZON - 1)
    assert not batch.terminated.any()
    going_on = ~batch.truncated[:, :-1]
    for state in ("obs", "qpos", "qvel", "inputs", "clock"):
        after, before = getattr(batch, f"next_{state}", None), getattr(batch, state)
        if after is not None:
            np.testing.assert_array_equal(after[:, :-1][going_on], before[:, 1:][going_on])
    # The state after the last step of an episode is that episode's, not the next one's start.
    last = batch.next_qpos[batch.truncated]
    assert np.abs(last - [0, 1.25, 0, 0, 0, 0]).max(1).min() > 0.05
    starts = batch.qpos[batch.clock == 0]
    assert np.abs(starts - [0, 1.25, 0, 0, 0, 0]).max() <= 0.005
    np.testing.assert_array_equal(batch.next_inputs, snapshot.inputs(batch.next_obs, batch.next_clock))
    # The same actions in a fresh environment give the same states and rewards.
    env = vector_env.make("hopper", 4, horizon=HORIZON, nthread=0)
    env.reset(seed=0)
    for t in range(HORIZON):
        np.testing.assert_array_equal(env.qpos, batch.qpos[:, t])
        _, rewards, *_ = env.step(batch.actions[:, t])
        np.testing.assert_array_equal(rewards, batch.rewards[:, t])


def test_lanes_go_on_between_batches():
    whole = collector().collect(policy(), 60)
    parts = collector()
    first, second = parts.collect(policy(), 25), parts.collect(policy(), 35)
    for name in ("obs", "actions", "clock", "rewards", "truncated"):
        joined = np.concatenate([getattr(first, name), getattr(second, name)], axis=1)
        np.testing.assert_array_equal(joined, getattr(whole, name))


def test_staggered_lanes_see_every_part_of_the_episode():
    lanes = collector(lanes=8)
    for _ in range(4):
        batch = lanes.collect(policy(), 10)
    assert len(np.unique(batch.clock // 10)) == 4
    assert batch.truncated.any()


def test_saved_between_batches_goes_on_exactly():
    lanes = collector(seed=3)
    lanes.collect(policy(), 25)
    file = io.BytesIO()
    torch.save(lanes.state_dict(), file)
    expected = lanes.collect(policy(), 50)
    file.seek(0)
    resumed = collector(seed=99)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    again = resumed.collect(policy(), 50)
    for name in ("obs", "actions", "clock", "qvel", "truncated"):
        np.testing.assert_array_equal(getattr(again, name), getattr(expected, name))
    fewer = collector(lanes=3)
    with pytest.raises(ValueError, match="saved state"):
        fewer.load_state_dict(lanes.state_dict())


def test_deterministic_actions_are_the_mean():
    snapshot = policy()
    batch = collector().collect(snapshot, 5, deterministic=True)
    np.testing.assert_allclose(batch.actions, snapshot.act(batch.inputs), atol=1e-6)


class Elastic(EpisodeRules):
    """Starts half the lanes mid-way in the air; two demo steps a step; gives up when low."""

    def start(self, lanes, rng):
        chosen = lanes[rng.random(len(lanes)) < 0.5]
        qpos = np.tile([0, 1.6, -3.0, 0, 0, 0], (len(chosen), 1))
        return Starts(
            lanes=chosen,
            qpos=qpos,
            qvel=np.zeros((len(chosen), 6)),
            clock=np.full(len(chosen), 10),
        )

    def advance(self, step):
        return step.clock + 2

    def stop(self, step, next_clock):
        return step.next_qpos[:, 1] < 1.2

    def score(self, batch):
        return 10 * batch.next_qpos[..., 1]


def test_rules_start_advance_and_stop():
    lanes = collector(lanes=16, rules=Elastic(), stagger=False)
    batch = lanes.collect(policy(), 120)
    np.testing.assert_array_equal(batch.rewards, 10 * batch.next_qpos[..., 1])
    started = batch.clock == 10
    airborne = started & (np.abs(batch.qpos[..., 2] + 3.0) < 1e-9)
    assert airborne.any()
    assert (batch.clock == 0).any()
    ended = batch.terminated | batch.truncated
    assert (batch.next_clock - batch.clock == 2).all()
    np.testing.assert_array_equal(batch.terminated, batch.next_qpos[..., 1] < 1.2)
    np.testing.assert_array_equal(batch.truncated, (batch.next_clock >= HORIZON) & ~batch.terminated)
    assert batch.terminated.any()
    assert batch.truncated.any()
    # After an end: the clock is a start's; otherwise it went on.
    following = batch.clock[:, 1:]
    assert np.isin(following[ended[:, :-1]], [0, 10]).all()
    np.testing.assert_array_equal(following[~ended[:, :-1]], batch.next_clock[:, :-1][~ended[:, :-1]])
    # A lane that the rules ended starts anew: a standing start, or in the air.
    restarts = batch.qpos[:, 1:][ended[:, :-1]]
    assert np.isin(restarts[:, 1].round(1), [1.2, 1.3, 1.6]).all()


def test_evaluate_gives_whole_episodes():
    snapshot = policy()
    episodes = evaluate(snapshot, "hopper", episodes=3, seed=5, nthread=0)
    assert episodes.obs.shape == (3, HORIZON + 1, 11)
    assert episodes.actions.shape == (3, HORIZON, 3)
    assert episodes.qpos.shape == episodes.qvel.shape == (3, HORIZON + 1, 6)
    np.testing.assert_array_equal(episodes.clock, np.tile(np.arange(HORIZON + 1), (3, 1)))
    np.testing.assert_array_equal(episodes.obs, robot_named("hopper").observe(episodes.qpos, episodes.qvel))
    means = snapshot.act(snapshot.inputs(episodes.obs[:, :-1], episodes.clock[:, :-1]))
    np.testing.assert_allclose(episodes.actions, means, atol=1e-5)
    again = evaluate(snapshot, "hopper", episodes=3, seed=5, nthread=2)
    np.testing.assert_array_equal(again.qpos, episodes.qpos)
    other = evaluate(snapshot, "hopper", episodes=3, seed=6, nthread=0)
    assert (other.qpos[:, 0] != episodes.qpos[:, 0]).any()
    noisy = evaluate(snapshot, "hopper", episodes=3, seed=5, nthread=0, deterministic=False)
    assert np.abs(noisy.actions - episodes.actions).mean() > 0.1
    fast = evaluate(snapshot, "hopper", episodes=3, seed=5, rules=Elastic(), nthread=0)
    assert fast.clock[0, 5] == 10
    assert fast.clock[0, -1] == HORIZON
    np.testing.assert_array_equal(fast.rewards, 10 * fast.qpos[:, 1:, 1])
    part = evaluate(snapshot, "hopper", episodes=3, seed=5, horizon=10, rules=Elastic(), nthread=0)
    for name in ("obs", "qvel", "clock"):  # its clock is further than its time, and nothing ends
        np.testing.assert_array_equal(getattr(part, name), getattr(fast, name)[:, :11])
    short = evaluate(snapshot, "hopper", episodes=1, horizon=7, nthread=0)
    assert short.qpos.shape == (1, 8, 6)
    with pytest.raises(UserError, match="choose one of"):
        evaluate(snapshot, "walker")


def test_segments_are_cut_within_an_episode():
    batch = collector(stagger=False).collect(policy(), 80)
    segment = batch.segment(1, 5, 30)
    np.testing.assert_array_equal(segment.qpos, batch.qpos[1, 5:35])
    with pytest.raises(ValueError, match="span the end"):
        batch.segment(1, 30, 30)
