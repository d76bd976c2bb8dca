"""The rater that is driven by marks, and the marks of the real person's backflip."""

import json
from pathlib import Path

import numpy as np
import pytest

import onedemo
from helpers.paths import PERSON
from onedemo.annotators.oracle import make_rater
from onedemo.annotators.scripted import Script, load_marks, marked, table_path, visible
from onedemo.demos.library import import_video
from onedemo.errors import UserError
from onedemo.robots.hopper import CONTACT_MARGIN, clearances
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.training.learner import Learner
from onedemo.types import Demo, Segment

TABLE = Path(onedemo.__file__).parent / "experiments" / "jobs" / "person_backflip.json"

DT, STEPS, W = 0.008, 275, 38
BODY = body_of(robot_named("hopper"))


class Untouchable:
    """Hidden states that must not be looked at."""

    def __getattr__(self, name):
        raise AssertionError(f"the rater read the demo's hidden {name}")


@pytest.fixture
def person(tmp_path):
    return Demo(
        name="person", sha256="", path=tmp_path / "video.webm", fps=30.0, frames=66, width=480, height=480
    )


@pytest.fixture
def marks(person):
    return load_marks(TABLE, person)


def acted(marks):
    """A hopper that does what the marks say: (qpos, qvel), on the ground or half a metre over it."""
    seconds = DT * np.arange(STEPS)
    qpos, qvel = np.zeros((STEPS, 6)), np.zeros((STEPS, 6))
    qpos[:, 2] = -np.radians(np.interp(seconds, *marks[:, :2].T))
    qvel[:, 2] = np.gradient(qpos[:, 2], DT)
    airborne = np.interp(seconds, marks[:, 0], marks[:, 2]) > 0.5
    qpos[:, 1] = 0.5 * airborne - np.minimum.reduce(list(clearances(qpos).values()))
    return qpos, qvel


def standing():
    qpos, qvel = np.zeros((STEPS, 6)), np.zeros((STEPS, 6))
    qpos[:, 1] = 1.25
    return qpos, qvel


def ratings(marks, qpos, qvel, every=1):
    """Of every clip of an episode, or of those that begin so many steps apart, beside the marks then."""
    script = Script(marks, budget=STEPS)
    return np.array([script.rate(cut(qpos, qvel, s), s) for s in range(0, STEPS - W + 1, every)])


def cut(qpos, qvel, start):
    part = slice(start, start + W)
    return Segment(obs=np.zeros((W, 11)), actions=np.zeros((W, 3)), qpos=qpos[part], qvel=qvel[part])


def test_the_marked_motion_is_a_five_throughout(marks):
    assert (ratings(marks, *acted(marks)) == 5).all()


def test_standing_beside_the_flip_is_a_one_or_two_and_at_the_end_a_five(marks):
    found = ratings(marks, *standing())
    flip = slice(round(0.8 / DT), round(1.15 / DT))
    assert (found[flip] <= 2).all() and (found[flip] == 1).any()
    assert found[-1] == 5  # the person stands, too


def test_the_wrong_way_round_is_seen_in_the_spin(marks):
    """Forward, at the same angle in the middle of the flip: pitch agrees there, spin does not."""
    qpos, qvel = acted(marks)
    middle = round(1.1 / DT)
    qpos[:, 2] = 2 * qpos[middle, 2] - qpos[:, 2]
    start = middle - W // 2
    assert Script(marks, budget=1).rate(cut(qpos, -qvel, start), start) <= 2


def test_a_whole_turn_and_a_metre_do_not_matter(marks):
    qpos, qvel = acted(marks)
    further = qpos.copy()
    further[:, 2] -= 2 * np.pi
    further[:, 0] += 3
    np.testing.assert_allclose(visible(further, qvel, BODY), visible(qpos, qvel, BODY), atol=1e-9)


def test_what_is_seen_of_marks_and_robot():
    marks = np.array([[0.0, 0.0, 0], [1.0, 90.0, 0], [1.1, 90.0, 1]])  # 90 degrees in a second
    found = marked(marks, np.array([0.5, 3.0]))
    spin = 0.15 * np.pi / 2
    np.testing.assert_allclose(found[0], [np.sin(np.pi / 4), np.cos(np.pi / 4), spin, 0.0], atol=1e-9)
    np.testing.assert_allclose(found[1], [1, 0, 0, 0.5], atol=1e-9)
    qpos, qvel = np.zeros((2, 6)), np.zeros((2, 6))
    qpos[:, 1] = [1.25, 1.4]
    qpos[:, 2], qvel[:, 2] = -np.pi / 4, -np.pi / 2
    qpos[0, 1] -= np.minimum.reduce(list(clearances(qpos).values()))[0] - CONTACT_MARGIN / 2
    np.testing.assert_allclose(visible(qpos, qvel, BODY)[0], found[0], atol=1e-9)
    assert visible(qpos, qvel, BODY)[1, 3] == 0.5


@pytest.mark.slow
def test_wild_random_motion_gets_more_than_ones(marks):
    """Statistics of the random policy, printed; a rater of ones alone would teach nothing."""
    from onedemo.config import load_config

    rollouts = Learner(load_config(None, {"practice.random_lanes": 32}), 66, 30.0).random_rollouts()
    lanes = zip(rollouts.qpos, rollouts.qvel, strict=True)
    rated = [ratings(marks, qpos, qvel, every=12) for qpos, qvel in lanes]
    found = np.bincount(np.concatenate(rated), minlength=6)[1:] / (len(rated) * len(rated[0]))
    print("random policy, share of ratings 1 to 5:", found.round(3))
    assert found[:3].max() < 0.6 and found[0] > 0.2 and found[2:].sum() > 0.1 and found[3:].sum() > 0.02


def test_only_the_marks_are_looked_at_and_the_name_takes_errors(marks, person):
    rater = make_rater(f"script:{TABLE}+mistake:0.5", Untouchable(), demo=person, budget=200)  # type: ignore[arg-type]
    qpos, qvel = acted(marks)
    wrong = sum(rater.rate(cut(qpos, qvel, s), s) != 5 for s in range(200))
    assert 70 <= wrong <= 130 and rater.given == 200  # type: ignore[attr-defined]
    assert make_rater(f"script:{TABLE}", None, demo=person, budget=1).rate(cut(qpos, qvel, 0), 0) == 5


def test_a_table_beside_the_video_is_found(person, marks):
    with pytest.raises(UserError, match=r"no table of marks at .*video\.script\.json; give one with"):
        make_rater("script", None, demo=person, budget=1)
    table_path(person.path).write_text(TABLE.read_text())
    assert make_rater("script", None, demo=person, budget=1).rate(cut(*acted(marks), 0), 0) == 5


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ("nonsense", "is no table of marks: JSONDecodeError"),
        ("[]", "is no table of marks"),
        ({"points": []}, "is no table of marks: KeyError"),
        ({"marks": [[0, 0, 0], [1, "x", 0]]}, "is no table of marks: ValueError"),
        ({"marks": [[0, 0, 0], [1, 2]]}, "is no table of marks"),
        ({"marks": [[0, 0, 0]]}, "needs two marks or more"),
        ({"marks": [[0, 0], [1, 1]]}, "needs two marks or more"),
        ({"marks": [[0, 0, 0], [1, float("nan"), 0]]}, "in numbers"),
        ({"marks": [[0, 0, 0], [0, 1, 0]]}, "must ascend"),
        ({"marks": [[-1, 0, 0], [0, 1, 0]]}, "must ascend from 0"),
        ({"marks": [[0, 0, 0], [1, 1, 2]]}, "airborne in .* must be true or false"),
        ({"marks": [[0, 0, False], [7, 1, True]]}, r"until 7\.00 s, but demo 'person' lasts 2\.20 s"),
    ],
)
def test_a_bad_table_is_one_sentence(table, sentence, person, tmp_path):
    file = tmp_path / "table.json"
    file.write_text(table if isinstance(table, str) else json.dumps(table))
    with pytest.raises(UserError, match=sentence):
        make_rater(f"script:{file}", None, demo=person, budget=1)


@pytest.mark.slow
@pytest.mark.skipif(not PERSON.is_file(), reason="ONEDEMO_PERSON_VIDEO names no video")
def test_the_marks_fit_the_real_video(tmp_path):
    demo = import_video(PERSON, name="person", demos_dir=tmp_path)
    marks = load_marks(TABLE, demo)
    assert marks[-1, 0] == pytest.approx((demo.frames - 1) / demo.fps, abs=1e-3)
    assert 350 < marks[-1, 1] <= 360 and marks[0, 1] < -60
    in_the_air = marks[marks[:, 2] == 1, 0]
    assert np.ptp(in_the_air) == pytest.approx(22 / 30, abs=0.01)
