"""Where a clip goes wrong: what a simulated rater marks, and what a fit makes of it."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from onedemo.annotators.base import DistanceAnnotator
from onedemo.demos.frame_clock import frame_of_step
from onedemo.reward.dataset import TrainingSet
from onedemo.reward.segment_marks import (
    marked_steps,
    picture_of_step,
    pictures_of_steps,
    split_marks,
    steps_of_pictures,
)
from onedemo.storage.clips import NewClip
from onedemo.storage.rating_records import RatedSegment
from onedemo.storage.store import Store
from onedemo.types import Demo, Segment

W = 20


def rated(value=3, mark=None, event=1):
    steps = np.arange(W, dtype=float)
    return RatedSegment(
        event=event, demo_step=0, value=value, mark=mark,
        segment=Segment(obs=steps[:, None], actions=steps[:, None], qpos=steps[:, None], qvel=steps[:, None]),
    )  # fmt: skip


class Given(DistanceAnnotator):
    """Sees the distances it is given."""

    def __init__(self, distances):
        super().__init__((1.0, 2.0, 3.0, 4.0), dt=0.008, budget=9)
        self.distances = np.array(distances, float)

    def distance(self, qpos, qvel, demo_step):
        return self.distances


def test_without_marks_nothing_changes():
    ratings, frames = [rated(), rated(5)], np.zeros((2, W), int)
    same, as_before = split_marks(ratings, frames)
    assert same is ratings and as_before is frames


def test_a_mark_makes_two_ratings_of_one():
    frames = np.stack([np.arange(W), 100 + np.arange(W)])
    parts, rows = split_marks([rated(2), rated(3, (5, 10), event=2)], frames)
    assert [(p.event, p.value, p.mark) for p in parts] == [(1, 2, None), (2, 3, None), (2, 4, None)]
    inside, outside = parts[1].segment.obs[:, 0], parts[2].segment.obs[:, 0]
    assert set(inside) == {5, 6, 7, 8, 9} and set(outside) == {*range(5), *range(10, 20)}
    assert len(inside) == len(outside) == W
    assert (np.diff(inside) >= 0).all() and np.bincount(inside.astype(int))[5:].tolist() == [4] * 5
    assert np.array_equal(rows[1], 100 + inside) and np.array_equal(rows[2], 100 + outside)
    assert rows.shape == (3, W)


def test_the_best_stays_the_best_and_a_mark_of_everything_says_nothing():
    parts, _ = split_marks([rated(5, (0, 4)), rated(1, (0, W)), rated(1, (30, 40))], np.zeros((3, W), int))
    assert [p.value for p in parts] == [5, 5, 1, 1]
    assert marked_steps(rated(mark=(18, 40))).sum() == 2


@pytest.mark.parametrize("fps", [24.0, 29.97, 30.0, 60.0])
def test_a_mark_over_pictures_covers_their_steps_and_no_others(fps, tmp_path):
    """Wherever the clip begins, through the database and back, as what learns sees it."""
    dt, steps, frames = 0.008, 38, int(8 * fps)
    demo = Demo(name="d", sha256="0", path=tmp_path, fps=fps, frames=frames, width=9, height=9)
    with closing(Store(tmp_path)) as store:
        store.database._db.execute("PRAGMA synchronous = OFF")
        store.runs.add(run="r", demo="d", demo_sha256="0", seed=0, config="", version="0")
        rater = store.accounts.ensure("Ann", "annotator").id
        zeros = {name: np.zeros((steps, n)) for name, n in dict(obs=11, actions=3, qpos=6, qvel=6).items()}
        expected = []
        for demo_step in (0, 1, 2, 3, 101, 930, 962):
            shown = frame_of_step(demo_step + np.arange(steps), dt, fps, frames)
            pictures = np.unique(shown)
            for i, j in ((0, 1), (2, 5), (len(pictures) - 1, len(pictures)), (0, len(pictures))):
                clip = NewClip(demo_step=demo_step, segment=Segment(**zeros), stage="online", iteration=1)
                (clip,) = store.clips.add("r", [clip])
                of_step = picture_of_step(clip, dt, demo)
                mark = steps_of_pictures((i, j), of_step)
                assert pictures_of_steps(mark, of_step) == (i, j)
                store.ratings.rate(clip.id, rater, 2, 900, mark=mark)
                expected.append(np.isin(shown, pictures[i:j]))
        ratings = TrainingSet(store, "r").at(store.ratings.last_event())
        assert len(ratings) == len(expected) == 28
        for rating, inside in zip(ratings, expected, strict=True):
            assert np.array_equal(marked_steps(rating) > 0, inside)


@pytest.mark.parametrize("mark", [(0, 0), (3, 1), (-1, 2), (0, 11)])
def test_what_is_no_stretch_of_pictures_is_no_mark(mark):
    with pytest.raises(ValueError, match="10 pictures"):
        steps_of_pictures(mark, np.repeat(np.arange(10), 4))


@pytest.mark.parametrize(
    ("distances", "mark"),
    [
        ([1.0] * 12 + [3.0] * 6 + [1.0] * 2, (12, 18)),
        ([3.0] * 5 + [1.0] * 15, (0, 5)),
        ([1.0] * 14 + [3.0] * 6, (14, 20)),
        ([2.0] * 20, None),
        ([1.0] * 10 + [1.3] * 10, None),  # nothing stands out
        ([1.0] * 18 + [9.0] * 2, None),  # shorter than a frame
    ],
)
def test_a_simulated_rater_marks_the_worst_stretch(distances, mark):
    segment = rated().segment
    assert Given(distances).mark(segment, 0) == mark


def test_the_metric_learns_from_marks_what_the_ratings_cannot_tell(view_of_two):
    """Each clip is off in one number in its first half and in another in its second; all are rated alike."""
    from onedemo.reward.learned_distance import fit
    from onedemo.reward.model import PredictorConfig

    ratings, frames, view, weight_of = view_of_two
    config = PredictorConfig(members=1)
    plain, _ = fit([replace(r, mark=None) for r in ratings], frames, view, config, number=1, seed=0)
    marked, _ = fit(ratings, frames, view, config, number=1, seed=0)
    before, after = weight_of(plain), weight_of(marked)
    assert after[1] - after[0] > before[1] - before[0] + 0.5


@pytest.fixture
def view_of_two():
    """Ratings whose marks blame the spin, not the height; and which log weights tell."""
    from onedemo.reward.model import View
    from onedemo.robots.registry import robot_named
    from onedemo.sim.kinematics import body_of

    BODY = body_of(robot_named("hopper"))
    from onedemo.vision.pose_estimator import Track

    rng = np.random.default_rng(0)
    still = np.zeros(11)
    still[0] = 1.25
    frames, ratings = np.zeros((60, W), int), []
    for i in range(60):
        obs = np.tile(still, (W, 1)).astype(np.float32)
        size = rng.uniform(0.0, 0.6)
        obs[: W // 2, 0] += size  # height
        obs[W // 2 :, 7] += 8 * size  # spin
        value = int(np.clip(5 - size / 0.13, 1, 5))
        segment = Segment(
            obs=obs, actions=np.zeros((W, 3), np.float32), qpos=np.empty((W, 0)), qvel=np.empty((W, 0))
        )
        ratings.append(RatedSegment(event=i + 1, demo_step=0, segment=segment, value=value, mark=(W // 2, W)))
    track = Track(
        pose=BODY.pose(still[None]).astype(np.float32),
        motion=BODY.motion(still[None]).astype(np.float32),
    )
    view = View(
        visual=np.zeros((1, 2), np.float32), track=track, basis=np.zeros((1, 2), np.float32), fps=30.0
    )

    moved = still.copy()
    moved[0] += 1
    height = int(np.abs(BODY.pose(moved[None]) - BODY.pose(still[None]))[0].argmax())
    moved = still.copy()
    moved[7] += 1
    spin = BODY.pose_size + int(np.abs(BODY.motion(moved[None]) - BODY.motion(still[None]))[0].argmax())

    def weight_of(snapshot):
        return snapshot.log_weights[0, height], snapshot.log_weights[0, spin]

    return ratings, frames, view, weight_of
