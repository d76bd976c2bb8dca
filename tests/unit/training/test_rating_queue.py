"""What people are asked, and when: the online share waits for clips of the policy."""

from __future__ import annotations

import threading
import time

import pytest

from helpers.small_world import Thumbnail, falling_demo, small_config
from onedemo.storage.store import Store
from onedemo.training.runs import add_run
from onedemo.training.thread import Trainer
from onedemo.training.training_run import TrainingRun


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    yield store
    store.close()


def make_run(store, tmp_path, **options):
    demo = falling_demo(tmp_path / "demo")
    settings = {"ratings__pretrain": 8, "ratings__online": 6, "rollouts__total_steps": 10**6}
    config = small_config(**settings | options.pop("settings", {}))
    add_run(store, tmp_path, demo, config, name="r")
    return TrainingRun(
        store=store, data_dir=tmp_path, run="r", demo=demo, config=config, encoder=Thumbnail(), **options
    )


def rate_all(store, rater):
    """Rates whatever is asked, as quickly as it can be."""
    clips = [clip for state in ("cut", "ready") for clip in store.clips.waiting("r", state)]
    for number, clip in enumerate(clips):
        store.ratings.rate(clip.id, rater.id, 1 + number % 5, latency_ms=5)
    return clips


def test_the_online_share_is_kept_until_there_are_clips_of_the_policy(store, tmp_path):
    training, ann = make_run(store, tmp_path), store.accounts.ensure("Ann", "annotator")
    training.open()
    for _ in range(10):  # while the robot is looked at, say: people go on as long as they are asked
        training.ask()
        rate_all(store, ann)
    assert training.queue.given() == 8 and not store.clips.waiting("r", "cut")
    training.see(*training.look())
    assert training.phase == "online"
    training.iterate()
    for _ in range(10):
        training.ask()
        rate_all(store, ann)
    stages = [row[6] for row in store.ratings.stream("r")]
    assert stages.count("pretrain") == 8 and stages.count("online") == 6


def test_an_excluded_rater_s_share_is_asked_again_before_practice(store, tmp_path):
    training, ann = make_run(store, tmp_path), store.accounts.ensure("Ann", "annotator")
    bob = store.accounts.ensure("Bob", "annotator")
    training.open()
    for _ in range(10):
        training.ask()
        rate_all(store, ann)
    store.ratings.leave_out("r", ann.id, by=bob.id)
    for _ in range(10):
        training.ask()
        rate_all(store, bob)
    assert training.queue.given() == 8


def test_pause_and_stop_are_told_at_once_within_an_iteration(store, tmp_path, monkeypatch):
    begun, go_on, iterate = threading.Event(), threading.Event(), TrainingRun.iterate

    def long(self):
        begun.set()
        assert go_on.wait(60)
        iterate(self)

    monkeypatch.setattr(TrainingRun, "iterate", long)
    training = make_run(store, tmp_path, settings={"ratings__pretrain": 1})
    trainer, ann = Trainer(training), store.accounts.ensure("Ann", "annotator")
    trainer.start()
    until = time.monotonic() + 60
    while not begun.wait(0.02):
        assert time.monotonic() < until
        rate_all(store, ann)
    iteration = trainer.status().iteration
    trainer.pause()
    assert trainer.status().phase == "pausing"
    trainer.resume()
    assert trainer.status().phase == "online"
    trainer.stop(timeout_s=0)
    assert trainer.status().phase == "stopping" and trainer.status().iteration == iteration
    go_on.set()
    trainer.stop()
    assert trainer.status().phase == "stopped"


def test_a_pause_before_practice_is_one_at_once(store, tmp_path):
    trainer = Trainer(make_run(store, tmp_path))
    trainer.start()
    until = time.monotonic() + 60
    while trainer.status().phase != "pretrain":
        assert time.monotonic() < until
        time.sleep(0.02)
    trainer.pause()
    assert trainer.status().phase == "paused"
    trainer.stop()


def test_looking_tells_how_far_it_is_and_only_where_it_takes_time(store, tmp_path):
    told = []

    class Look:
        reach = 1.6

        def track(self, masks, fps):
            return None

    def learn(env, cache, check):
        for share in (0.0, 0.25, 0.5):
            time.sleep(0.02)
            check(share)
            told.append((training.looking(), training.preparing))
        return Look()

    training = make_run(
        store, tmp_path, learn_robot=learn,
        settings={"method": "onedemo", "predictor__appearance": True},
    )  # fmt: skip
    training.open()
    assert training.looking() == (None, None)
    training.look()
    (first, _), (second, _), (third, said) = told
    assert first == (0.0, None) and second[0] == 0.25 and second[1] > 0 and third[1] > 0
    assert "robot" in said and training.looking() == (None, None)

    training._learn_robot = lambda *_: Look()  # learned before: nothing is said of pictures
    training.look()
    assert "looked for in the demonstration video" in training.preparing
