from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.small_world import FRAMES, falling_demo, small_config
from onedemo.app.cli.main import main
from onedemo.errors import UserError
from onedemo.reward.latent_track import track_basis
from onedemo.reward.model import PredictorConfig, Snapshot, View, fit, fit_lens
from onedemo.reward.warm_start import newest_snapshot
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.storage.rating_records import RatedSegment
from onedemo.storage.store import Store
from onedemo.training.learner import Learner
from onedemo.training.rating_queue import Simulated
from onedemo.training.runs import add_run
from onedemo.types import Segment
from onedemo.vision.pose_estimator import Track
from unit.reward.test_model import world
from unit.training.test_trainer import by_rule, make_run, work

BODY = body_of(robot_named("hopper"))

NETWORK = PredictorConfig(kind="network", appearance=False, members=2, updates=600, visual_dims=8)
METRIC = PredictorConfig(members=2)
BRIEF = replace(NETWORK, updates=100)
"""Where it does not matter how well it fits."""


def walk(seed, features=40):
    """Features of a demo whose frames change slowly."""
    return np.random.default_rng(seed).normal(size=(FRAMES, features)).cumsum(axis=0).astype(np.float32)


def through(lens, features):
    return View(visual=lens.see(features), track=None, lens=lens, basis=track_basis(features, 30.0), fps=30.0)


def probabilities(snapshot, ratings, frames):
    obs, actions = (np.stack([getattr(r.segment, name) for r in ratings]) for name in ("obs", "actions"))
    return snapshot.probabilities(frames, obs, actions)


def predicted(snapshot, ratings, frames):
    return probabilities(snapshot, ratings, frames).mean(axis=1) @ np.arange(1, 6)


def rank_correlation(snapshot, ratings, frames):
    given = [r.value for r in ratings]
    ranks = [np.argsort(np.argsort(x)) for x in (predicted(snapshot, ratings, frames), given)]
    return np.corrcoef(*ranks)[0, 1]


def test_a_lens_sees_another_demo_as_its_own():
    """A frame that both demos hold looks the same; directions in which no frame differs are blind."""
    one, two = walk(0), walk(1)
    two[7] = one[3]
    lens = fit_lens(one, 8)
    np.testing.assert_array_equal(lens.see(one)[3], lens.see(two)[7])
    assert np.abs(fit_lens(two, 8).see(two)[7] - lens.see(one)[3]).max() > 0.1
    flat = fit_lens(one[:5], 8)  # five frames differ in four directions
    assert flat.axes.shape == (40, 5) and np.count_nonzero(np.abs(flat.axes).sum(axis=0)) == 4


@pytest.mark.slow
def test_a_feature_that_hardly_changed_in_the_first_demo_does_not_make_the_fit_diverge():
    """Of 40 features, ten changed by a millionth in the first demo, and change freely in the second."""
    one, two = walk(0), walk(1)
    one[:, :10] *= 1e-6
    config = replace(NETWORK, visual_dims=0)
    start, _ = fit(*world(60, seed=0), through(fit_lens(one, 0), one), config, number=1, seed=0)
    learner = Learner(small_config(predictor__kind="network", predictor__visual_dims=0), FRAMES, 30.0, start)
    learner.look_at(two)
    ratings, frames = world(60, seed=1)
    tuned, stats = learner.fit(ratings, 1)
    assert np.isfinite(stats.loss) and stats.loss < 1.6, stats
    assert np.isfinite(probabilities(tuned, ratings, frames)).all()


@pytest.mark.slow
def test_a_network_from_another_demo_needs_fewer_ratings():
    """Both demos turn along the same direction of the features; the second begins where the first ends."""
    direction = np.random.default_rng(5).normal(size=40)
    one = (np.linspace(0, 5, FRAMES)[:, None] * direction).astype(np.float32)
    lens = fit_lens(one, 8)
    start, _ = fit(*world(300, seed=0), through(lens, one), NETWORK, number=9, seed=0)
    two = one[::-1]  # frame f of it is frame 59 - f of the first
    few, few_frames = world(8, seed=1)
    unseen, unseen_frames = world(200, seed=2)
    view = through(lens, two)
    tuned, _ = fit(few, FRAMES - 1 - few_frames, view, NETWORK, number=1, seed=0, start=start)
    scratch, _ = fit(few, FRAMES - 1 - few_frames, view, NETWORK, number=1, seed=0)
    reached = [rank_correlation(s, unseen, FRAMES - 1 - unseen_frames) for s in (tuned, scratch)]
    assert reached[0] > 0.75 and reached[0] > reached[1] + 0.15, reached
    # Before any rating it is the start, seen through the start's lens.
    first = start.beside(view)
    assert first.number == 0
    np.testing.assert_allclose(
        probabilities(first, unseen, FRAMES - 1 - unseen_frames), probabilities(start, unseen, unseen_frames),
        atol=1e-5,
    )  # fmt: skip


@pytest.mark.slow
def test_fits_from_the_same_start_are_the_same_and_leave_it_alone():
    view, (ratings, frames) = through(fit_lens(walk(0), 8), walk(0)), world(40, seed=0)
    start, _ = fit(ratings, frames, view, BRIEF, number=1, seed=1)
    before = probabilities(start, ratings, frames)
    one, two = (fit(ratings[:9], frames[:9], view, BRIEF, number=1, seed=2, start=start)[0] for _ in "12")
    np.testing.assert_array_equal(*(probabilities(s, ratings, frames) for s in (one, two)))
    np.testing.assert_array_equal(before, probabilities(start, ratings, frames))


def poses(count, seed, matters):
    """A demo in which the robot stands still at some height and lean, and ratings by one of the two alone.

    Args:
        matters: 0: the height, as far as it is off; 1: the torso's lean.
    """
    rng = np.random.default_rng(seed)
    shown = np.zeros((FRAMES, 11))
    shown[:, 0] = 1.2
    view = View(
        visual=np.zeros((FRAMES, 1), np.float32),
        basis=np.ones((FRAMES, 1), np.float32),
        fps=30.0,
        track=Track(pose=BODY.pose(shown).astype(np.float32), motion=BODY.motion(shown).astype(np.float32)),
    )
    ratings = []
    for event in range(count):
        obs = np.zeros((38, 11))
        off = rng.uniform(-1, 1, 2)
        obs[:, 0], obs[:, 1] = 1.2 + 0.6 * off[0], off[1]
        value = 5 - int(np.digitize(abs(off[matters]), [0.1, 0.3, 0.5, 0.8]))
        zeros = {name: np.zeros((38, n)) for name, n in (("actions", 3), ("qpos", 6), ("qvel", 6))}
        segment = Segment(obs=obs, **zeros)
        ratings.append(RatedSegment(event=event, demo_step=0, segment=segment, value=value))
    return view, ratings, np.zeros((count, 38), int)


@pytest.mark.slow
def test_a_metric_keeps_what_mattered_in_another_demo():
    view, ratings, frames = poses(300, 0, matters=0)
    start, _ = fit(ratings, frames, view, METRIC, number=4, seed=0)
    _, unseen, unseen_frames = poses(300, 1, matters=0)
    few = slice(0, 4)
    tuned, _ = fit(unseen[few], frames[few], view, METRIC, number=1, seed=0, start=start)
    scratch, _ = fit(unseen[few], frames[few], view, METRIC, number=1, seed=0)
    given = np.array([r.value for r in unseen])
    off = [np.abs(predicted(s, unseen, unseen_frames) - given).mean() for s in (tuned, scratch)]
    assert off[0] < 0.4 and off[0] < off[1] - 0.2, off
    # Many ratings to the contrary win over it, a few do not.
    _, other, _ = poses(300, 2, matters=1)
    moved = [
        np.abs(fit(other[:n], frames[:n], view, METRIC, number=1, seed=0, start=start)[0].log_weights
               - start.log_weights).max()
        for n in (3, 300)
    ]  # fmt: skip
    assert moved[0] < 0.5 < 1.0 < moved[1], moved


def test_a_start_of_another_kind_or_size_is_refused():
    seen = through(fit_lens(walk(0), 8), walk(0))
    ratings, frames = world(10, seed=0)
    quick = PredictorConfig(kind="network", members=1, updates=5, visual_dims=8)
    network, _ = fit(ratings, frames, seen, quick, number=1, seed=0)
    view, posed, at = poses(10, 0, matters=0)
    with pytest.raises(UserError, match="of kind 'network', and this run fits one of kind 'metric'"):
        fit(posed, at, view, METRIC, number=1, seed=0, start=network)
    wide = PredictorConfig(kind="network", hidden=32)
    with pytest.raises(UserError, match=r"predictor\.hidden = 64, this run has 32"):
        fit(ratings, frames, seen, wide, number=1, seed=0, start=network)
    blind = View(visual=seen.visual[:, :4], track=None, basis=seen.basis, fps=30.0)
    with pytest.raises(UserError, match="sees 8 numbers of a frame, this run 4"):
        fit(ratings, frames, blind, quick, number=1, seed=0, start=network)
    learner = Learner(small_config(), FRAMES, 30.0, network)
    with pytest.raises(UserError, match="40 features of a frame, encoder efficientnet-lite0 gives 20"):
        learner.look_at(walk(0, features=20))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["network", "metric", "imagined"])
def test_a_saved_start_is_the_same_start(kind, tmp_path):
    if kind == "network":
        config, view = replace(NETWORK, updates=20), through(fit_lens(walk(0), 8), walk(0))
        ratings, frames = world(20, seed=0)
    else:
        config, (view, ratings, frames) = METRIC, poses(20, 0, matters=0)
        if kind == "imagined":
            config, view = replace(METRIC, members=1), replace(view, track=None)
    start, _ = fit(ratings, frames, view, config, number=3, seed=0)
    start.save(tmp_path / "s.pt")
    loaded = Snapshot.load(tmp_path / "s.pt")
    ends = [fit(ratings[:7], frames[:7], view, config, number=1, seed=0, start=s)[0] for s in (start, loaded)]
    scratch, _ = fit(ratings[:7], frames[:7], view, config, number=1, seed=0)
    ends = [probabilities(s, ratings, frames) for s in (*ends, scratch)]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.abs(ends[0] - ends[2]).max() > 0.01
    # Before the first rating nothing is known of what cannot be seen.
    assert (loaded.beside(view) is None) == (kind == "imagined")


@pytest.mark.slow
def test_before_the_first_rating_the_start_chooses():
    config = small_config(ratings__choice="mix")
    features = walk(0)
    ratings, frames = world(60, seed=0)
    start, _ = fit(ratings, frames, through(fit_lens(features, 8), features), NETWORK, number=1, seed=0)
    liked = []
    for first in (None, start):
        learner = Learner(config, FRAMES, 30.0, first)
        learner.look_at(features)
        pool = learner.random_rollouts()
        questions = learner.choose(pool, None, 40, np.random.default_rng(0))
        clips = [(pool.segment(q.lane, q.start, learner.clip_steps), q.demo_step) for q in questions]
        liked.append(np.mean([learner.predict(start, *clip) for clip in clips]))
    assert liked[1] > liked[0] + 0.15


@pytest.mark.slow
def test_a_learner_fits_from_a_metric():
    view, ratings, frames = poses(60, 0, matters=0)
    start, _ = fit(ratings, frames, view, METRIC, number=1, seed=0)
    rated = ratings[:5]
    ends = []
    for first in (None, start):
        learner = Learner(small_config(method="onedemo"), FRAMES, 30.0, first)
        learner.look_at(walk(0), view.track)
        ends.append(learner.fit(rated, 1)[0])
    scratch, tuned = (np.abs(np.mean(s.log_weights - start.log_weights.mean(0), 0)).max() for s in ends)
    assert tuned < 0.5 * scratch


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return falling_demo(tmp_path_factory.mktemp("demo"))


def start_file(demo, directory):
    """The newest predictor of a whole small run."""
    store = Store(directory)
    work(make_run(store, demo, Simulated(name="rule", rate=by_rule), name="before"))
    file = newest_snapshot(store, directory, "before")
    store.close()
    return file


def begin(store, demo, rate, start=None):
    return make_run(store, demo, Simulated(name="rule", rate=rate), start=start)


@pytest.mark.slow
def test_a_run_from_a_start_goes_on_without_it(demo, tmp_path):
    """Stopped and gone on with after the other run is gone, it ends like the uninterrupted one."""
    start = start_file(demo, tmp_path / "source")
    whole, parts, plain = (Store(tmp_path / name) for name in ("whole", "parts", "plain"))
    work(begin(whole, demo, by_rule, start))
    work(begin(parts, demo, by_rule, start), iterations=3)
    assert 3 <= len(parts.runs.iterations("r")) < 6
    moved = start.with_name("moved.pt")
    start.rename(moved)
    work(begin(parts, demo, by_rule))
    work(begin(parts, demo, by_rule, moved))  # the same start under another name is no contradiction
    other = torch.load(moved, weights_only=True) | {"number": 77}
    torch.save(other, tmp_path / "other.pt")
    with pytest.raises(UserError, match="started from another predictor"):
        work(begin(parts, demo, by_rule, tmp_path / "other.pt"))
    work(begin(plain, demo, by_rule))
    with pytest.raises(UserError, match="has begun without a predictor to start from"):
        work(begin(plain, demo, by_rule, moved))
    figures = [[row["predicted"] for row in store.runs.iterations("r")] for store in (whole, parts, plain)]
    # What the resumed run asked in the iteration that was cut off may differ; all before it may not.
    assert figures[0][:3] == figures[1][:3] and len(figures[1]) == 6
    assert figures[0] != figures[2]
    for store in (whole, parts, plain):
        store.close()


def test_the_command_names_runs_that_there_are(demo, tmp_path, capsys):
    where = ["--data-dir", str(tmp_path), "--quiet"]
    assert main(["train", "--predictor-from", "nope", *where]) == 2
    assert "no run 'nope' to start from; there are: none" in capsys.readouterr().err
    store = Store(tmp_path)
    add_run(store, tmp_path, demo, small_config(), name="fresh")
    store.close()
    assert main(["train", "--predictor-from", "fresh", *where]) == 2
    assert "run 'fresh' has no similarity predictor yet" in capsys.readouterr().err
