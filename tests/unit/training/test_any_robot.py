"""Whole tiny trainings of robots other than the hopper, from the first rating to the summary."""

import hashlib

import cv2
import numpy as np
import pytest
import torch

from helpers.small_world import Thumbnail, small_config
from onedemo.annotators.oracle import Oracle, make_rater, marker
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.ground_truth import HiddenStates, hidden_path, save_hidden
from onedemo.demos.video import write_webm
from onedemo.evaluation.episodes import summarise
from onedemo.reward.model import Snapshot
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env
from onedemo.sim.kinematics import body_of
from onedemo.storage.store import Store
from onedemo.training.rating_queue import Simulated
from onedemo.training.runs import add_run
from onedemo.training.simulated_run import train
from onedemo.training.training_run import TrainingRun
from onedemo.types import Demo
from onedemo.vision.pose_estimator import Track

FPS, FRAMES = 30.0, 45


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def states_of(name):
    """What a robot does when its motors wave."""
    robot = robot_named(name)
    steps = round(FRAMES / FPS / robot.dt)
    env = vector_env.make(name, 1, horizon=steps + 1, nthread=0)
    obs, _ = env.reset(seed=0)
    states = [(obs[0], env.qpos[0], env.qvel[0])]
    phases = np.arange(robot.action_size)
    actions = 0.8 * np.sin(np.arange(steps)[:, None] * robot.dt * 8 + phases)
    for action in actions:
        obs, *_ = env.step(action[None])
        states.append((obs[0], env.qpos[0], env.qvel[0]))
    env.close()
    obs, qpos, qvel = (np.array(column) for column in zip(*states, strict=True))
    return HiddenStates(obs=obs, actions=actions, qpos=qpos, qvel=qvel)


def demo_of(name, directory):
    """The same as a stick figure in a video, its states beside it."""
    hidden, body = states_of(name), body_of(robot_named(name))
    shown = np.minimum(steps_of_frames(FRAMES, body.robot.dt, FPS), len(hidden.qpos) - 1)
    directory.mkdir()
    frames = []
    for qpos in hidden.qpos[shown]:
        image = np.full((120, 160, 3), 235, np.uint8)
        for ends in body.points(qpos).values():
            ends = ends - [body.points(qpos)[body.robot.limbs[0]].mean(axis=0)[0], 0]
            start, end = ((int(80 + 40 * x), int(105 - 40 * y)) for x, y in ends)
            cv2.line(image, start, end, (180, 60, 30), 4, cv2.LINE_AA)
        frames.append(image)
    video = directory / f"{name}-waves.webm"
    write_webm(video, frames, fps=FPS)
    save_hidden(hidden_path(video), hidden)
    sha256 = hashlib.sha256(video.read_bytes()).hexdigest()
    demo = Demo(
        name=f"{name}-waves", sha256=sha256, path=video, fps=FPS, frames=FRAMES, width=160, height=120
    )
    seen = body.seen(hidden.obs[shown])
    return demo, hidden, Track(**{field: x.astype(np.float32) for field, x in seen._asdict().items()})


def config_of(name, **changes):
    return small_config(**{
        "env": name, "method": "onedemo", "rollouts.total_steps": 1200, "ratings.pretrain": 10,
        "ratings.online": 4, "predictor.members": 1, "practice.bank_tries": 100, **changes,
    })  # fmt: skip


def common(summary, name):
    robot = robot_named(name)
    for figure in ("travel", "height", "energy", "stock_reward", "stock_return", "true_similarity"):
        assert np.isfinite(summary[figure]["mean"]), figure
    assert 1 <= summary["predicted_similarity"]["mean"] <= 5
    assert ("turned_round" in summary) == (robot.root == "free")
    assert "net_turns" not in summary


@pytest.mark.parametrize("name", [pytest.param("walker2d", marks=pytest.mark.slow), "half-cheetah", "ant"])
def test_a_demo_whose_track_is_seen_is_trained_on(name, tmp_path):
    demo, hidden, track = demo_of(name, tmp_path / "demo")

    class Eye:
        """What there is to know of how this robot looks: all."""

        def knows(self, features):
            return True

        def track(self, features, fps):
            return track

    config = config_of(name)
    rater = make_rater("oracle", hidden, demo=demo, budget=14, robot=name)
    store = Store(tmp_path / "data")
    try:
        run = add_run(store, tmp_path / "data", demo, config, name="waves")
        training = TrainingRun(
            store=store, data_dir=tmp_path / "data", run=run, demo=demo, config=config, encoder=Thumbnail(),
            simulated=Simulated(name="oracle", rate=rater.rate, mark=marker(rater)),
            learn_robot=lambda *_: Eye(),
        )  # fmt: skip
        training.prepare()
        while training.step() != "done":
            pass
        assert sum(store.ratings.by_class(run)) == 14 and training.env_steps >= 1200
        assert training.track is not None and training.track.travel is not None
        summary = summarise(training.learner, training.snapshot, Oracle(hidden, name, budget=0))
        common(summary, name)
        number = training.snapshot.number
        again = Snapshot.load(training.files.snapshot(number))
        frames, some = np.arange(20), slice(0, 20)
        np.testing.assert_array_equal(
            again.ratings(frames, hidden.obs[some], hidden.actions[some]),
            training.snapshot.ratings(frames, hidden.obs[some], hidden.actions[some]),
        )
    finally:
        store.close()


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        # What the demo shows is fitted to the ratings, too.
        pytest.param("ant", {"predictor.appearance": False}, marks=pytest.mark.slow),
        ("half-cheetah", {"method": "paper"}),
    ],
)
def test_so_is_one_that_ratings_alone_explain(name, changes, tmp_path):
    demo, _, _ = demo_of(name, tmp_path / "demo")
    store = Store(tmp_path / "data")
    try:
        summary = train(
            store=store, data_dir=tmp_path / "data", demo=demo, config=config_of(name, **changes),
            encoder=Thumbnail(), rater="oracle", progress=False,
        )  # fmt: skip
    finally:
        store.close()
    assert summary["ratings"] == 14 and summary["env_steps"] >= 1200
    common(summary, name)
