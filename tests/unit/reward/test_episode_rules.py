"""Adaptive phase, reset buffer, rewards and early termination, under a predictor whose ratings are known."""

import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from onedemo.reward.episode_rules import (
    PracticeConfig,
    PracticeRules,
    ResetBuffer,
    fill_reset_buffer,
    mean_rating,
)
from onedemo.reward.model import PredictorConfig, Snapshot
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.random_states import wild_rollouts
from onedemo.rl.rollouts import Collector, Step
from onedemo.sim import vector_env

DEMO_STEPS = 400
DT = 0.008


class Places(Snapshot):
    """The robot is at a place of the demo, ``obs[0]``; a rating falls from 5 by one for so many steps off.

    Args:
        width: Demo steps for which one point is lost.
    """

    def __init__(self, width=5.0):
        super().__init__(number=1, config=PredictorConfig())
        self.width = width

    def place(self, obs):
        return obs[..., 0]

    def member_probabilities(self, frames, obs, actions):
        rating = np.clip(5 - np.abs(frames - self.place(obs)) / self.width, 1, 5)
        return np.clip(1 - np.abs(np.arange(1, 6) - rating[..., None]), 0, 1)[None].astype(np.float32)

    def tensors(self):
        return {}


def make_rules(config=None, *, lanes=1, width=5.0, buffer=None, demo_steps=DEMO_STEPS):
    rules = PracticeRules(
        config or PracticeConfig(), lanes=lanes, dt=DT, demo_steps=demo_steps, frames_of=lambda steps: steps
    )
    rules.use(Places(width), buffer)
    return rules


def step(clock, places, elapsed=None):
    """One control step of as many lanes as there are clocks; afterwards the robots are at ``places``."""
    clock = np.atleast_1d(clock)
    obs = np.zeros((len(clock), 11))
    obs[:, 0] = places
    none = np.zeros((len(clock), 6))
    elapsed = clock + 1 if elapsed is None else np.broadcast_to(elapsed, clock.shape)
    return Step(
        obs=obs * np.nan, actions=np.zeros((len(clock), 3)), clock=clock, elapsed=elapsed, next_obs=obs,
        next_qpos=none, next_qvel=none, rewards=none[:, 0], terminated=none[:, 0] > 0,
        truncated=none[:, 0] > 0,
    )  # fmt: skip


def scored(rules, moved):
    """The rewards of the steps so far, in which the phase moved on by so much, (N, T)."""
    moved = np.array(moved)
    return rules.score(SimpleNamespace(clock=np.zeros_like(moved), next_clock=moved))  # type: ignore[arg-type]


# The phase


def test_a_fixed_clock_moves_by_one_and_pays_the_similarity_there():
    rules = make_rules(PracticeConfig(elastic=False), lanes=3, width=4.0)
    assert rules.advance(step([10, 10, 10], [11, 19, 60])).tolist() == [11, 11, 11]
    # 8 steps off cost two points of four: similarity 0.5
    np.testing.assert_allclose(scored(rules, [[1]] * 3), [[1.0], [0.5], [0.0]], atol=1e-6)


def test_an_adaptive_phase_goes_to_where_the_demo_is_most_like_the_robot():
    rules = make_rules(lanes=6)
    moved = rules.advance(step(np.full(6, 100), [90, 100, 101, 102, 103, 110])) - 100
    assert moved.tolist() == [0, 0, 1, 2, 3, 3]
    # Nobody is paid for standing still, however like the demo; and for more steps, more.
    similar = [0.5, 1.0, 1.0, 1.0, 1.0, 1 - 7 / 20]
    rewards = scored(rules, moved[:, None])
    np.testing.assert_allclose(rewards[:, 0], similar * moved, atol=1e-6)
    rating = mean_rating(rewards.ravel(), moved)  # of the demo that was passed
    assert rating == pytest.approx(1 + 4 * (similar * moved).sum() / moved.sum())


def test_moves_that_gain_next_to_nothing_are_not_made():
    """A step is worth 1 / (4 width): below 0.02, one at a time, the clock keeps real time."""
    flat, steep = ({"width": 1 / (4 * gain)} for gain in (0.015, 0.03))
    assert make_rules(lanes=3, **flat).advance(step([50] * 3, [40, 51, 60])).tolist() == [51, 51, 51]
    assert make_rules(lanes=3, **steep).advance(step([50] * 3, [40, 51, 60])).tolist() == [50, 51, 53]
    blind = make_rules(lanes=2)  # so far off that every step of the demo is rated 1
    assert blind.advance(step([50] * 2, [300, -200])).tolist() == [51, 51]


def run(rules, places, steps):
    """The clocks of one lane that is at ``places(t)`` after step t = 1, 2, ..."""
    clock, clocks = np.zeros(1, int), []
    for t in range(1, steps + 1):
        clock = rules.advance(step(clock, places(t), elapsed=t))
        clocks.append(int(clock[0]))
    return np.array(clocks)


@pytest.mark.parametrize("slack", [0, 1, 2, 7, 20])
def test_the_clock_keeps_within_its_slack_of_real_time(slack):
    config = PracticeConfig(slack_seconds=slack * DT)
    real = np.arange(1, 81)
    # A robot that hangs back, and one that is ahead.
    late = run(make_rules(config, width=10.0), lambda t: t - 30, 80) - real
    early = run(make_rules(config, width=10.0), lambda t: t + 30, 80) - real
    assert late.min() == -slack and late.max() <= 0
    assert early.max() == slack and early.min() >= 0


def test_the_slack_is_counted_from_the_demo_step_an_episode_starts_at():
    """A start from the buffer at step 100 is not 100 steps ahead: ``elapsed`` starts there too."""
    rules = make_rules(PracticeConfig(slack_seconds=5 * DT))
    assert rules.advance(step([100], [103], elapsed=101)).tolist() == [103]


def test_all_of_the_demo_is_worth_the_same_at_any_speed():
    """The reward is similarity integrated over the demo, not over time."""
    config = PracticeConfig(slack_seconds=10.0)
    sums = []
    for speed in (0.5, 1.0, 2.0):
        rules = make_rules(config)
        clocks = run(rules, lambda t, speed=speed: int(speed * t), round(300 / speed))
        assert clocks[-1] == 300
        sums.append(scored(rules, [np.diff(clocks, prepend=0)]).sum())
    assert sums == pytest.approx([300, 300, 300], rel=1e-3)


def test_past_its_end_the_demo_stands_still():
    rules = make_rules()
    last = DEMO_STEPS - 1
    assert rules.advance(step([last], [last])).tolist() == [DEMO_STEPS]
    assert scored(rules, [[1]]).tolist() == [[pytest.approx(1.0)]]


def test_rewards_are_given_once_and_in_order():
    rules = make_rules(PracticeConfig(elastic=False), lanes=2)
    for clock in range(3):
        rules.advance(step([clock, clock], [clock + 1, clock + 6 + clock]))
    np.testing.assert_allclose(scored(rules, np.ones((2, 3))), [[1, 1, 1], [0.75, 0.7, 0.65]], atol=1e-6)
    rules.advance(step([3, 3], [4, 4]))
    assert scored(rules, [[1], [1]]).tolist() == [[1.0], [1.0]]


def test_where_the_demo_stood_still_the_mean_rating_is_the_lowest():
    assert mean_rating(np.zeros((2, 3)), np.zeros((2, 3))).tolist() == [1, 1]


# Early termination


def given_up_after(rules, places, start=0, limit=100):
    """How many steps each lane lasts; ``limit`` if it does."""
    lasted = np.full(len(places), limit)
    clock = np.full(len(places), start)
    for t in range(1, limit + 1):
        now = step(clock, places, elapsed=start + t)
        clock = rules.advance(now)
        over = rules.stop(now, clock)
        lasted = np.where(over & (lasted == limit), t, lasted)
    return lasted


def test_an_episode_is_given_up_once_its_running_similarity_is_too_low():
    far, near = 10**4, 0
    rules = make_rules(PracticeConfig(elastic=False, give_up=0.15), lanes=2, width=10**3)
    # It starts at 0.6 and falls by a 25th a step: 0.6 (24/25)^n < 0.15 from n = 34 on.
    assert given_up_after(rules, [far, near]).tolist() == [34, 100]


def test_nothing_is_given_up_in_the_first_steps_of_an_episode():
    config = PracticeConfig(elastic=False, give_up=0.55)  # 0.6 (24/25)^3 is below already
    for start in (0, 150):  # at step 150: from the buffer
        rules = make_rules(config, lanes=2, width=1.0)
        assert given_up_after(rules, [10**4, 10**4], start=start).tolist() == [11, 11]


def test_a_new_episode_is_a_new_chance():
    rules = make_rules(PracticeConfig(elastic=False, give_up=0.15), lanes=2, width=1.0)
    assert given_up_after(rules, [10**4, 10**4], limit=34).tolist() == [34, 34]
    rules.start(np.array([0]), np.random.default_rng(0))  # the other one's goes on, unlike in a run
    assert given_up_after(rules, [10**4, 10**4]).tolist() == [34, 1]


def test_a_timid_predictor_gives_up_later():
    """What counts is the share of what the predictor gives at best: half of 0.3 is 0.15."""
    rules = make_rules(PracticeConfig(elastic=False, give_up=0.3), lanes=2, width=10**3)
    none = np.zeros((1, 6))
    rules.use(rules._snapshot, ResetBuffer(qpos=none, qvel=none, clock=np.zeros(1, np.int32), similarity=0.5))
    assert given_up_after(rules, [10**4, 0]).tolist() == [34, 100]


def test_it_can_be_switched_off():
    rules = make_rules(PracticeConfig(elastic=False, give_up=0.0), lanes=1, width=1.0)
    assert given_up_after(rules, [10**4]).tolist() == [100]


def test_a_resumed_practice_gives_up_when_the_uninterrupted_one_does():
    config = PracticeConfig(elastic=False, give_up=0.5)
    whole, first, second = (make_rules(config, lanes=2, width=1.0) for _ in range(3))
    for rules in (whole, first):
        given_up_after(rules, [10**4, 0], limit=8)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    np.testing.assert_array_equal(given_up_after(second, [10**4, 0]), given_up_after(whole, [10**4, 0]))
    assert given_up_after(second, [0, 0], limit=1).tolist() == [1, 1]  # the state was a copy:
    file.seek(0)
    assert given_up_after(first, [10**4, 0])[0] == 3


# The reset buffer


@pytest.fixture(scope="module")
def states():
    """Random states whose observation says at which place of the demo they are; so does x."""
    rollouts = wild_rollouts("hopper", lanes=32, steps=50, every=25, seed=0, nthread=0)
    places = np.random.default_rng(0).uniform(0, DEMO_STEPS, rollouts.clock.shape)
    obs, qpos = rollouts.obs.copy(), rollouts.qpos.copy()
    obs[..., 0] = qpos[..., 0] = places
    return replace(rollouts, obs=obs, qpos=qpos)


def make_buffer(states, seed=0, demo_steps=DEMO_STEPS):
    rng = np.random.default_rng(seed)
    return fill_reset_buffer(Places(), states, lambda steps: steps, demo_steps, rng, tries=8000, dt=0.008)


def test_the_reset_buffer_holds_the_states_most_like_each_part_of_the_demo(states):
    buffer = make_buffer(states)
    assert buffer.clock.dtype == np.int32 and len(buffer.clock) == len(buffer.qpos) == len(buffer.qvel)
    moments, counts = np.unique(buffer.clock, return_counts=True)
    assert len(set(counts)) == 1
    assert np.diff(moments).max() == 20  # a start in every part ...
    assert moments[0] == 0 and DEMO_STEPS - 60 <= moments[-1] <= DEMO_STEPS - 40  # ... with practice ahead
    off = np.abs(buffer.qpos[:, 0] - buffer.clock)
    assert off.max() < 5  # 1,600 states on 400 steps
    assert buffer.similarity == pytest.approx(1 - off.mean() / 5 / 4, abs=1e-6)
    flat = states.qpos.reshape(-1, 6)
    rows = [int(np.flatnonzero((flat == qpos).all(axis=1))[0]) for qpos in buffer.qpos]
    np.testing.assert_array_equal(states.qvel.reshape(-1, 6)[rows], buffer.qvel)


def test_a_reset_buffer_follows_its_seed_and_fits_a_short_demo(states):
    one, two, other = make_buffer(states, 1), make_buffer(states, 1), make_buffer(states, 2)
    np.testing.assert_array_equal(one.qpos, two.qpos)
    assert not np.array_equal(one.qpos, other.qpos)
    assert set(make_buffer(states, demo_steps=38).clock) == {0}


def test_a_share_of_the_episodes_starts_in_the_reset_buffer_and_the_others_stand(states):
    buffer, lanes = make_buffer(states), np.arange(1000)
    for share in (0.0, 0.3, 1.0):
        rules = make_rules(PracticeConfig(bank_share=share), lanes=1000, buffer=buffer)
        starts = rules.start(lanes, np.random.default_rng(0))
        assert len(starts.lanes) / 1000 == pytest.approx(share, abs=0.05)
        assert len(np.unique(starts.lanes)) == len(starts.lanes)
        for qpos, qvel, clock in zip(starts.qpos, starts.qvel, starts.clock, strict=True):
            row = np.flatnonzero((buffer.qpos == qpos).all(axis=1) & (buffer.clock == clock))
            assert len(row) and (buffer.qvel[row] == qvel).all()
        if share == 1.0:
            assert len(np.unique(starts.clock)) == len(np.unique(buffer.clock))
    assert make_rules().start(lanes[:1], np.random.default_rng(0)) is None


class Leaning(Places):
    """The further the robot leans, the later in the demo it is."""

    def place(self, obs):
        return 40 * np.abs(obs[..., 1])


def test_practice_in_the_real_environment():
    """Clocks, starts and rewards belong together, step by step, episode by episode."""
    lanes, horizon = 8, 60
    qpos = np.tile([0, 1.25, 0.5, 0, 0, 0], (3, 1))
    buffer = ResetBuffer(
        qpos=qpos, qvel=np.zeros((3, 6)), clock=np.array([0, 20, 40], np.int32), similarity=1.0
    )
    config = PracticeConfig(slack_seconds=6 * DT, give_up=0.3)
    rules = make_rules(config, lanes=lanes, demo_steps=horizon)
    rules.use(Leaning(6.0), buffer)
    env = vector_env.make("hopper", lanes, horizon=horizon, nthread=0)
    policy = Policy(PolicyConfig(kind="raw"), obs_size=11, action_size=3, horizon=horizon, seed=0)
    rollouts = Collector(env, seed=0, rules=rules).collect(policy.snapshot(), 200)
    moved = rollouts.next_clock - rollouts.clock
    assert moved.min() == 0 and moved.max() == 3
    shown = np.minimum(rollouts.next_clock, horizon - 1)
    similar = (Leaning(6.0).ratings(shown, rollouts.next_obs, rollouts.actions) - 1) / 4
    np.testing.assert_allclose(rollouts.rewards, similar * moved, atol=1e-6)
    ended = rollouts.terminated | rollouts.truncated
    assert rollouts.terminated.any() and rollouts.truncated.any()
    began = np.zeros_like(ended)
    began[:, 0], began[:, 1:] = True, ended[:, :-1]
    banked = began & (np.abs(rollouts.qpos[..., 2] - 0.5) < 1e-9)
    assert 0.25 < banked[began].mean() < 0.75
    assert set(np.unique(rollouts.clock[banked])) == {0, 20, 40}
    assert not rollouts.clock[began & ~banked].any()
    assert (rollouts.clock[:, 1:] == rollouts.next_clock[:, :-1])[~ended[:, :-1]].all()
    assert rollouts.clock.max() < horizon


@pytest.mark.parametrize(
    "change",
    [{"bank_share": 1.1}, {"bank_share": -0.1}, {"give_up": 1.0}, {"give_up": -0.1}, {"slack_seconds": -1}],
)
def test_bad_settings_say_which(change):
    with pytest.raises(ValueError, match=f"practice.{next(iter(change))}"):
        PracticeConfig(**change)


def test_with_everything_off_a_whole_batch_is_scored_as_step_by_step():
    """The paper's rules: standing starts, a fixed phase, no early end, the state after each step."""
    off = {"elastic": False, "bank_share": 0.0, "give_up": 0.0}
    found = []
    for config in (PracticeConfig(**off), PracticeConfig(**off | {"give_up": 1e-9})):
        rules = make_rules(config, lanes=4, demo_steps=40)
        rules.use(Leaning(6.0), None)
        env = vector_env.make("hopper", 4, horizon=40, nthread=0)
        policy = Policy(PolicyConfig(kind="raw"), obs_size=11, action_size=3, horizon=40, seed=0)
        found.append(Collector(env, seed=0, rules=rules).collect(policy.snapshot(), 100))
    whole, stepped = found
    np.testing.assert_allclose(whole.rewards, stepped.rewards, atol=1e-6)
    assert (whole.next_clock - whole.clock == 1).all() and not whole.terminated.any()
    assert np.abs(whole.qpos[whole.clock == 0][:, 1:] - [1.25, 0, 0, 0, 0]).max() < 0.01
    shown = np.minimum(whole.next_clock, 39)
    expected = (Leaning(6.0).ratings(shown, whole.next_obs, whole.actions) - 1) / 4
    np.testing.assert_allclose(whole.rewards, expected, atol=1e-6)
    assert np.ptp(whole.rewards) > 0.1


def test_a_state_without_running_similarity_is_one_of_rules_that_need_none():
    """So says a checkpoint of the paper's method."""
    off = make_rules(PracticeConfig(elastic=False, bank_share=0.0, give_up=0.0))
    assert off.state_dict() == {}
    off.load_state_dict({})
