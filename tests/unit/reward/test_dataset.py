"""Segments are read once, and the set is at any time what the events say."""

import numpy as np
import pytest

from onedemo.reward.dataset import TrainingSet
from onedemo.storage.clips import NewClip
from onedemo.storage.segment_codec import pack_segment, unpack_segment
from onedemo.storage.store import Store
from onedemo.types import Segment


def segment(value):
    rng = np.random.default_rng(value)
    return Segment(
        obs=rng.normal(size=(38, 11)),
        actions=rng.normal(size=(38, 3)).astype(np.float32),
        qpos=rng.normal(size=(38, 6)),
        qvel=rng.normal(size=(38, 6)),
    )


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    store.runs.add(run="r", demo="d", demo_sha256="0", seed=0, config="", version="0")
    store.accounts.ensure("Ann", "annotator")
    store.accounts.ensure("Bob", "annotator")
    new = [NewClip(demo_step=i, segment=segment(i), stage="online", iteration=1) for i in range(12)]
    store.clips.add("r", new)
    yield store
    store.close()


@pytest.fixture
def reads(store, monkeypatch):
    """The clips whose segments were read, in order."""
    read, real = [], store.clips.segment
    monkeypatch.setattr(store.clips, "segment", lambda clip: read.append(clip) or real(clip))
    return read


def test_packing_keeps_values_and_types():
    whole = segment(4)
    again = unpack_segment(pack_segment(whole))
    for name in ("obs", "actions", "qpos", "qvel"):
        before, after = getattr(whole, name), getattr(again, name)
        np.testing.assert_array_equal(after, before)
        assert after.dtype == before.dtype


@pytest.mark.parametrize("data", [b"", b"neither of both", pack_segment(segment(0))[:-9]])
def test_bytes_that_are_no_segment(data):
    with pytest.raises(ValueError):
        unpack_segment(data)


def test_a_segment_is_read_once_and_kept_in_float32(store, reads):
    training_set = TrainingSet(store, "r")
    first = store.ratings.rate(3, 1, 4, latency_ms=1)
    (rated,) = training_set.at(first)
    assert (rated.event, rated.demo_step, rated.value) == (first, 2, 4)
    np.testing.assert_array_equal(rated.segment.obs, segment(2).obs.astype(np.float32))
    np.testing.assert_array_equal(rated.segment.actions, segment(2).actions)
    assert rated.segment.obs.dtype == rated.segment.actions.dtype == np.float32
    second = store.ratings.rate(5, 1, 2, latency_ms=1)
    assert [r.value for r in training_set.at(second)] == [4, 2]
    assert training_set.at(second)[0] is rated
    assert reads == [3, 5]


def test_a_rating_taken_back_is_in_no_later_set_but_in_the_earlier_ones(store, reads):
    training_set = TrainingSet(store, "r")
    before = [store.ratings.rate(clip, 1, clip % 5 + 1, latency_ms=1) for clip in (1, 2, 3)][-1]
    assert [r.value for r in training_set.at(before)] == [2, 3, 4]
    after = store.ratings.undo(2, 1)
    assert [r.value for r in training_set.at(after)] == [2, 4]
    assert [r.value for r in training_set.at(before)] == [2, 3, 4]
    again = store.ratings.rate(2, 1, 5, latency_ms=1)
    assert [r.value for r in training_set.at(again)] == [2, 4, 5]


def test_the_set_is_the_stores_whatever_was_asked_before(store):
    rng = np.random.default_rng(0)
    training_set, events = TrainingSet(store, "r"), [0]
    for _ in range(300):
        clip, rater = int(rng.integers(1, 13)), int(rng.integers(1, 3))
        try:
            if rng.random() < 0.5:
                events.append(store.ratings.rate(clip, rater, int(rng.integers(1, 6)), latency_ms=1))
            else:
                events.append(store.ratings.undo(clip, rater))
        except ValueError:
            continue
        as_of = events[int(rng.integers(len(events)))] if rng.random() < 0.3 else events[-1]
        kept = training_set.at(as_of)
        fresh = TrainingSet(store, "r").at(as_of)
        wanted = store.ratings.for_training("r", as_of=as_of)
        assert [(r.event, r.demo_step, r.value) for r in kept] == [
            (w.event, w.demo_step, w.value) for w in wanted
        ]
        for one, other, row in zip(kept, fresh, wanted, strict=True):
            assert np.array_equal(one.segment.obs, segment(row.clip - 1).obs.astype(np.float32))
            assert np.array_equal(one.segment.obs, other.segment.obs)
    assert len(events) > 100


def test_another_runs_ratings_stay_out(store):
    store.runs.add(run="other", demo="d", demo_sha256="0", seed=0, config="", version="0")
    (clip,) = store.clips.add(
        "other", [NewClip(demo_step=0, segment=segment(0), stage="online", iteration=1)]
    )
    event = store.ratings.rate(clip.id, 1, 5, latency_ms=1)
    assert TrainingSet(store, "r").at(event) == []
    assert [r.value for r in TrainingSet(store, "other").at(event)] == [5]
