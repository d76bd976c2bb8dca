import numpy as np
import pytest
import torch

from helpers.small_world import FRAME_STEPS, FRAMES, STEPS, falling_states, falling_track, small_config
from onedemo.errors import UserError
from onedemo.evaluation.episodes import summarise
from onedemo.reward.learned_distance import MetricSnapshot
from onedemo.rl.rollouts import evaluate
from onedemo.storage.rating_records import RatedSegment
from onedemo.training.learner import Learner


@pytest.fixture(scope="module")
def features():
    return np.random.default_rng(0).normal(size=(FRAMES, 20)).cumsum(axis=0).astype(np.float32)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)  # as a run does


def onedemo(**overrides):
    """The method's own settings, in small; episodes end early and start in the reset buffer."""
    own = {"method": "onedemo", "ratings__rounds": 2, "practice__give_up": 0.3, "practice__bank_tries": 1000}
    return small_config(**own | overrides)


def onedemo_alone(**overrides):
    """With one predictor in place of several, where it does not matter how well it judges."""
    return onedemo(predictor__members=1, **overrides)


CONFIGS = {"paper": small_config, "onedemo": onedemo_alone}
METHODS = pytest.mark.parametrize("method", CONFIGS)


def make_learner(features, config=None):
    config = config or small_config()
    learner = Learner(config, FRAMES, 30.0)
    learner.look_at(features, falling_track() if config.predictor.appearance else None)
    return learner


def rated(learner, count=20, seed=0):
    """Ratings of random clips by a fixed rule: the more the foot points down, the better."""
    rollouts = learner.random_rollouts()
    questions = learner.choose(rollouts, None, count, np.random.default_rng(seed))
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


@pytest.mark.slow
@METHODS
def test_any_number_of_threads_gives_the_same_policy(features, method):
    ends = []
    for threads in (1, 2):
        learner = make_learner(features, CONFIGS[method](rollouts__threads=threads))
        snapshot, _ = learner.fit(rated(learner), 1)
        for _ in range(2):
            learner.iterate(snapshot)
        ends.append(learner.policy().weights)
    for one, two in zip(*ends, strict=True):
        np.testing.assert_array_equal(one, two)


@METHODS
def test_looking_at_how_it_goes_changes_nothing_that_is_learned(features, method):
    """To the bit, and whatever else draws from NumPy or torch goes on as it would have."""
    ends = []
    for looked in (False, True):
        learner = make_learner(features, CONFIGS[method]())
        ratings = rated(learner, 30)
        snapshot, _ = learner.fit(ratings[:20], 1)
        np.random.seed(1)
        torch.manual_seed(1)
        for _ in range(2):
            if looked:
                told = learner.forecast(snapshot, ratings[20:])
            rollouts, stats = learner.iterate(snapshot)
            if looked:
                figures = learner.diagnose(rollouts, snapshot)
        draws = [np.random.random(), float(torch.rand(1))]
        ends.append([*learner.policy().weights, np.array([*draws, stats["predicted"], stats["kl"]])])
    for one, two in zip(*ends, strict=True):
        np.testing.assert_array_equal(one, two)
    assert told["new"] == 10 and 0 <= told["hits"] <= 10 and 2 <= told["confidence"] <= 10
    assert learner.forecast(snapshot, []) == {}
    assert figures["disagreement"] >= 0 and set(learner.seconds) == {"rollouts", "policy"}
    if method == "paper":
        assert figures["reference"] is None
        return
    # What does exactly as the demo shows is rated best of all.
    frames = np.arange(0, FRAMES, 7)
    itself = snapshot.ratings(frames, falling_states().obs[FRAME_STEPS][frames], np.zeros((len(frames), 3)))
    np.testing.assert_allclose(itself, figures["reference"], atol=0.02)  # whatever effort counts
    assert 1 < figures["reference"] <= 5


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


@pytest.mark.slow
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


@pytest.mark.slow
@METHODS
def test_a_resumed_learner_does_what_the_uninterrupted_one_does(features, tmp_path, method):
    config = CONFIGS[method]() if method == "paper" else onedemo_alone(practice__give_up=0.5)
    ratings = rated(make_learner(features, config))

    def curves(learner, count):
        snapshot, _ = learner.fit(ratings, 1)
        return [learner.iterate(snapshot)[1] for _ in range(count)]

    whole = make_learner(features, config)
    expected = curves(whole, 4)
    first = make_learner(features, config)
    curves(first, 2)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    second = Learner(config, FRAMES, 30.0)
    second.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    second.look_at(features, falling_track() if method == "onedemo" else None)  # in the order of a run
    assert curves(second, 2) == expected[2:]
    assert (second.iteration, second.env_steps) == (whole.iteration, whole.env_steps)


def test_the_last_iteration_ends_at_the_limit(features):
    learner = make_learner(features, small_config(rollouts__total_steps=900))
    snapshot, _ = learner.fit(rated(learner), 1)
    steps = []
    while learner.env_steps < 900:
        learner.iterate(snapshot)
        steps.append(learner.env_steps)
    assert steps == [400, 800, 904]  # 8 lanes: the limit is passed by less than one step of each


# The onedemo method


@pytest.fixture(scope="module")
def by_distance():
    """Rates as someone does who sees the demo: by height and by the torso's direction and spin."""
    demo = falling_states().obs

    def rate(segment, demo_step):
        there = demo[demo_step : demo_step + len(segment)]
        off = np.abs(segment.obs - there)
        turned = 2 * np.abs(np.sin((segment.obs[:, 1] - there[:, 1]) / 2))
        distance = (off[:, 0] + turned + 0.1 * np.minimum(off[:, 7], 10)).mean()
        return 5 - int(np.digitize(distance, [0.35, 0.7, 1.1, 1.6]))

    return rate


def asked(learner, rate, count, snapshot=None, seed=0):
    """Ratings of what the method itself would ask before practice."""
    rollouts = learner.random_rollouts()
    questions = learner.choose(rollouts, snapshot, count, np.random.default_rng(seed))
    segments = [rollouts.segment(q.lane, q.start, learner.clip_steps) for q in questions]
    return [
        RatedSegment(event=i, demo_step=q.demo_step, segment=segment, value=rate(segment, q.demo_step))
        for i, (q, segment) in enumerate(zip(questions, segments, strict=True))
    ]


def test_the_method_asks_about_random_states_beside_any_moment(features):
    learner = make_learner(features, onedemo())
    rollouts = learner.random_rollouts()
    headings = rollouts.qpos[:, 0, 2]
    assert np.ptp(headings) > 2  # nobody stands
    questions = learner.choose(rollouts, None, 40, np.random.default_rng(0))
    off = [q.demo_step - rollouts.clock[q.lane, q.start] for q in questions]
    assert np.ptp(off) > 60
    # The paper: the random policy from standing, side by side with the same moment.
    paper = make_learner(features)
    standing = paper.random_rollouts()
    assert np.abs(standing.qpos[:, 0, 2]).max() < 0.01
    for q in paper.choose(standing, None, 40, np.random.default_rng(0)):
        assert q.demo_step == standing.clock[q.lane, q.start]


@pytest.mark.slow
def test_with_a_predictor_it_asks_about_better_clips(features, by_distance):
    learner = make_learner(features, onedemo())
    first = asked(learner, by_distance, 60)
    snapshot, _ = learner.fit(first, 1)
    mean = {}
    for name, judge in (("blind", None), ("judged", snapshot)):
        values = [r.value for seed in range(3) for r in asked(learner, by_distance, 25, judge, seed=seed + 1)]
        mean[name] = np.mean(values)
    assert mean["judged"] > mean["blind"] + 0.4
    assert learner.predict(snapshot, first[0].segment, first[0].demo_step) == pytest.approx(
        snapshot.clip_ratings(
            learner.frames_of(first[0].demo_step + np.arange(38))[None],
            first[0].segment.obs[None],
            first[0].segment.actions[None],
        )[0][0],
        abs=1e-4,
    )
    uniform = make_learner(features, onedemo(ratings__choice="uniform"))
    assert uniform.choose(
        learner.random_rollouts(), snapshot, 10, np.random.default_rng(0)
    ) == uniform.choose(learner.random_rollouts(), None, 10, np.random.default_rng(0))


def test_once_it_practises_clips_are_asked_beside_their_own_moment(features, by_distance):
    learner = make_learner(features, onedemo())
    snapshot, _ = learner.fit(asked(learner, by_distance, 30), 1)
    rollouts, _ = learner.iterate(snapshot)
    questions = learner.choose(rollouts, snapshot, 5, np.random.default_rng(0))
    assert questions
    for q in questions:
        assert q.demo_step == max(0, rollouts.clock[q.lane, q.start + 19] - 19)


def test_the_policy_sees_what_the_demo_shows_now_and_ahead(features):
    learner = make_learner(features, onedemo())
    track = falling_track()
    shown = np.concatenate([track.pose, track.motion], axis=1)
    for step in (0, 100, STEPS - 1):
        ahead = [min(step + round(seconds / 0.008), STEPS - 1) for seconds in (0.0, 0.13, 0.33)]
        expected = shown[learner.frames_of(np.array(ahead))].ravel()
        np.testing.assert_allclose(learner._policy.table[step], expected)
        seen = learner.policy().inputs(np.zeros((1, 11)), np.array([step]))[0, -expected.size :]
        np.testing.assert_allclose(seen, expected, atol=1e-5)  # nothing is normalised yet


@pytest.mark.slow
def test_of_another_body_it_sees_pictures_and_imagines_poses(features):
    """No track: what the frames look like takes its place in the policy, and the predictor makes one up."""
    learner = Learner(onedemo(predictor__members=1), FRAMES, 30.0)
    learner.look_at(features, None)
    snapshot, _ = learner.fit(rated(learner), 1)
    assert isinstance(snapshot, MetricSnapshot)
    assert np.ptp(learner._policy.table, axis=0).max() > 0.5
    _, stats = learner.iterate(snapshot)
    assert 1 <= stats["predicted"] <= 5


@pytest.mark.slow
def test_practice_follows_the_predictor(features, by_distance):
    """Starts from its reset buffer, an adaptive phase, early ends; rewards of all that."""
    learner = make_learner(features, onedemo(rollouts__lanes=32, rollouts__steps=100))
    snapshot, _ = learner.fit(asked(learner, by_distance, 60), 1)
    assert isinstance(snapshot, MetricSnapshot)
    rollouts, stats = learner.iterate(snapshot)
    again, _ = learner.iterate(snapshot)
    moved = rollouts.next_clock - rollouts.clock
    assert set(np.unique(moved)) == {0, 1, 2, 3}
    assert rollouts.terminated.any()
    ended = rollouts.terminated | rollouts.truncated
    lanes, steps = np.nonzero(ended[:, :-1])
    banked = np.abs(rollouts.qpos[lanes, steps + 1, 2]) > 0.01
    assert 0.25 < banked.mean() < 0.75
    assert len(np.unique(rollouts.clock[lanes, steps + 1])) > 3
    frames = learner.frames_of(np.minimum(rollouts.next_clock, STEPS - 1))
    similar = (snapshot.ratings(frames, rollouts.next_obs, rollouts.actions) - 1) / 4
    np.testing.assert_allclose(rollouts.rewards, similar * moved, atol=1e-5)
    assert stats["mean_reward"] == pytest.approx(rollouts.rewards.mean())
    assert stats["predicted"] == pytest.approx(1 + 4 * rollouts.rewards.sum() / moved.sum())
    np.testing.assert_array_equal(rollouts.next_qpos[:, -1][~ended[:, -1]], again.qpos[:, 0][~ended[:, -1]])


@pytest.mark.slow
def test_a_new_snapshot_fills_a_new_reset_buffer(features, by_distance):
    learner = make_learner(features, onedemo_alone())
    ratings = asked(learner, by_distance, 40)
    buffers = []
    for number, some in ((1, ratings[:20]), (1, ratings[:20]), (2, ratings)):
        learner.iterate(learner.fit(some, number)[0])
        buffers.append(learner._buffer)
    assert buffers[0] is buffers[1] is not buffers[2]
    assert not np.array_equal(buffers[0].qpos, buffers[2].qpos)


@pytest.mark.slow
def test_onedemo_end_to_end_learns_to_be_like_the_demo(features, by_distance):
    """From sixty ratings in two rounds to a policy that gets more of the demo done from standing."""
    config = onedemo(rollouts__lanes=16, rollouts__steps=125, rollouts__total_steps=20_000)
    learner = make_learner(features, config)
    ratings = asked(learner, by_distance, 30)
    snapshot, _ = learner.fit(ratings, 1)
    ratings += asked(learner, by_distance, 30, snapshot, seed=1)
    snapshot, stats = learner.fit(ratings, 2)
    assert stats.accuracy > 0.5

    def whole_episodes():
        rules = learner.rules(8, snapshot)
        episodes = evaluate(learner.policy(), "hopper", episodes=8, seed=9, rules=rules, nthread=0)
        return episodes.rewards.sum(axis=1).mean()

    before, curve = whole_episodes(), []
    while learner.env_steps < 20_000:
        curve.append(learner.iterate(snapshot)[1])
    assert whole_episodes() > 1.2 * before
    assert learner.iterate(snapshot)[1]["kl"] <= config.trpo.final_kl < curve[0]["kl"]  # the region shrank


def test_a_policy_is_summarised_before_there_is_a_predictor(features):
    summary = summarise(make_learner(features, onedemo()), None, None)
    assert summary["predicted_similarity"] is None and summary["net_turns"]["mean"] == 0


@pytest.mark.slow
def test_evaluation_uses_the_adaptive_phase(features, by_distance):
    learner = make_learner(features, onedemo_alone())
    snapshot, _ = learner.fit(asked(learner, by_distance, 30), 1)
    episodes = evaluate(learner.policy(), "hopper", episodes=4, rules=learner.rules(4, snapshot), nthread=0)
    moves = np.diff(episodes.clock, axis=1)
    assert episodes.clock.max() <= STEPS and set(np.unique(moves)) <= {0, 1, 2, 3} and (moves != 1).any()
    paper = make_learner(features)
    snapshot, _ = paper.fit(rated(paper), 1)
    episodes = evaluate(paper.policy(), "hopper", episodes=4, rules=paper.rules(4, snapshot), nthread=0)
    assert (np.diff(episodes.clock, axis=1) == 1).all()


def test_random_starts_count_from_anywhere_in_the_demo(features):
    """Clips paired by time then show all of it, although random motion lasts a second."""
    learner = make_learner(features, onedemo(ratings__pairing="time"))
    rollouts = learner.random_rollouts()
    whole = ~(rollouts.terminated | rollouts.truncated)
    assert (np.diff(rollouts.clock, axis=1)[whole[:, :-1]] == 1).all()
    assert rollouts.clock.min() < 10 and rollouts.next_clock.max() > STEPS - 10
    assert rollouts.next_clock.max() <= STEPS
    asked = learner.choose(rollouts, None, 200, np.random.default_rng(0))
    counts, _ = np.histogram([q.demo_step for q in asked], bins=4, range=(0, STEPS - 38))
    assert counts.min() > 10
