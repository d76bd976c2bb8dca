import numpy as np
import pytest
import torch
from worlds import FRAMES, STEPS, small_config

from trainer.choice import choose
from trainer.errors import UserError
from trainer.learner import Learner
from trainer.rollouts import evaluate
from trainer.store import RatedSegment


@pytest.fixture(scope="module")
def features():
    return np.random.default_rng(0).normal(size=(FRAMES, 20)).cumsum(axis=0).astype(np.float32)


def make_learner(features, config=None):
    learner = Learner(config or small_config(), FRAMES, 30.0)
    learner.look_at(features)
    return learner


def rated(learner, count=20, seed=0):
    """Ratings of random clips by a fixed rule: the more the foot points down, the better."""
    rollouts = learner.random_rollouts()
    questions = choose(rollouts, count, learner.clip_steps, learner.demo_steps, np.random.default_rng(seed))
    ratings = []
    for event, q in enumerate(questions):
        segment = rollouts.segment(q.lane, q.start, learner.clip_steps)
        value = int(np.clip(round(3 + 4 * segment.obs[:, 4].mean()), 1, 5))
        ratings.append(RatedSegment(event=event, demo_step=q.demo_step, segment=segment, value=value))
    return ratings


def test_time(features):
    learner = make_learner(features)
    assert learner.demo_steps == STEPS
    assert learner.clip_steps == 38
    assert learner.frames_of(np.array([0, 4, 5, 125, 249, 400])).tolist() == [0, 0, 1, 30, 59, 59]


def test_a_demo_shorter_than_a_clip_is_refused():
    with pytest.raises(UserError, match="shorter than a clip"):
        Learner(small_config(), 8, 30.0)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(UserError, match="device cuda: this PyTorch cannot use it; choose one of: cpu"):
        Learner(small_config(device="cuda"), FRAMES, 30.0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_learning_on_the_gpu_is_learning_on_the_cpu(features):
    """The same draws, so the same first iteration but for rounding."""
    figures = []
    for device in ("cpu", "cuda"):
        learner = make_learner(features, small_config(device=device))
        snapshot, stats = learner.fit(rated(learner), 1)
        figures.append([stats.loss, *learner.iterate(snapshot)[1].values()])
    np.testing.assert_allclose(*figures, rtol=0.05, atol=1e-3)


def test_any_number_of_threads_gives_the_same_policy(features):
    ends = []
    for threads in (1, 2):
        learner = make_learner(features, small_config(rollouts__threads=threads))
        snapshot, _ = learner.fit(rated(learner), 1)
        for _ in range(3):
            learner.iterate(snapshot)
        ends.append(learner.policy().weights)
    for one, two in zip(*ends, strict=True):
        np.testing.assert_array_equal(one, two)


def test_the_random_rollouts_are_the_same_each_time(features):
    learner = make_learner(features)
    one, two = learner.random_rollouts(), learner.random_rollouts()
    np.testing.assert_array_equal(one.qpos, two.qpos)
    assert one.clock.shape == (16, STEPS) and one.clock[:, 0].max() == 0


def test_predicted_rating_of_a_clip_is_the_mean_over_its_steps(features):
    learner = make_learner(features)
    ratings = rated(learner)
    snapshot, _ = learner.fit(ratings, 1)
    one = ratings[0]
    single = [
        snapshot.ratings(
            learner.frames_of(np.array([one.demo_step + i])),
            one.segment.obs[i : i + 1],
            one.segment.actions[i : i + 1],
        )[0]
        for i in range(38)
    ]
    assert learner.predict(snapshot, one.segment, one.demo_step) == pytest.approx(np.mean(single), abs=1e-4)


def test_practice_raises_the_predicted_rating(features):
    config = small_config(
        rollouts__lanes=16, rollouts__steps=125, rollouts__total_steps=10**6, predictor__updates=200
    )
    learner = make_learner(features, config)
    snapshot, _ = learner.fit(rated(learner, 40), 1)

    def whole_episodes():
        episodes = evaluate(learner.policy(), "hopper", episodes=4, seed=9)
        frames = learner.frames_of(episodes.clock[:, :-1])
        return snapshot.ratings(frames, episodes.obs[:, :-1], episodes.actions).mean()

    before = whole_episodes()
    for _ in range(20):
        learner.iterate(snapshot)
    assert whole_episodes() > before + 0.3


def test_a_resumed_learner_does_what_the_uninterrupted_one_does(features, tmp_path):
    config = small_config()
    ratings = rated(make_learner(features, config))

    def curves(learner, count):
        snapshot, _ = learner.fit(ratings, 1)
        return [learner.iterate(snapshot)[1] for _ in range(count)]

    whole = make_learner(features, config)
    expected = curves(whole, 5)
    first = make_learner(features, config)
    curves(first, 2)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    second = make_learner(features, config)
    second.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert curves(second, 3) == expected[2:]
    assert (second.iteration, second.env_steps) == (whole.iteration, whole.env_steps)


def test_the_last_iteration_ends_at_the_limit(features):
    learner = make_learner(features, small_config(rollouts__total_steps=900))
    snapshot, _ = learner.fit(rated(learner), 1)
    steps = []
    while learner.env_steps < 900:
        learner.iterate(snapshot)
        steps.append(learner.env_steps)
    assert steps == [400, 800, 904]  # 8 lanes: the limit is passed by less than one step of each
