"""One run after another under one roof: opened, made, started from another's predictor, and nothing lost."""

import json
import shutil
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
from onedemo.render.renderer import RenderThread
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


@pytest.mark.parametrize(
    ("fields", "words"),
    [
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
    actions.do(ada, {"do": "exclude", "rater": ada.id})
    assert study._store.ratings.left_out("second") == {ada.id}
    for body in (
        None, [], {}, {"do": 1}, {"do": "fly"}, {"do": "open run"}, {"do": "open run", "run": 1},
        {"do": "open run", "run": "a\nb"}, {"do": "open run", "run": "x" * 101},
        {"do": "exclude", "rater": True}, {"do": "exclude", "rater": 99},
        {"do": "exclude", "rater": ada.id, "more": 1},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"action|rater|run is"):
            actions.do(Rater(id=ada.id, name="ada", role="researcher"), body)
    assert study.trainer.run == "second"
