import numpy as np
import pytest
import torch

from onedemo.reward.model import PredictorConfig, Snapshot, View, fit, visual_inputs
from onedemo.reward.two_branch_net import SimilarityNet, class_weights, standard_inputs
from onedemo.storage.rating_records import RatedSegment
from onedemo.types import Segment

FRAMES = 60


def paper(**changes):
    return PredictorConfig(**({"kind": "network", "appearance": False, "members": 1} | changes))


QUICK = paper(updates=60, visual_dims=8)
"""Where it does not matter how well it fits."""


@pytest.fixture(scope="module")
def visual():
    features = np.random.default_rng(0).normal(size=(FRAMES, 40)).cumsum(axis=0)
    return View(
        visual=visual_inputs(features, 8), track=None, basis=np.ones((FRAMES, 1), np.float32), fps=30.0
    )


def world(count, seed, skew=False):
    """Ratings that follow a rule of both frame and state: near when height matches frame / 60."""
    rng = np.random.default_rng(seed)
    ratings, frames = [], []
    for event in range(count):
        first = int(rng.integers(0, FRAMES - 10))
        shown = first + np.arange(38) // 4
        height = rng.uniform(0, 1) if not skew else min(1.0, first / FRAMES + rng.uniform(0.3, 1.0))
        obs = np.zeros((38, 11))
        obs[:, 0] = height + rng.normal(0, 0.02, 38)
        distance = abs(height - first / FRAMES)
        value = 5 - int(np.digitize(distance, [0.08, 0.18, 0.3, 0.45]))
        segment = Segment(
            obs=obs, actions=rng.normal(size=(38, 3)), qpos=np.zeros((38, 6)), qvel=np.zeros((38, 6))
        )
        ratings.append(RatedSegment(event=event, demo_step=first, segment=segment, value=value))
        frames.append(shown)
    return ratings, np.array(frames)


def test_standard_inputs_do_not_count_turns():
    obs, actions = np.random.default_rng(0).normal(size=(5, 11)), np.array([[3.0, -3.0, 0.5]] * 5)
    turned = obs.copy()
    turned[:, 1] -= 2 * np.pi
    np.testing.assert_allclose(standard_inputs(obs, actions), standard_inputs(turned, actions), atol=1e-6)
    assert standard_inputs(obs, actions)[0, -3:].tolist() == [1.0, -1.0, 0.5]


def test_visual_inputs_keep_distances_and_do_not_depend_on_the_svds_signs():
    features = np.random.default_rng(1).normal(size=(30, 6))
    all_components = visual_inputs(features, 6).astype(float)
    scale = all_components[:, 0].std() / visual_inputs(features, 1).astype(float)[:, 0].std()
    assert scale == pytest.approx(1, abs=1e-5)
    ratio = np.linalg.norm(features[3] - features[9]) / np.linalg.norm(all_components[3] - all_components[9])
    ratio_2 = np.linalg.norm(features[1] - features[2]) / np.linalg.norm(
        all_components[1] - all_components[2]
    )
    assert ratio == pytest.approx(ratio_2, rel=1e-5)
    np.testing.assert_allclose(visual_inputs(features, 3), visual_inputs(features.copy(), 3))
    assert visual_inputs(features, 0).shape == (30, 6)


def test_the_sum_of_two_maps_is_the_papers_concatenation(visual):
    net = SimilarityNet(8, 15, paper(), torch.Generator().manual_seed(0))
    v, s = torch.randn(7, 8), torch.randn(7, 15)
    weight = torch.cat([net.fuse_visual.weight, net.fuse_standard.weight], dim=1)
    joined = torch.cat([v, net.standard(s)], dim=1) @ weight.T + net.fuse_standard.bias
    torch.testing.assert_close(net(v, s), net.head(joined))


def test_the_network_is_the_papers():
    net = SimilarityNet(8, 15, paper(), torch.Generator())
    kinds = [type(m).__name__ for m in net.standard]
    assert kinds == ["Linear", "ReLU", "Linear", "ReLU"]
    assert [type(m).__name__ for m in net.head] == ["ReLU", "Linear", "ReLU", "Linear"]
    plain = SimilarityNet(8, 15, paper(additional_layer=False), torch.Generator())
    assert [type(m).__name__ for m in plain.head] == ["ReLU", "Linear"]


@pytest.mark.slow
def test_it_learns_a_rule_of_frame_and_state(visual):
    ratings, frames = world(300, seed=0)
    snapshot, stats = fit(ratings, frames, visual, paper(updates=800, visual_dims=8), number=1, seed=0)
    unseen, unseen_frames = world(200, seed=1)
    truth = np.array([r.value for r in unseen])
    predicted = np.array(
        [
            snapshot.ratings(f, r.segment.obs, r.segment.actions).mean()
            for r, f in zip(unseen, unseen_frames, strict=True)
        ]
    )
    assert stats.accuracy > 0.9
    assert np.corrcoef(predicted, truth)[0, 1] > 0.8
    # With the frames shuffled the same states must be worth less: the visual branch matters.
    shuffled = np.random.default_rng(2).permutation(unseen_frames)
    blind = np.array(
        [
            snapshot.ratings(f, r.segment.obs, r.segment.actions).mean()
            for r, f in zip(unseen, shuffled, strict=True)
        ]
    )
    assert np.corrcoef(blind, truth)[0, 1] < 0.6


@pytest.mark.slow
def test_same_ratings_and_seed_give_the_same_predictor(visual):
    ratings, frames = world(40, seed=0)
    one, _ = fit(ratings, frames, visual, QUICK, number=1, seed=5)
    two, _ = fit(ratings, frames, visual, QUICK, number=1, seed=5)
    other, _ = fit(ratings, frames, visual, QUICK, number=1, seed=6)
    question = (frames[0], ratings[0].segment.obs, ratings[0].segment.actions)
    np.testing.assert_array_equal(one.probabilities(*question), two.probabilities(*question))
    assert (one.probabilities(*question) != other.probabilities(*question)).any()


def test_a_fit_leaves_the_global_generator_alone(visual):
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    fit(*world(10, seed=0), visual, paper(updates=2, visual_dims=8), number=1, seed=0)
    assert torch.equal(torch.rand(3), expected)


def test_equal_batches_find_rare_classes_better(visual):
    ratings, frames = world(400, seed=0, skew=True)
    assert sum(r.value >= 4 for r in ratings) < 40
    unseen, unseen_frames = world(300, seed=1)
    recall = {}
    for sampling in ("equal", "random"):
        config = paper(sampling=sampling, updates=150, visual_dims=8)
        snapshot, _ = fit(ratings, frames, visual, config, number=1, seed=0)
        rare = [(r, f) for r, f in zip(unseen, unseen_frames, strict=True) if r.value >= 4]
        hits = [snapshot.ratings(f, r.segment.obs, r.segment.actions).mean() > 2.5 for r, f in rare]
        recall[sampling] = np.mean(hits)
    assert recall["equal"] > recall["random"]


def test_absent_classes_do_no_harm(visual):
    ratings, frames = world(60, seed=0)
    only = [i for i, r in enumerate(ratings) if r.value in (1, 3)]
    chosen = [ratings[i] for i in only]
    for config in (QUICK, paper(class_weights=True, updates=50, visual_dims=8)):
        snapshot, stats = fit(chosen, frames[only], visual, config, number=1, seed=0)
        assert np.isfinite(stats.loss)
        probabilities = snapshot.probabilities(frames[0], chosen[0].segment.obs, chosen[0].segment.actions)
        assert np.isfinite(probabilities).all()


def test_one_rating_is_enough_and_none_is_not(visual):
    ratings, frames = world(1, seed=0)
    fit(ratings, frames, visual, paper(updates=3, visual_dims=8), number=1, seed=0)
    with pytest.raises(ValueError, match="at least one rating"):
        fit([], np.empty((0, 38)), visual, QUICK, number=1, seed=0)


def test_ratings_are_expectations_or_classes(visual):
    ratings, frames = world(40, seed=0)
    question = (
        frames,
        np.stack([r.segment.obs for r in ratings]),
        np.stack([r.segment.actions for r in ratings]),
    )
    snapshot, _ = fit(ratings, frames, visual, QUICK, number=1, seed=0)
    probabilities = snapshot.probabilities(*question)
    assert probabilities.shape == (40, 38, 5)
    np.testing.assert_allclose(probabilities.sum(axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(snapshot.ratings(*question), probabilities @ np.arange(1, 6), rtol=1e-5)
    config = paper(updates=60, visual_dims=8, reward="argmax")
    hard, _ = fit(ratings, frames, visual, config, number=1, seed=0)
    assert set(np.unique(hard.ratings(*question))) <= {1.0, 2.0, 3.0, 4.0, 5.0}


def test_a_saved_snapshot_is_the_same(visual, tmp_path):
    ratings, frames = world(20, seed=0)
    snapshot, _ = fit(ratings, frames, visual, QUICK, number=4, seed=0)
    snapshot.save(tmp_path / "s" / "000004.pt")
    again = Snapshot.load(tmp_path / "s" / "000004.pt")
    question = (frames[0], ratings[0].segment.obs, ratings[0].segment.actions)
    assert (again.number, again.config) == (4, QUICK)
    np.testing.assert_array_equal(again.probabilities(*question), snapshot.probabilities(*question))


def test_class_weights_by_hand():
    # 8 ratings in 3 classes present: weight = 8 / (3 * count); an absent class weighs nothing.
    weights = class_weights(torch.tensor([4, 2, 2, 0, 0]))
    torch.testing.assert_close(weights, torch.tensor([8 / 12, 8 / 6, 8 / 6, 0.0, 0.0]))


def asked(snapshot, ratings, frames):
    """Probabilities of each member for the middle of each clip, (members, n, 5)."""
    obs, actions = (np.stack([getattr(r.segment, n)[19] for r in ratings]) for n in ("obs", "actions"))
    return snapshot.member_probabilities(frames[:, 19], obs, actions)


def test_members_differ_and_are_averaged(visual):
    ratings, frames = world(60, seed=0)
    config = paper(members=3, updates=100, visual_dims=8)
    snapshot, stats = fit(ratings, frames, visual, config, number=1, seed=0)
    members = asked(snapshot, ratings, frames)
    assert members.shape == (3, 60, 5)
    assert np.abs(members[0] - members[1]).mean() > 0.01 < np.abs(members[1] - members[2]).mean()
    one = ratings[0].segment
    np.testing.assert_allclose(
        snapshot.probabilities(frames[0], one.obs, one.actions),
        snapshot.member_probabilities(frames[0], one.obs, one.actions).mean(axis=0),
    )
    assert np.isfinite(stats.loss)


def test_each_member_is_spared_some_of_the_ratings(visual):
    """So they can disagree: with one rating of 5 among many of 1, one that never saw it expects none."""
    ratings, frames = world(300, seed=0)
    fives, ones = ([i for i, r in enumerate(ratings) if r.value == value] for value in (5, 1))
    some = [fives[0], *ones[:30]]
    config = paper(members=12, updates=60, visual_dims=8)
    snapshot, _ = fit([ratings[i] for i in some], frames[some], visual, config, number=1, seed=0)
    expected = asked(snapshot, [ratings[fives[0]]], frames[fives[:1]])[:, 0] @ np.arange(1, 6)
    assert expected.min() < 1.5 and np.median(expected) > 3


def test_an_ordinal_fit_holds_neighbours_for_likelier(visual):
    ratings, frames = world(300, seed=0)
    chances = {}
    for ordinal in (True, False):
        config = paper(ordinal=ordinal, updates=600, hidden=32, visual_dims=8)
        snapshot, stats = fit(ratings, frames, visual, config, number=1, seed=0)
        assert stats.accuracy > 0.4
        best = [i for i, r in enumerate(ratings) if r.value == 5]
        chances[ordinal] = asked(snapshot, [ratings[i] for i in best], frames[best])[0].mean(axis=0)
    assert (np.diff(chances[True]) > 0).all()  # from 1 to 5, each likelier than the one before
    assert chances[True][3] > chances[False][3] and chances[True][4] < chances[False][4]


def test_saved_members_are_the_same(visual, tmp_path):
    ratings, frames = world(20, seed=0)
    config = paper(members=2, updates=20, visual_dims=8)
    snapshot, _ = fit(ratings, frames, visual, config, number=4, seed=0)
    snapshot.save(tmp_path / "4.pt")
    again = Snapshot.load(tmp_path / "4.pt")
    np.testing.assert_array_equal(asked(again, ratings, frames), asked(snapshot, ratings, frames))


@pytest.mark.parametrize("change", [{"sampling": "x"}, {"reward": "x"}, {"hidden": 0}, {"learning_rate": 0}])
def test_bad_settings_say_which(change):
    with pytest.raises(ValueError, match=f"predictor.{next(iter(change))}"):
        paper(**change)
