from dataclasses import replace
from pathlib import Path

import pytest

from helpers.paths import ROOT
from onedemo.config import load_config
from onedemo.errors import UserError
from onedemo.robots import registry
from onedemo.robots.library import add_robot, remove_robot
from onedemo.storage.store import Store
from onedemo.training.runs import add_run, disk_needed, find_run
from onedemo.types import Demo

DEMO = Demo(name="flip", sha256="aa", path=Path("flip.webm"), fps=30.0, frames=60, width=8, height=8)


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    yield store
    store.close()


def test_new_runs_are_numbered(store, tmp_path):
    assert find_run(store, tmp_path, DEMO, name=None, wanted=None) is None
    assert add_run(store, tmp_path, DEMO, load_config(), name=None) == "flip-1"
    assert add_run(store, tmp_path, DEMO, load_config(), name=None) == "flip-2"
    assert add_run(store, tmp_path, DEMO, load_config(), name="mine") == "mine"
    assert (tmp_path / "runs" / "flip-2" / "config.toml").exists()


def test_a_demo_with_the_longest_name_has_runs(store, tmp_path):
    demo = replace(DEMO, name="x" * 64)
    assert add_run(store, tmp_path, demo, load_config(), name=None) == "x" * 64 + "-1"
    found = find_run(store, tmp_path, demo, name=None, wanted=None)
    assert found is not None and found[0] == "x" * 64 + "-1"


def test_the_newest_run_of_the_demo_goes_on_with_its_own_settings(store, tmp_path):
    settings = load_config(None, {"seed": 4, "trpo.max_kl": 0.02})
    add_run(store, tmp_path, DEMO, load_config(), name=None)
    add_run(store, tmp_path, DEMO, settings, name=None)
    add_run(store, tmp_path, replace(DEMO, name="other"), load_config(), name=None)
    assert find_run(store, tmp_path, DEMO, name=None, wanted=None) == ("flip-2", settings)
    assert find_run(store, tmp_path, DEMO, name="flip-1", wanted=load_config()) == ("flip-1", load_config())


def test_settings_that_contradict_the_run_are_refused(store, tmp_path):
    add_run(store, tmp_path, DEMO, load_config(), name=None)
    with pytest.raises(UserError, match="other settings than those given: seed is 0, not 1 "):
        find_run(store, tmp_path, DEMO, name=None, wanted=load_config(None, {"seed": 1}))


def test_a_run_may_go_on_on_another_device(store, tmp_path):
    run = add_run(store, tmp_path, DEMO, load_config(None, {"device": "cuda"}), name=None)
    assert find_run(store, tmp_path, DEMO, name=run, wanted=load_config()) == (run, load_config())


def test_a_run_may_go_on_with_another_ceiling_for_its_pictures(store, tmp_path):
    run = add_run(store, tmp_path, DEMO, load_config(), name=None)
    wanted = load_config(None, {"storage.pictures_gb": 1.5})
    assert find_run(store, tmp_path, DEMO, name=run, wanted=wanted) == (run, wanted)


def test_what_a_run_needs_grows_with_its_ratings_and_not_with_their_pictures():
    def needed(**changes):
        return disk_needed(load_config(None, {key.replace("__", "."): v for key, v in changes.items()})) / 1e6

    assert 60 < needed() < 120
    assert needed(ratings__online=10_000) - needed() == pytest.approx(98.5, abs=0.1)
    assert needed(storage__pictures_gb=2.0) - needed() == pytest.approx(1980)


def test_another_video_under_the_same_name_is_refused(store, tmp_path):
    add_run(store, tmp_path, DEMO, load_config(), name=None)
    with pytest.raises(UserError, match="another video"):
        find_run(store, tmp_path, replace(DEMO, sha256="bb"), name=None, wanted=None)


def test_settings_survive_the_loss_of_their_file(store, tmp_path):
    settings = load_config(None, {"seed": 9})
    run = add_run(store, tmp_path, DEMO, settings, name=None)
    (tmp_path / "runs" / run / "config.toml").unlink()
    assert find_run(store, tmp_path, DEMO, name=run, wanted=None) == (run, settings)


BEFORE = """seed = 3
env = "hopper"
device = "cpu"
encoder = "efficientnet-lite0"

[ratings]
pretrain = 20
online = 15
clip_seconds = 0.3
queue = 12
stale_iterations = 10
online_share = 0.5

[rollouts]
lanes = 64
steps = 250
total_steps = 10000000
threads = 2
physics = "mujoco"

[predictor]
sampling = "equal"
class_weights = false
additional_layer = true
hidden = 64
visual_dims = 24
learning_rate = 0.03
weight_decay = 0.0001
batch_clips = 60
pairs_per_clip = 4
updates = 1500
reward = "expected"

[policy]
kind = "clock"
hidden = [64, 64]
log_std = 0.0

[trpo]
max_kl = 0.02
gamma = 0.99
lam = 0.97
cg_iterations = 10
damping = 0.1
backtracks = 10
backtrack_factor = 0.8
fisher_samples = 8192
value_epochs = 5
value_rate = 0.001
value_batch = 2048
entropy_bonus = 0.0
"""
"""What version 0.1 wrote."""


def test_a_run_of_before_there_were_methods_is_the_papers(store, tmp_path):
    run = add_run(store, tmp_path, DEMO, load_config(), name=None)
    (tmp_path / "runs" / run / "config.toml").write_text(BEFORE)
    found = find_run(store, tmp_path, DEMO, name=run, wanted=None)
    assert found is not None
    config = found[1]
    settings = {"seed": 3, "ratings.pretrain": 20, "ratings.online": 15, "trpo.max_kl": 0.02}
    # The trust region stayed what it was.
    assert config == load_config(
        None, settings | {"method": "paper", "trpo.final_kl": 0.02, "predictor.visual_dims": 24}
    )
    with pytest.raises(UserError, match="method is 'paper', not 'onedemo'"):
        find_run(store, tmp_path, DEMO, name=run, wanted=load_config(None, settings))


@pytest.mark.parametrize("name", ["../out", "a/b", "", "x" * 65, "a b"])
def test_names_that_are_no_directory_are_refused(store, tmp_path, name):
    with pytest.raises(UserError):
        add_run(store, tmp_path, DEMO, load_config(), name=name)


def test_a_taken_name(store, tmp_path):
    add_run(store, tmp_path, DEMO, load_config(), name="mine")
    with pytest.raises(UserError, match="'mine' exists already"):
        add_run(store, tmp_path, DEMO, load_config(), name="mine")


def test_a_run_is_found_although_its_demo_has_another_name(store, tmp_path):
    run = add_run(store, tmp_path, DEMO, load_config(), name=None)
    renamed = replace(DEMO, name="renamed")
    assert find_run(store, tmp_path, renamed, name=None, wanted=None) == (run, load_config())


def test_a_run_goes_on_only_with_the_robot_it_was_made_with(store, tmp_path):
    models = ROOT / "tests/data/robots"
    registry.use(tmp_path)
    try:
        add_robot(models / "arm.xml", tmp_path, name="mine")
        settings = load_config(None, {"env": "mine"})
        run = add_run(store, tmp_path, DEMO, settings, name=None)
        assert find_run(store, tmp_path, DEMO, name=run, wanted=settings) == (run, settings)
        remove_robot("mine", tmp_path)
        registry.use(tmp_path)
        with pytest.raises(UserError, match="unknown robot 'mine'"):
            find_run(store, tmp_path, DEMO, name=run, wanted=None)
        add_robot(models / "tendons.xml", tmp_path, name="mine")
        registry.use(tmp_path)
        with pytest.raises(UserError, match=f"run '{run}' was made with another model of robot mine"):
            find_run(store, tmp_path, DEMO, name=run, wanted=None)
        with pytest.raises(UserError, match="settings are of a run with another model of robot mine"):
            add_run(store, tmp_path, DEMO, replace(settings, env_sha256="0" * 64), name=None)
    finally:
        registry.use(None)


def test_a_run_of_before_robots_were_noted_goes_on(store, tmp_path):
    run = add_run(store, tmp_path, DEMO, load_config(), name=None)
    file = tmp_path / "runs" / run / "config.toml"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(line for line in lines if not line.startswith("env_sha256")))
    assert len(lines) > len(file.read_text().splitlines())
    assert find_run(store, tmp_path, DEMO, name=run, wanted=load_config()) == (run, load_config())


def test_a_demo_of_another_robot_is_refused(store, tmp_path):
    made = replace(DEMO, robot="walker2d")
    with pytest.raises(UserError, match="shows robot 'walker2d', but this run's robot is"):
        add_run(store, tmp_path, made, load_config(), name=None)
    assert not store.runs.all()
    assert add_run(store, tmp_path, made, load_config(None, {"env": "walker2d"}), name=None) == "flip-1"
    with pytest.raises(UserError, match="unknown robot 'nobody'"):
        add_run(store, tmp_path, made, load_config(None, {"env": "nobody"}), name=None)


def test_a_demo_of_another_robot_is_refused_before_anything_is_written(store, tmp_path):
    config = load_config(None, {"env": "walker2d"})
    demo = replace(DEMO, robot="hopper")
    with pytest.raises(UserError, match="shows robot 'hopper', but this run's robot is 'walker2d': choose"):
        add_run(store, tmp_path, demo, config, name=None)
    assert store.runs.all() == [] and not (tmp_path / "runs").exists()
    add_run(store, tmp_path, replace(DEMO, robot="walker2d"), config, name="own")
    add_run(store, tmp_path, DEMO, config, name="any")  # a video of no robot in particular
