import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from helpers.small_world import Thumbnail, falling_demo, small_config
from onedemo.annotators.oracle import (
    THRESHOLDS,
    Oracle,
    RatingBudgetSpent,
    appearance,
    make_rater,
    thresholds_of,
)
from onedemo.demos.ground_truth import HiddenStates
from onedemo.errors import UserError
from onedemo.rl.random_states import random_states, wild_rollouts
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.storage.store import Store
from onedemo.training.simulated_run import train
from onedemo.types import Demo, Segment

HOPPER = body_of(robot_named("hopper"))


def states(steps=100, spin=-0.03):
    qpos = np.zeros((steps + 1, 6))
    qpos[:, 1] = 1.25
    qpos[:, 2] = spin * np.arange(steps + 1)
    qvel = np.zeros((steps + 1, 6))
    qvel[:, 2] = spin / 0.008
    return qpos, qvel


@pytest.fixture
def hidden():
    qpos, qvel = states()
    obs = robot_named("hopper").observe(qpos, qvel)
    return HiddenStates(obs=obs, actions=np.zeros((100, 3)), qpos=qpos, qvel=qvel)


def segment(qpos, qvel, start, length=38):
    cut = slice(start, start + length)
    obs = robot_named("hopper").observe(qpos[cut], qvel[cut])
    return Segment(obs=obs, actions=np.zeros((length, 3)), qpos=qpos[cut], qvel=qvel[cut])


def test_the_demos_own_states_are_a_five(hidden):
    assert Oracle(hidden, budget=1).rate(segment(hidden.qpos, hidden.qvel, 20), 20) == 5


def test_a_turn_more_and_a_metre_further_look_the_same(hidden):
    qpos = hidden.qpos.copy()
    qpos[:, 2] += 4 * np.pi
    qpos[:, 0] += 10
    seen, turned = (appearance(q, hidden.qvel, HOPPER) for q in (hidden.qpos, qpos))
    np.testing.assert_allclose(turned, seen, atol=1e-9)


def test_ratings_fall_with_the_distance(hidden):
    oracle = Oracle(hidden, budget=10)
    ratings = []
    for offset in (0.0, 0.6, 1.0, 1.5, 3.1):
        qpos = hidden.qpos.copy()
        qpos[:, 2] += offset
        ratings.append(oracle.rate(segment(qpos, hidden.qvel, 10), 10))
    assert ratings == sorted(ratings, reverse=True)
    assert ratings[0] == 5 and ratings[-1] == 1 and len(set(ratings)) >= 4


def test_the_wrong_moment_is_not_similar(hidden):
    assert Oracle(hidden, budget=1).rate(segment(hidden.qpos, hidden.qvel, 0), 60) <= 2


def test_the_budget_is_enforced_by_the_rater(hidden):
    oracle = Oracle(hidden, budget=2)
    for _ in range(2):
        oracle.rate(segment(hidden.qpos, hidden.qvel, 0), 0)
    with pytest.raises(RatingBudgetSpent, match="budget of 2 ratings"):
        oracle.rate(segment(hidden.qpos, hidden.qvel, 0), 0)


def test_true_similarity_costs_nothing(hidden):
    oracle = Oracle(hidden, budget=0)
    assert oracle.true_similarity(hidden.qpos[:-1], hidden.qvel[:-1]) == 5.0
    still, _ = states(spin=0.0)
    assert oracle.true_similarity(still[:-1], np.zeros((100, 6))) < 3


def demo(name="d"):
    return Demo(name=name, sha256="", path=Path("d.webm"), fps=30.0, frames=24, width=64, height=48)


@pytest.mark.parametrize("name", ["orakel", "", "oracle:x", "a.b", "a:b.c", "7.a:B", "scripted"])
def test_unknown_raters(name, hidden):
    with pytest.raises(UserError, match=f"unknown rater '{name}'; choose one of: oracle, script, "):
        make_rater(name, hidden, demo=demo(), budget=1)


def test_the_oracle_needs_hidden_states():
    with pytest.raises(UserError, match="demo 'person' has none"):
        make_rater("oracle", None, demo=demo("person"), budget=1)


def make(name, hidden, **more):
    return make_rater(name, hidden, demo=demo(), budget=200, **more)


def ratings_of(rater, hidden, count=200):
    """Ratings of the demo's own states, turned further and further."""
    found = []
    for k in range(count):
        qpos = hidden.qpos.copy()
        qpos[:, 2] += k % 20 / 8
        found.append(rater.rate(segment(qpos, hidden.qvel, 10), 10))
    return found


def test_the_name_says_the_errors_and_the_seed(hidden):
    plain = ratings_of(make("oracle", hidden), hidden)
    wrong = ratings_of(make("oracle+mistake:0.3", hidden, seed=1), hidden)
    assert 30 <= sum(a != b for a, b in zip(plain, wrong, strict=True)) <= 90
    assert wrong == ratings_of(make("oracle+mistake:0.3", hidden, seed=1), hidden)
    assert wrong != ratings_of(make("oracle+mistake:0.3", hidden, seed=2), hidden)
    assert wrong == ratings_of(make("oracle+mistake:0.3+seed:1", hidden, seed=2), hidden)
    assert plain == ratings_of(make("oracle+seed:5", hidden), hidden)


def test_the_order_of_the_names_does_not_matter(hidden):
    one = ratings_of(make("oracle+harsh+mistake:0.2+jitter", hidden), hidden)
    assert one == ratings_of(make("oracle+jitter+mistake:0.2+harsh", hidden), hidden)


def test_a_resumed_rater_goes_on_where_it_was(hidden):
    name = "oracle+mistake:0.3+jitter+drift+noisy"
    whole = ratings_of(make(name, hidden), hidden)
    assert whole[:80] == ratings_of(make(name, hidden), hidden, 80)
    rest = make(name, hidden, given=80)
    assert whole[80:] == ratings_of(rest, hidden, 120)
    with pytest.raises(RatingBudgetSpent, match="budget of 200"):
        ratings_of(rest, hidden, 1)


# In a run


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "data")
    yield store
    store.close()


def run(store, demo, rater, **config):
    return train(
        store=store, data_dir=store.path.parent, demo=demo, config=small_config(**config),
        encoder=Thumbnail(), rater=rater, progress=False,
    )  # fmt: skip


@pytest.mark.slow
def test_declined_clips_are_skipped_and_others_asked(store, tmp_path):
    world = falling_demo(tmp_path / "demo")
    summary = run(store, world, "oracle+skip:0.6")
    assert summary["ratings"] == 18
    with closing(sqlite3.connect(store.path)) as db:
        kinds = dict(db.execute("SELECT kind, COUNT(*) FROM events GROUP BY kind").fetchall())
    assert kinds["rate"] == 18 and kinds["skip"] >= 3
    assert store.clips.count(summary["run"]) == 18 + kinds["skip"]
    assert not store.clips.waiting(summary["run"], "cut")
    stages = {key: sum(counts) for key, counts in store.ratings.tallies(summary["run"]).items()}
    assert stages == {("oracle+skip:0.6", "pretrain"): 12, ("oracle+skip:0.6", "online"): 6}


def test_a_rater_that_declines_everything_ends_the_run(store, tmp_path, monkeypatch):
    monkeypatch.setattr(Oracle, "rate", lambda self, segment, demo_step: None)
    with pytest.raises(UserError, match=r"rater oracle declined 1\d\d clips in a row; without ratings"):
        run(store, falling_demo(tmp_path / "demo"), "oracle")
    assert sum(store.ratings.by_class()) == 0


@pytest.mark.slow
def test_a_rater_that_tires_of_the_policy_does_not_stop_it(store, tmp_path, monkeypatch):
    """From the first iteration on it declines everything: the run ends with what it has."""
    rate = Oracle.rate
    monkeypatch.setattr(
        Oracle, "rate", lambda self, s, step: rate(self, s, step) if self.given < 12 else None
    )
    summary = run(store, falling_demo(tmp_path / "demo"), "oracle")
    assert summary["ratings"] == 12 and summary["env_steps"] == 2400


# Any robot


def test_a_hopper_is_seen_as_ever():
    """Results depend on the thresholds, so what is measured must stay the same to the last bit."""
    rng = np.random.default_rng(0)
    qpos, qvel = random_states(200, rng)
    torso = qpos[:, 2]
    thigh = torso - qpos[:, 3]
    leg = thigh - qpos[:, 4]
    parts = [1.5 * (qpos[:, 1] - 1.25)]
    for angle, weight in ((torso, 1.0), (thigh, 0.7), (leg, 0.7), (leg - qpos[:, 5], 0.5)):
        parts += [weight * np.sin(angle), weight * np.cos(angle)]
    parts += [0.15 * np.clip(qvel[:, 2], -10, 10), 0.15 * qvel[:, 1], 0.08 * qvel[:, 0]]
    np.testing.assert_allclose(appearance(qpos, qvel, HOPPER), np.stack(parts, axis=-1), atol=1e-12)
    assert thresholds_of(HOPPER) == list(THRESHOLDS)


@pytest.mark.parametrize("name", ["walker2d", "half-cheetah", "swimmer", "ant", "humanoid"])
def test_any_robot_is_rated_by_how_far_it_is(name):
    """Its own states are a 5, wherever they are on the floor, those of other lanes are bad on average."""
    robot = robot_named(name)
    rollouts = wild_rollouts(name, lanes=6, steps=40, every=40, seed=0, nthread=0)
    actions = rollouts.actions[0, :-1]
    own = HiddenStates(obs=rollouts.obs[0], actions=actions, qpos=rollouts.qpos[0], qvel=rollouts.qvel[0])
    oracle = Oracle(own, name, budget=20)
    assert oracle.rate(rollouts.segment(0, 5, 20), 5) == 5
    others = [oracle.rate(rollouts.segment(lane, 5, 20), 5) for lane in range(1, 6)]
    assert np.mean(others) < 3.5
    further = rollouts.qpos[0].copy()
    further[:, : robot.unseen] += 10
    assert oracle.true_similarity(further, rollouts.qvel[0]) == 5
