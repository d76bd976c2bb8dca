"""The exam of the pose estimator: looks, codecs, scores, and a job in its smallest form."""

import cv2
import numpy as np
import pytest

from onedemo.errors import UserError
from onedemo.experiments.jobs import pose
from onedemo.experiments.jobs.pose_looks import FAULTS, LOOKS, blurred, coded
from onedemo.experiments.report import document
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


def test_a_good_video_comes_back_in_order():
    again = coded(frames(), "libx264", {"crf": "1"})
    assert np.abs(again.astype(int) - frames()).mean() < 5


@pytest.mark.seam
@pytest.mark.parametrize("look", LOOKS)
def test_the_camera_of_a_look_is_the_one_that_masks_are_drawn_for(look):
    """The robot's strong colours lie where the true mask is, and hardly anywhere else."""
    robot, where = robot_named("hopper"), LOOKS[look]
    qpos = np.array([[0.7, 1.3, 0.3, -0.3, -0.5, 0.3]])
    (shown,), (mask,) = where.draw(robot, qpos), pose.true_masks(robot, where, qpos).masks
    assert shown.shape[:2] == where.size[::-1]
    width = round(240 * shown.shape[1] / shown.shape[0])
    middle = cv2.resize(shown, (width, 240), interpolation=cv2.INTER_AREA)[:, width // 2 - 120 :][:, :240]
    strong = cv2.cvtColor(middle, cv2.COLOR_RGB2HSV)[..., 1] > 105
    near = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert strong[mask].mean() > 0.8 and (strong & near).sum() > 0.6 * strong.sum()


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
def test_a_job_from_its_films_to_the_report(tmp_path, monkeypatch):
    """With the net that comes with the program, and one short film."""
    monkeypatch.setattr(pose, "built_in", list)
    job = next(job for job in table.plan((101,), quick=True) if "mjviser" in job.label)
    result = document.plain(pose.run({**job.settings, "films": 1, "seconds": 1.0}, 101, tmp_path))
    assert tuple(result) == pose.HOW
    assert all(0 <= scores["iou"] <= 1 and len(scores["explained"]) == 20 for scores in result.values())
    explained = result[pose.TRUE]["explained"]
    assert np.mean([explained[f"{way} of torso"] for way in ("right", "up")]) > 0.7
    text = document.as_text(table.TABLE.report([Outcome(job=job, kept={"result": result})], quick=True))
    assert "true masks" in text and "directions at least 0.9" in text


def test_another_look_is_refused():
    with pytest.raises(UserError, match="no look"):
        pose.run({"robot": "hopper", "look": "oil", "films": 1, "seconds": 1.0}, 0, None)
