"""``onedemo robot``, and a person's own robot in backup, doctor and export."""

import json
import shutil
import sqlite3
from contextlib import closing

import cv2
import numpy as np
import pytest

from helpers.hostile_archives import small_study
from helpers.paths import ROOT
from onedemo.app.cli.main import main
from onedemo.config import load_config, to_toml
from onedemo.robots import registry
from onedemo.robots.library import robots_in
from onedemo.storage.database import FILE_NAME
from onedemo.types import Segment

MODELS = ROOT / "tests/data/robots"


@pytest.fixture(autouse=True)
def nobody_elses():
    yield
    registry.use(None)


@pytest.fixture
def data_dir(tmp_path):
    """With a robot that has files, and a run of it with a rated clip."""
    data_dir = tmp_path / "data"
    assert main(["robot", "add", str(MODELS / "crane/crane.xml"), "--name", "mine", *at(data_dir)]) == 0
    registry.use(data_dir)
    robot = registry.robot_named("mine")
    steps = (np.zeros((4, n)) for n in (robot.obs_size, robot.action_size, robot.positions, robot.velocities))
    small_study(data_dir, Segment(**dict(zip(("obs", "actions", "qpos", "qvel"), steps, strict=True))))
    config = to_toml(load_config(None, {"env": "mine", "env_sha256": robot.sha256}))
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        db.execute("UPDATE runs SET config = ?", (config,))
        db.commit()
    (data_dir / "runs/r/config.toml").write_text(config)
    return data_dir


def at(data_dir):
    return ["--data-dir", str(data_dir)]


def test_a_robot_is_added_listed_shown_drawn_and_removed(tmp_path, capsys):
    data_dir = tmp_path / "data"
    choices = ["--keypoints", "hand, upper", "--control-step", "0.016", "--camera", "xz,2,0.5"]
    assert main(["robot", "add", str(MODELS / "arm.xml"), "--name", "mine", *choices, *at(data_dir)]) == 0
    added = capsys.readouterr().out
    assert main(["robot", "show", "mine", *at(data_dir)]) == 0
    shown = capsys.readouterr().out
    assert added.startswith(shown)
    for said in (
        "fixed: it stands fast, the camera stands still", "0.016 s, 4 of the model's 0.004 s",
        "3, -1..1 for -1.5..1.5, -2.44346..2.44346", "6: 3 positions, 3 velocities",
        "upper, hand", "xz,2,0.5",
    ):  # fmt: skip
        assert said in shown
    assert main(["robot", "list", *at(data_dir)]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == [*sorted(registry.BUILT_IN), "mine"]
    picture = tmp_path / "mine.png"
    assert main(["robot", "render", "mine", str(picture), "--count", "4", *at(data_dir)]) == 0
    drawn = cv2.imread(str(picture))
    assert drawn.shape == (480, 640, 3)
    rest, *others = (drawn[y : y + 240, x : x + 320] for y in (0, 240) for x in (0, 320))
    assert all(np.abs(rest.astype(int) - other).max() > 100 for other in others)
    assert main(["robot", "remove", "mine", *at(data_dir)]) == 0
    assert not list((data_dir / "robots").iterdir())


def test_a_robot_that_a_run_learns_with_stays(data_dir, capsys):
    assert main(["robot", "remove", "mine", *at(data_dir)]) == 2
    assert "r learns with robot mine" in capsys.readouterr().err
    assert [name for name, _ in robots_in(data_dir)] == ["mine"]


def test_a_backup_holds_it(data_dir, tmp_path):
    assert main(["backup", str(tmp_path / "b.zip"), *at(data_dir)]) == 0
    again = tmp_path / "again"
    assert main(["restore", str(tmp_path / "b.zip"), *at(again)]) == 0

    def kept(directory):
        files = (file for file in (directory / "robots").rglob("*") if file.is_file())
        return {file.relative_to(directory): file.read_bytes() for file in files}

    assert kept(again) == kept(data_dir) and len(kept(again)) == 6
    registry.use(again)
    assert registry.robot_named("mine").xml.is_relative_to(again)


def test_an_export_holds_it_and_its_clips_come_back(data_dir, tmp_path, capsys):
    assert main(["export", "--all", str(tmp_path / "export"), *at(data_dir)]) == 0
    again = tmp_path / "again"
    assert main(["import", str(tmp_path / "export"), *at(again)]) == 0, capsys.readouterr().err
    registry.use(again)
    assert registry.robot_named("mine").model_sha256
    shutil.rmtree(tmp_path / "export/robots")
    assert main(["import", str(tmp_path / "export"), *at(tmp_path / "other")]) == 2
    assert "run r: unknown robot 'mine'" in capsys.readouterr().err


def test_the_doctor_knows_it(data_dir, capsys):
    def said():
        main(["doctor", *at(data_dir)])
        return capsys.readouterr().out

    assert "1 robot of your own, as added" in said()
    (_, about), *_ = robots_in(data_dir)
    before = about.read_text()
    about.write_text(json.dumps(json.loads(before) | {"frame_skip": 3}))
    assert "run r cannot go on, robot mine has another model" in said()
    about.write_text("{")
    assert "robot mine is damaged" in said()
    shutil.rmtree(about.parent)
    assert "run r cannot go on, unknown robot 'mine'" in said()
