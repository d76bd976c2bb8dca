"""What the charts are told of a run: thinned, with what is worked out from ratings and what happened."""

import time

import numpy as np
import pytest

from helpers.curves import iteration_stats, train
from helpers.fake_trainer import StandIn
from onedemo.app.services.curves import POINTS, accuracies, agreements, curves, thinned
from onedemo.demos.library import find_demo
from onedemo.evaluation.demo_level import true_reward_of


@pytest.fixture
def trainer(tmp_path):
    trainer = StandIn(tmp_path, clips=30)
    trainer.store.database._db.execute("PRAGMA synchronous = OFF")
    yield trainer
    trainer.store.close()


def test_a_long_curve_is_thinned_and_keeps_its_newest_point():
    assert thinned([1, 2, 3], 3) == [1, 2, 3] and thinned([], 3) == []
    for count in (1501, 3000, 3001, 100_000):
        kept = thinned(range(count), POINTS)
        assert len(kept) <= POINTS and kept[-1] == count - 1 and len(set(np.diff(kept))) == 1


def test_iterations_come_as_columns_and_later_ones_alone(trainer):
    store, run = trainer.store, trainer.run
    assert curves(store, run)["last"] == 0
    train(store, run, 1, 30)
    told = curves(store, run)
    columns = told["columns"]
    assert told["last"] == 30 and {len(values) for values in columns.values()} == {30}
    assert columns["number"] == list(range(1, 31)) and columns["env_steps"][-1] == 480_000
    assert columns["predicted"][11] == pytest.approx(iteration_stats(12)["predicted"], rel=1e-4)
    assert columns["agreement"] == [None] * 30
    store.runs.add_iteration(run, 31, snapshot=9, env_steps=1, stats={"kl": float("nan")})
    later = curves(store, run, after=30)
    assert later["columns"]["number"] == [31] and later["columns"]["kl"] == [None] == later["columns"]["std"]
    assert curves(store, run, after=31) == {
        "last": 31,
        "columns": {name: [] for name in columns},
        "marks": [],
    }


def test_marks_stand_after_the_iteration_they_came_after(trainer):
    store, run = trainer.store, trainer.run
    ann, bob = (store.accounts.ensure(name, "annotator").id for name in ("Ann", "Bob"))
    store.ratings.leave_out(run, ann, by=bob)
    time.sleep(0.01)  # the database keeps milliseconds
    train(store, run, 1, 3)
    store.runs.mark(run, 3, "paused")
    store.runs.mark(run, 3, "resumed")
    train(store, run, 4, 5)
    time.sleep(0.01)
    store.ratings.leave_out(run, ann, by=bob, left_out=False)
    assert curves(store, run)["marks"] == [
        [0, "excluded", "Ann"], [3, "paused", ""], [3, "resumed", ""], [5, "included", "Ann"],
    ]  # fmt: skip


def test_only_the_first_rating_of_a_clip_that_was_predicted_is_a_forecast(trainer):
    store, run = trainer.store, trainer.run
    ids = [clip.id for clip in store.clips.waiting(run)]
    ann, bob = (store.accounts.ensure(name, "annotator").id for name in ("Ann", "Bob"))
    store.ratings.rate(ids[0], ann, 5, 900)  # nothing had been predicted of it
    store.clips.set_predictions(1, {clip: 1 + k % 5 + 0.25 for k, clip in enumerate(ids)})
    for k, clip in enumerate(ids[1:21], start=1):
        store.ratings.rate(clip, ann, 1 + k % 5, 900)
        store.ratings.rate(clip, bob, 5 - k % 5, 900)  # by then it has been trained on
        store.ratings.rate(clip, ann, 1, 900, repeat=True)
    assert [value for _, value, _ in store.runs.forecasts(run)] == [1 + k % 5 for k in range(1, 21)]
    train(store, run, 1, 1)
    columns = curves(store, run)["columns"]
    assert columns["agreement"] == [pytest.approx(1.0)] and columns["error"] == [pytest.approx(0.25)]


def test_agreement_is_over_the_newest_fifty_and_of_their_own_time():
    good = [(f"2026-01-01T00:00:{k:02}", 1 + k % 5, 1 + k % 5) for k in range(60)]
    bad = [(f"2026-01-01T00:01:{k:02}", 1 + k % 5, 5 - k % 5) for k in range(60)]
    told = agreements([*good, *bad], ["2026-01-01T00:00:05", "2026-01-01T00:01", "2026-01-01T00:02"])
    assert told[0] == {"agreement": None, "error": None}
    assert [t["agreement"] for t in told[1:]] == [pytest.approx(1), pytest.approx(-1)]
    alike = [("2026", 3, 3.0)] * 20
    assert agreements(alike, ["2027"]) == [{"agreement": None, "error": 0.0}]


def test_accuracy_is_over_snapshots_with_fifty_new_ratings_between_them():
    first = [{"number": k, "new": 5, "hits": 1, "confidence": 4.0} for k in range(1, 11)]
    then = [{"number": k, "new": 5, "hits": 4, "confidence": 4.0} for k in range(11, 21)]
    told = accuracies([*first, {"number": 10.5}, *then], [0, 1, 2, 10, 20])
    assert told[0] == told[1] == {"accuracy": None, "confidence": None}
    assert [t["accuracy"] for t in told[2:]] == [pytest.approx(0.2), pytest.approx(0.2), pytest.approx(0.8)]
    assert {round(t["confidence"], 6) for t in told[2:]} == {0.8}
    assert accuracies([], [1]) == [{"accuracy": None, "confidence": None}]


def test_the_demo_itself_has_a_true_reward_if_it_was_simulated(tmp_path, trainer):
    demo = find_demo("hopper-backflip", tmp_path / "demos")
    assert true_reward_of(demo) > 1000
    assert true_reward_of(trainer.demo) is None  # its states are not known
