"""The learned distance against distances that are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from onedemo.reward.latent_track import track_basis
from onedemo.reward.learned_distance import MetricSnapshot
from onedemo.reward.model import PredictorConfig, Snapshot, View, fit
from onedemo.rl.random_states import wild_rollouts
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.storage.rating_records import RatedSegment
from onedemo.types import Segment
from onedemo.vision.pose_estimator import Track

BODY = body_of(robot_named("hopper"))

STEPS, FRAMES = 38, 60
WEIGHTS = np.repeat([[1.0], [0.2]], BODY.pose_size, axis=1)
"""Of pose and motion: what this rater looks at. Torso alone in the motion, the foot not at all."""
WEIGHTS[0, 7:] = 0.0
WEIGHTS[1, :1] = WEIGHTS[1, 3:] = 0.0
CONFIG = PredictorConfig(members=3)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """As in a run: more would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def rollouts():
    return wild_rollouts("hopper", lanes=24, steps=400, every=100, seed=0, nthread=0)


@pytest.fixture(scope="module")
def view(rollouts):
    """A demo that shows what lane 0 did, for two seconds."""
    obs = rollouts.obs[0, :250][np.round(np.arange(FRAMES) / 30 / 0.008).astype(int)]
    track = Track(pose=BODY.pose(obs).astype(np.float32), motion=BODY.motion(obs).astype(np.float32))
    visual = np.random.default_rng(0).normal(size=(FRAMES, 4)).astype(np.float32)
    return View(visual=visual, track=track, basis=np.ones((len(visual), 1), np.float32), fps=30.0)


def true_distance(view, frames, obs):
    difference = np.stack(
        [view.track.pose[frames] - BODY.pose(obs), view.track.motion[frames] - BODY.motion(obs)],
        axis=-2,
    )
    return np.sqrt((WEIGHTS * np.square(difference)).sum(axis=(-1, -2)))


def world(rollouts, view, count, seed, bounds=(2.1, 2.5, 2.85, 3.2)):
    """Clips at random beside random frames; a rating by bounds of the true distance. And that distance."""
    rng = np.random.default_rng(seed)
    clips, frames = [], []
    for _ in range(count):
        lane, start = int(rng.integers(1, 24)), 100 * int(rng.integers(4)) + int(rng.integers(62))
        clips.append(rollouts.segment(lane, start, STEPS))
        frames.append(int(rng.integers(FRAMES - 10)) + np.arange(STEPS) // 4)
    frames = np.array(frames)
    distance = true_distance(view, frames, np.stack([c.obs for c in clips])).mean(axis=1)
    values = 5 - np.digitize(distance, bounds)
    ratings = [
        RatedSegment(event=i, demo_step=0, segment=clip, value=int(value))
        for i, (clip, value) in enumerate(zip(clips, values, strict=True))
    ]
    return ratings, frames, distance


def predicted(snapshot, ratings, frames):
    obs, actions = (np.stack([getattr(r.segment, name) for r in ratings]) for name in ("obs", "actions"))
    return snapshot.ratings(frames, obs, actions).mean(axis=1)


def rank_correlation(a, b):
    return np.corrcoef(np.argsort(np.argsort(a)), np.argsort(np.argsort(b)))[0, 1]


@pytest.fixture(scope="module")
def fitted(rollouts, view):
    ratings, frames, _ = world(rollouts, view, 300, seed=0)
    assert min(np.bincount([r.value for r in ratings])[1:]) > 15
    return *fit(ratings, frames, view, CONFIG, number=1, seed=0), ratings, frames


def test_it_finds_what_the_rater_looks_at(fitted):
    snapshot, stats, *_ = fitted
    log_weights = snapshot.tensors()["log_weights"].numpy().mean(axis=0)
    gained = log_weights - np.repeat(
        [-1.0, -2.0], BODY.pose_size
    )  # what was taken for granted before any rating
    seen = WEIGHTS.ravel() > 0
    assert gained[seen].mean() > gained[~seen].mean() + 1.0
    assert gained[1:7].min() > gained[7:9].max()  # torso, thigh and leg matter more than the foot
    assert stats.accuracy > 0.6 and stats.loss < np.log(5) / 2


def test_it_ranks_unseen_clips_as_the_true_distance_does(fitted, rollouts, view):
    ratings, frames, distance = world(rollouts, view, 300, seed=1)
    value = predicted(fitted[0], ratings, frames)
    assert rank_correlation(value, -distance) > 0.95
    truth = np.array([r.value for r in ratings])
    assert np.abs(value - truth).mean() < 0.5
    assert np.corrcoef(value, truth)[0, 1] > 0.9


@pytest.mark.slow
def test_a_few_ratings_do(rollouts, view):
    unseen, unseen_frames, distance = world(rollouts, view, 300, seed=1)
    ranks = []
    for seed in range(3):
        ratings, frames, _ = world(rollouts, view, 25, seed=10 + seed)
        snapshot, _ = fit(ratings, frames, view, CONFIG, number=1, seed=0)
        ranks.append(rank_correlation(predicted(snapshot, unseen, unseen_frames), -distance))
    assert min(ranks) > 0.75 and np.mean(ranks) > 0.8


def test_same_ratings_and_seed_give_the_same_fit_and_members_differ(fitted, view):
    snapshot, stats, ratings, frames = fitted
    again, same = fit(ratings, frames, view, CONFIG, number=1, seed=0)
    other, _ = fit(ratings, frames, view, CONFIG, number=1, seed=1)
    one, two, three = (x.tensors()["log_weights"] for x in (snapshot, again, other))
    assert torch.equal(one, two) and stats == same
    assert not torch.equal(one, three)
    assert len(one) == 3 and not torch.equal(one[0], one[1])
    alone, _ = fit(ratings, frames, view, replace(CONFIG, members=1), number=1, seed=0)
    assert len(alone.tensors()["log_weights"]) == 1


def test_a_fit_leaves_the_global_generator_alone(view, fitted):
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    fit(fitted[2][:5], fitted[3][:5], view, CONFIG, number=1, seed=0)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("members", [1, 3])
def test_absent_classes_do_no_harm(rollouts, view, members):
    ratings, frames, distance = world(rollouts, view, 120, seed=2)
    only = [i for i, r in enumerate(ratings) if r.value in (1, 3)]
    config = replace(CONFIG, members=members)
    snapshot, stats = fit([ratings[i] for i in only], frames[only], view, config, number=1, seed=0)
    value = predicted(snapshot, ratings, frames)
    assert np.isfinite(stats.loss) and np.isfinite(value).all()
    assert rank_correlation(value, -distance) > 0.8
    whole = snapshot.tensors()["thresholds"].numpy()
    assert np.isfinite(whole).all() and (np.diff(whole, axis=1) > 0).all()


def test_rare_classes_count_as_much_as_common_ones(rollouts, view):
    """One clip, nine times rated 1 and once 5. Each 1 counts 0.3, the least, and the 5 counts 2.

    So a 5 has a chance of 2 / (2 + 9 * 0.3) = 0.43; counted alike, of 0.1.
    """
    ratings, frames, _ = world(rollouts, view, 1, seed=0)
    ten = [replace(ratings[0], event=i, value=5 if i == 0 else 1) for i in range(10)]
    alone = replace(CONFIG, members=1)
    snapshot, _ = fit(ten, np.repeat(frames, 10, axis=0), view, alone, number=1, seed=0)
    assert predicted(snapshot, ten[:1], frames)[0] == pytest.approx(1 + 4 * 0.43, abs=0.4)


@pytest.mark.parametrize("value", [1, 3, 5])
def test_one_rating_is_enough(rollouts, view, value):
    ratings, frames, _ = world(rollouts, view, 1, seed=0)
    one = [replace(ratings[0], value=value)]
    snapshot, stats = fit(one, frames, view, CONFIG, number=1, seed=0)
    assert np.isfinite(stats.loss) and stats.accuracy == 1.0
    assert predicted(snapshot, one, frames)[0] == pytest.approx(value, abs=0.8)


def test_probabilities_are_an_ordered_logit_of_the_distance(fitted, view):
    snapshot, _, ratings, frames = fitted
    obs = np.stack([r.segment.obs for r in ratings])
    chances = snapshot.member_probabilities(frames, obs, np.zeros((*frames.shape, 3)))
    assert chances.shape == (3, 300, STEPS, 5) and chances.dtype == np.float32
    np.testing.assert_allclose(chances.sum(axis=-1), 1, atol=1e-5)
    assert chances.min() >= 0
    track = np.concatenate([view.track.pose, view.track.motion], axis=-1)
    difference = track[frames] - np.concatenate([BODY.pose(obs), BODY.motion(obs)], axis=-1)
    numbers = {name: x.numpy() for name, x in snapshot.tensors().items() if isinstance(x, torch.Tensor)}
    for member in range(3):
        weights = np.exp(numbers["log_weights"][member])
        distance = np.sqrt(np.square(difference) @ weights + 1e-4).ravel()
        distance -= 0.5 * numbers["effort"][member]  # motors at rest, beside half of what they could do
        at_least = chances[member, ..., ::-1].cumsum(axis=-1)[..., :4].reshape(-1, 4)  # P(y >= 5), ... (2)
        steepness, thresholds = numbers["steepness"][member], numbers["thresholds"][member]
        formula = 1 / (1 + np.exp(-steepness * (thresholds - distance[:, None])))
        np.testing.assert_allclose(at_least, formula, atol=1e-4)
        order = np.argsort(distance)
        assert (np.diff(at_least[order], axis=0) <= 1e-4).all()  # farther is never better, but for rounding
    np.testing.assert_allclose(
        snapshot.probabilities(frames, obs, np.zeros((*frames.shape, 3))), chances.mean(axis=0), atol=1e-6
    )


def test_the_demos_own_states_are_rated_best(fitted, rollouts):
    snapshot = fitted[0]
    steps = np.round(np.arange(FRAMES) / 30 / 0.008).astype(int)
    obs, none = rollouts.obs[0, steps], np.zeros((FRAMES, 3))
    own = snapshot.ratings(np.arange(FRAMES), obs, none)
    others = snapshot.ratings(np.arange(FRAMES), obs[np.random.default_rng(0).permutation(FRAMES)], none)
    assert own.min() > 4.5
    assert others.mean() < 3.5


def test_what_the_motors_do_hardly_matters_to_this_rater_and_turns_do_not_count(fitted, rollouts):
    snapshot, frames, obs = fitted[0], np.arange(20), rollouts.obs[3, :20]
    expected = snapshot.ratings(frames, obs, np.zeros((20, 3)))
    assert np.abs(snapshot.ratings(frames, obs, np.ones((20, 3))) - expected).max() < 0.5
    turned = obs - 4 * np.pi * np.eye(11)[1]
    np.testing.assert_allclose(snapshot.ratings(frames, turned, np.zeros((20, 3))), expected, atol=1e-5)


def shapes_agree(snapshot, rollouts):
    """Candidate frames (C, N) beside states (N, o), and one frame beside many: what practice asks."""
    frames = np.random.default_rng(0).integers(FRAMES, size=(4, 7))
    obs, actions = rollouts.obs[:7, 5], rollouts.actions[:7, 5]
    together = snapshot.ratings(frames, obs, actions)
    assert together.shape == (4, 7)
    for row, shown in zip(together, frames, strict=True):
        np.testing.assert_allclose(row, snapshot.ratings(shown, obs, actions), atol=1e-5)
    one = snapshot.ratings(frames[:1, 0], obs, actions)
    np.testing.assert_allclose(one, snapshot.ratings(np.repeat(frames[0, 0], 7), obs, actions), atol=1e-5)


def test_frames_and_states_are_broadcast_against_each_other(fitted, rollouts, view):
    shapes_agree(fitted[0], rollouts)
    network = PredictorConfig(kind="network", updates=20, members=2)
    shapes_agree(fit(fitted[2], fitted[3], view, network, number=1, seed=0)[0], rollouts)


def test_judging_a_clip_is_the_mean_of_its_steps_and_the_members_quarrel(fitted):
    snapshot, _, ratings, frames = fitted
    obs, actions = (np.stack([getattr(r.segment, n) for r in ratings[:5]]) for n in ("obs", "actions"))
    mean, doubt = snapshot.clip_ratings(frames[:5], obs, actions)
    rated = snapshot.member_probabilities(frames[:5], obs, actions) @ np.arange(1, 6)  # (members, 5, W)
    np.testing.assert_allclose(mean, predicted(snapshot, ratings[:5], frames[:5]), atol=1e-5)
    np.testing.assert_allclose(doubt, rated.mean(axis=-1).std(axis=0), atol=1e-5)
    assert doubt.min() > 0


def test_a_saved_snapshot_is_the_same(fitted, tmp_path):
    snapshot, _, ratings, frames = fitted
    snapshot.save(tmp_path / "000001.pt")
    again = Snapshot.load(tmp_path / "000001.pt")
    assert isinstance(again, MetricSnapshot) and (again.number, again.config) == (1, CONFIG)
    np.testing.assert_array_equal(predicted(again, ratings, frames), predicted(snapshot, ratings, frames))


@pytest.fixture(scope="module")
def blind(view):
    """The same demo, of which only features of its frames are seen: a mixture of the poses."""
    mixture = np.random.default_rng(3).normal(size=(BODY.pose_size, 30))
    features = np.tanh(view.track.pose @ mixture).astype(np.float32)
    return replace(view, track=None, basis=track_basis(features, view.fps))


@pytest.mark.slow
def test_where_no_pose_is_seen_the_ratings_say_what_the_demo_shows(blind, rollouts, view, tmp_path):
    """The track is fitted with the rest; a demo of another body is no different."""
    ratings, frames, _ = world(rollouts, view, 300, seed=0)
    unseen, unseen_frames, distance = world(rollouts, view, 300, seed=1)
    snapshot, _ = fit(ratings, frames, blind, CONFIG, number=2, seed=0)
    value = predicted(snapshot, unseen, unseen_frames)
    # How fast the robot is tells something already; what the frames show has to add to that.
    shuffled = predicted(snapshot, unseen, np.random.default_rng(0).permutation(FRAMES)[unseen_frames])
    assert rank_correlation(value, -distance) > max(0.7, 0.1 + rank_correlation(shuffled, -distance))
    tracks = snapshot.tensors()["tracks"]  # twice as many members, each with a track of its own
    assert len(tracks) == 6 and tracks.std(dim=0).mean(dim=0).min() > 0.01
    alone = replace(CONFIG, members=1)
    one, two = (fit(ratings[:30], frames[:30], blind, alone, number=2, seed=0)[0] for _ in "12")
    np.testing.assert_array_equal(*(predicted(s, unseen, unseen_frames) for s in (one, two)))
    snapshot.save(tmp_path / "000002.pt")
    loaded = Snapshot.load(tmp_path / "000002.pt")
    assert isinstance(loaded, MetricSnapshot) and loaded.number == 2
    np.testing.assert_array_equal(predicted(loaded, unseen, unseen_frames), value)
    shapes_agree(snapshot, rollouts)


def test_an_empty_segment_list_is_refused(view):
    with pytest.raises(ValueError, match="at least one rating"):
        fit([], np.empty((0, STEPS), int), view, CONFIG, number=1, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seen", [True, False])
def test_the_shortest_clips_that_can_be_asked_for(view, blind, seen):
    """0.05 s, six control steps."""
    none = {
        name: np.zeros((6, size)) for name, size in (("obs", 11), ("actions", 3), ("qpos", 6), ("qvel", 6))
    }
    one = RatedSegment(event=0, demo_step=0, segment=Segment(**none), value=2)
    alone = replace(CONFIG, members=1)
    _, stats = fit([one], np.zeros((1, 6), int), view if seen else blind, alone, number=1, seed=0)
    assert np.isfinite(stats.loss)
