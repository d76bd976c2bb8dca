"""The exam of the pose estimator: looks, codecs, scores, and a job in its smallest form."""

import numpy as np
import pytest

from onedemo.errors import UserError
from onedemo.experiments.jobs import pose
from onedemo.experiments.jobs.pose_looks import FAULTS, LOOKS, blurred, coded
from onedemo.experiments.report import document
from onedemo.experiments.report.account import complete
from onedemo.experiments.runner import Outcome
from onedemo.experiments.tables import pose as table
from onedemo.robots.registry import robot_named


def frames(count=4, size=64):
    """A bright disc that goes right over a grey ramp."""
    rows, columns = np.mgrid[:size, :size]
    shown = []
    for index in range(count):
        frame = np.repeat((rows + columns)[..., None].astype(np.uint8), 3, axis=2)
        frame[np.hypot(rows - 30, columns - 16 - 4 * index) < 8] = (250, 120, 20)
        shown.append(frame)
    return np.stack(shown)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_changes_pictures_and_leaves_what_they_show(fault):
    before, after = frames(), FAULTS[fault](frames())
    assert after.shape == before.shape and after.dtype == np.uint8
    error = np.abs(after.astype(int) - before).mean()
    assert 0.3 < error < 20, "it is no copy, and no other film"


def test_a_slow_shutter_mixes_a_frame_with_the_next():
    soft = blurred(frames(), sigma=0.3)
    assert soft[0, 30, 23].tolist() != frames()[0, 30, 23].tolist()
    assert np.abs(soft[-1].astype(int) - frames()[-1]).mean() < 3


def test_lossless_video_comes_back_in_order():
    again = coded(frames(), "libx264rgb", {"crf": "0"})
    assert np.abs(again.astype(int) - frames()).mean() < 3


@pytest.mark.seam
@pytest.mark.parametrize("look", LOOKS)
def test_the_camera_of_a_look_is_the_one_that_masks_are_drawn_for(look):
    """What differs from a drawing without the robot lies where the true mask is."""
    robot, where = robot_named("hopper"), LOOKS[look]
    qpos = np.tile([0.0, 1.25, 0.0, -0.3, -0.5, 0.3], (2, 1))
    away = qpos + np.array([0.0, 30.0, 0, 0, 0, 0])
    shown, empty = where.draw(robot, qpos), where.draw(robot, away)
    assert shown.shape[1:3] == where.size[::-1]
    truth = pose.true_masks(robot, where, qpos)
    rows, columns = np.nonzero(np.abs(shown[0].astype(int) - empty[0]).max(axis=2) > 60)
    by = 240 / shown.shape[1]
    right = np.argwhere(truth.masks[0])
    middle = np.median(rows) * by, (np.median(columns) - shown.shape[2] / 2) * by + 120
    assert np.abs(np.median(right, axis=0) - middle).max() < 12


def test_scores_of_a_perfect_reader_are_one():
    rng = np.random.default_rng(0)
    right = rng.normal(size=(50, 20))
    perfect = pose.Seen(read=right, doubt=rng.uniform(size=50), right=right, iou=np.ones(50))
    scores = pose.scores(robot_named("hopper"), [perfect])
    assert set(scores["explained"].values()) == {1.0} and scores["iou"] == 1 and scores["of_sure"] == 1
    mean = pose.Seen(
        read=np.tile(right.mean(axis=0), (50, 1)), doubt=np.abs(right[:, :9]).sum(axis=1), right=right,
        iou=np.zeros(50),
    )  # fmt: skip
    scores = pose.scores(robot_named("hopper"), [mean])
    np.testing.assert_allclose(list(scores["explained"].values()), 0, atol=1e-3)
    assert scores["doubt"] > 0.5 and scores["sure"] == 0 and scores["of_sure"] is None


@pytest.mark.seam
@pytest.mark.slow
def test_a_job_from_its_films_to_the_report(tmp_path):
    """With the net that comes with the program, one short film and parts of the demos."""
    job = table.plan((101,), quick=True)[0]
    result = document.plain(pose.run({**job.settings, "films": 1, "seconds": 1.0}, 101, tmp_path))
    assert tuple(result) == pose.HOW
    explained = result[pose.TRUE]["explained"]
    assert np.mean([explained[f"{way} of torso"] for way in ("right", "up")]) > 0.7
    report = table.TABLE.report([Outcome(job=job, kept={"result": result})], quick=True)
    text = document.as_text(complete(report, [Outcome(job=job, kept={"result": result, "machine": {}})],
                                     command="onedemo bench pose", quick=True))  # fmt: skip
    assert "true masks" in text and "directions at least 0.9" in text


def test_another_look_is_refused():
    with pytest.raises(UserError, match="no look"):
        pose.run({"robot": "hopper", "look": "oil", "films": 1, "seconds": 1.0}, 0, None)
