"""One run after another under one roof: opened, made, started from another's predictor, and nothing lost."""

import json
import shutil
import sqlite3
from contextlib import closing
from dataclasses import asdict

import pytest

from helpers.small_world import Thumbnail, falling_demo, small_config
from onedemo.app.http.commands import Actions
from onedemo.app.services import run_manager as module
from onedemo.app.services.run_manager import Study
from onedemo.core.files import hold
from onedemo.demos.ground_truth import hidden_path
from onedemo.demos.library import find_demo, rename_demo
from onedemo.errors import UserError
from onedemo.render.render_thread import RenderThread
from onedemo.storage.store import Store
from onedemo.training.rating_queue import Simulated
from onedemo.training.runs import add_run
from onedemo.training.training_run import TrainingRun
from onedemo.types import Rater

pytestmark = pytest.mark.seam


@pytest.fixture
def study(tmp_path, monkeypatch):
    demo = falling_demo(tmp_path / "demo")
    monkeypatch.setattr(module, "make_encoder", lambda name, weights: Thumbnail())
    monkeypatch.setattr(module, "find_demo", lambda name, directory: demo)
    data_dir = tmp_path / "data"
    with closing(Store(data_dir)) as store, RenderThread() as drawing:
        for name in ("first", "second"):
            add_run(store, data_dir, demo, small_config(), name=name)
        rated = Simulated(name="rule", rate=lambda segment, step: 1 + step % 5)
        training = TrainingRun(
            store=store, data_dir=data_dir, run="second", demo=demo, config=small_config(),
            encoder=Thumbnail(), simulated=rated,
        )  # fmt: skip
        training.prepare()
        while training.step() != "done":
            pass
        served = []
        study = Study(store, data_dir, drawing, served=lambda trainer: served.append(trainer.run))
        study.shown = served  # type: ignore[attr-defined]
        study.serve("first", demo, small_config())
        study.trainer.start()
        yield study
        study.close()


def test_another_run_is_opened_and_the_one_before_is_free(study):
    before = study.trainer
    study.open("second")
    assert study.trainer.run == "second" and study.shown == ["first", "second"]
    assert before.status().phase == "stopped" and not before._thread.is_alive()
    assert study.trainer.status().phase in ("starting", "online", "done")
    with hold(before.directory / "lock"):
        pass
    with pytest.raises(UserError, match="another onedemo"), hold(study.trainer.directory / "lock"):
        pass
    study.open("first")
    assert study.trainer.run == "first"


def test_a_run_is_opened_although_its_demo_was_renamed(study, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_demo", find_demo)
    demo, demos = study.trainer.demo, tmp_path / "data" / "demos"
    home = demos / demo.sha256
    home.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(demo.path, home / "video.webm")
    shutil.copyfile(hidden_path(demo.path), hidden_path(home / "video.webm"))
    about = asdict(demo) | {"path": "", "video_sha256": demo.sha256}
    (home / "demo.json").write_text(json.dumps(about))
    rename_demo(find_demo("falling", demos), "renamed", demos)
    study.open("second")
    assert study.trainer.run == "second" and study.trainer.demo.name == "renamed"


def test_a_run_starts_from_the_predictor_of_another(study):
    run = study.create(demo="falling", method="paper", seed=3, name="third", predictor_from="second")
    assert run == study.trainer.run == "third" and study.trainer.config.seed == 3
    assert study.trainer.config.ratings == small_config().ratings  # as the server was told
    newest = max(study.trainer.data_dir.glob("runs/second/snapshots/*.pt"))
    study.trainer.stop()
    assert (study.trainer.directory / "start.pt").read_bytes() == newest.read_bytes()


def test_a_new_run_has_the_settings_that_were_chosen(study):
    chosen = {
        "ratings.pretrain": 7,
        "ratings.choice": "high",
        "rollouts.total_steps": 5000,
        "trpo.gamma": 0.1,
    }
    study.create(demo="falling", method="paper", seed=3, name="third", settings=chosen)
    config, before = study.trainer.config, small_config()
    assert (config.ratings.pretrain, config.ratings.choice) == (7, "high")
    assert config.rollouts.total_steps == 5000
    assert config.ratings.online == before.ratings.online  # as in the run before
    assert config.trpo.gamma == before.trpo.gamma  # not offered


def test_a_run_is_called_something_and_keeps_its_name(study):
    study.describe("second", title="With marks", note="Bob left at half.")
    told = {run["id"]: (run["title"], run["note"]) for run in study._store.runs.all()}
    assert told == {"first": ("", ""), "second": ("With marks", "Bob left at half.")}
    for fields, words in (
        ({"run": "third"}, "no run 'third'"), ({"title": "x" * 65}, "a title is up to 64"),
        ({"note": "a\nb"}, "a note is up to 500"), ({"title": "a\u202eb"}, "a title"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=words):
            study.describe(**({"run": "second", "title": "", "note": ""} | fields))


def test_a_run_is_deleted_with_its_files_unless_somebody_works_on_it(study, monkeypatch):
    place = study.trainer.data_dir / "runs"
    assert sum(study._store.ratings.by_class("second")) > 0 and (place / "second" / "snapshots").is_dir()
    with pytest.raises(UserError, match="'first' is the one being served; open another one first"):
        study.delete("first")
    with pytest.raises(UserError, match="no run 'third'"):
        study.delete("third")
    with (
        hold(place / "second" / "lock"),
        pytest.raises(UserError, match="another onedemo works on run 'second'; stop that first"),
    ):
        study.delete("second")
    assert (place / "second" / "snapshots").is_dir()
    before = sorted(path.name for path in (place / "second").rglob("*"))
    with monkeypatch.context() as patch:
        patch.setattr(study._store.runs, "delete", full_disk)
        with pytest.raises(sqlite3.OperationalError):
            study.delete("second")
    assert sorted(path.name for path in (place / "second").rglob("*")) == before
    study.delete("second")
    assert [run["id"] for run in study._store.runs.all()] == ["first"]
    assert [path.name for path in place.iterdir()] == ["first"]
    assert sum(study._store.ratings.by_class("second")) == 0
    assert add_run(study._store, study.trainer.data_dir, study.trainer.demo, small_config(), name="second")


def full_disk(run):
    raise sqlite3.OperationalError("disk is full")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"settings": {"ratings.pretrain": 0}}, "ratings.pretrain must be at least 1"),
        ({"settings": {"ratings.clip_seconds": 9}}, "ratings.clip_seconds must be 0.05 to 5 s"),
        ({"settings": {"ratings.online": 1.5}}, "ratings.online must be a whole number, got 1.5"),
        ({"settings": {"ratings.choice": "magic"}}, "ratings.choice"),
        ({"method": "magic"}, "there is no method 'magic'"),
        ({"name": "first"}, "run 'first' exists already"),
        ({"name": "no/slash"}, "a name is 1 to 64"),
        ({"predictor_from": "first"}, "has no similarity predictor yet"),
        ({"predictor_from": "nobody"}, "no run 'nobody'"),
        ({"seed": 2**70}, "seed must be at least 0"),
    ],
)
def test_what_cannot_be_leaves_all_as_it_is(study, fields, words):
    before, runs = study.trainer, len(study._store.runs.all())
    given = {"demo": "falling", "method": "paper", "seed": 0, "name": "new", "predictor_from": None}
    with pytest.raises(UserError, match=words):
        study.create(**given | fields)
    assert study.trainer is before and len(study._store.runs.all()) == runs
    for name, sentence in (("first", "being served already"), ("none", "there are: first, second")):
        with pytest.raises(UserError, match=sentence):
            study.open(name)


def test_a_run_that_was_stopped_stays_so_if_another_cannot_be_opened(study):
    before = study.trainer
    with hold(before.data_dir / "runs/second/lock"):  # another process has it
        for stopped in (False, True):
            if stopped:
                before.stop()
            with pytest.raises(UserError, match="another onedemo"):
                study.open("second")
            assert study.trainer is before
            assert (before.status().phase == "stopped") is stopped
    before.resume()
    assert before.status().phase != "stopped"


class Served:
    def __init__(self, study):
        self.study = study

    @property
    def trainer(self):
        return self.study.trainer


def test_actions_take_the_fields_they_name_and_no_others(study):
    ada = study._store.accounts.ensure("ada", "researcher")
    actions = Actions(Served(study))
    actions.do(ada, {"do": "open run", "run": "second"})
    assert study.trainer.run == "second"
    actions.do(ada, {"do": "describe run", "run": "first", "title": " Before ", "note": ""})
    assert study._store.runs.all()[0]["title"] == "Before"
    actions.do(ada, {"do": "delete run", "run": "first"})
    assert len(study._store.runs.all()) == 1
    actions.do(ada, {"do": "exclude", "rater": ada.id})
    assert study._store.ratings.left_out("second") == {ada.id}
    for body in (
        None, [], {}, {"do": 1}, {"do": "fly"}, {"do": "open run"}, {"do": "open run", "run": 1},
        {"do": "open run", "run": "a\nb"}, {"do": "open run", "run": "x" * 101},
        {"do": "exclude", "rater": True}, {"do": "exclude", "rater": 99},
        {"do": "exclude", "rater": ada.id, "more": 1},
        {"do": "delete run", "run": 2}, {"do": "describe run", "run": "second", "title": "a"},
        {"do": "new run", "demo": "falling", "method": "paper", "seed": 0, "name": "", "predictor_from": "",
         "ratings.pretrain": [1]},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"action|rater|run is|setting"):
            actions.do(Rater(id=ada.id, name="ada", role="researcher"), body)
    assert study.trainer.run == "second"
