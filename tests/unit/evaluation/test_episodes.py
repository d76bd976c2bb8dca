"""Figures of episodes against answers known beforehand: the demos' own states, late or changed."""

import itertools

import numpy as np
import pytest

from onedemo.annotators.oracle import Oracle
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.ground_truth import load_hidden
from onedemo.demos.library import BUILT_IN, find_demo
from onedemo.evaluation.episodes import aligned_similarity, per_episode, spread, state_errors
from onedemo.evaluation.time_warping import align
from onedemo.experiments.jobs.controls import TrueRating
from onedemo.rl.rollouts import Episodes
from onedemo.robots.registry import robot_named


@pytest.fixture(scope="module")
def clean():
    return load_hidden(BUILT_IN / "hopper-flip-clean.hidden.npz")


def as_episodes(*hidden):
    columns = {
        name: np.stack([getattr(h, name) for h in hidden]) for name in ("obs", "actions", "qpos", "qvel")
    }
    steps = columns["actions"].shape[1]
    clock = np.tile(np.arange(steps + 1), (len(hidden), 1))
    return Episodes(**columns, clock=clock, rewards=np.zeros((len(hidden), steps)))


def test_the_demo_itself_has_the_best_of_everything(clean):
    hop = load_hidden(BUILT_IN / "hopper-hop.hidden.npz")
    figures = per_episode(as_episodes(clean, hop), Oracle(clean, budget=0))
    assert figures["true_similarity"][0] == figures["aligned_similarity"][0] == 5
    assert figures["true_similarity"][1] < figures["aligned_similarity"][1] < 4
    assert figures["state_error"][0] == 0 < figures["state_error"][1]
    assert figures["net_turns"].tolist() == figures["clean_turns"].tolist() == [3, 0]
    assert figures["landings"].tolist() == [3, 0]
    assert figures["upright_seconds"][0] < 1 < figures["upright_seconds"][1]
    assert figures["hop_return"][0] < 300 < figures["hop_return"][1]
    assert figures["backflip_reward"][0] > 1000 > figures["backflip_reward"][1]
    without = per_episode(as_episodes(clean), None)
    missing = {name for name, values in without.items() if values is None}
    assert missing == {"true_similarity", "aligned_similarity", "state_error"}


def test_being_late_costs_nothing_after_alignment(clean):
    oracle = Oracle(clean, budget=0)
    for late, least in ((50, 4.9), (200, 0)):  # 0.4 s is within the band, 1.6 s is not
        steps = np.maximum(np.arange(len(clean.qpos)) - late, 0)
        qpos, qvel = clean.qpos[steps], clean.qvel[steps]
        alike = aligned_similarity(qpos[None], qvel[None], oracle)[0]
        real_time = oracle.true_similarity(qpos, qvel)
        assert real_time < alike - 0.5
        assert alike > least
    assert alike < 4.5


def test_alignment_is_the_cheapest_path():
    """Against all paths of a small case."""
    rng = np.random.default_rng(0)
    costs, band = rng.random((3, 5, 6)), 2

    def allowed(path):
        near = all(abs(e - f) <= band for f, e in enumerate(path))
        return near and all(0 <= b - a <= 3 for a, b in itertools.pairwise(path))

    paths = [path for path in itertools.product(range(6), repeat=5) if allowed(path)]
    for episode, found in zip(costs, align(costs, band), strict=True):
        totals = {path: sum(episode[f, e] for f, e in enumerate(path)) for path in paths}
        assert tuple(found) == min(totals, key=totals.__getitem__)
    with pytest.raises(ValueError, match="an episode of 2 moments cannot follow 5 within 2"):
        align(costs[:, :, :2], band)


def test_errors_are_in_variances_of_the_demo_and_see_no_whole_turns(clean):
    turned = clean.obs.copy()
    turned[:, 1] += 2 * np.pi
    np.testing.assert_allclose(state_errors(turned[None], clean.obs), 0, atol=1e-20)
    higher = clean.obs.copy()
    higher[:, 0] += 2 * clean.obs[:, 0].std()
    np.testing.assert_allclose(state_errors(higher[None, :300], clean.obs), np.full((1, 300), 4 / 12))


def test_the_best_error_is_the_least():
    values = np.array([1.0, 3.0])
    assert spread("net_turns", values) == {"mean": 2, "best": 3, "worst": 1}
    assert spread("state_error", values) == {"mean": 2, "best": 1, "worst": 3}
    assert spread("true_similarity", None) is None


def test_the_true_rating_is_the_oracles(clean, tmp_path):
    """What the ceiling learns from, beside what the simulated rater says of the same states."""
    demo = find_demo("hopper-flip-clean", tmp_path)
    hop = load_hidden(BUILT_IN / "hopper-hop.hidden.npz")
    snapshot, oracle = TrueRating(demo, clean), Oracle(clean, budget=0)
    frames, dt = np.arange(demo.frames), robot_named("hopper").dt
    steps = steps_of_frames(demo.frames, dt, demo.fps)
    assert (snapshot.ratings(frames, clean.obs[steps], clean.actions[steps]) == 5).all()
    ratings = snapshot.ratings(frames, hop.obs[steps], hop.actions[steps])
    wanted = [
        oracle.rating_of(oracle.distance(hop.qpos[s : s + 1], hop.qvel[s : s + 1], s))[0] for s in steps
    ]
    np.testing.assert_array_equal(ratings, wanted)
    assert {1, 2} < set(ratings.tolist())
