"""Curves over HTTP: for researchers alone, of any run, and what is asked wrongly."""

import asyncio
import hashlib
import json
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from aiohttp import CookieJar
from aiohttp.test_utils import TestClient, TestServer

from helpers.curves import train
from helpers.fake_trainer import StandIn
from helpers.paths import ROOT
from onedemo.app.http.server import Front
from onedemo.app.http.tokens import issue_link, read_secret
from onedemo.app.network.bind import Listening
from onedemo.demos.library import find_demo
from onedemo.evaluation.demo_level import true_reward_of
from onedemo.reward.model import PredictorConfig, View, fit
from onedemo.storage.run_directory import RunDirectory
from unit.reward.test_model import world


@pytest.fixture
def trainer(tmp_path):
    trainer = StandIn(tmp_path, clips=1)
    yield trainer
    trainer.store.close()


def ask(trainer, *paths, role="researcher"):
    """Status and text of each path, below the person and without."""
    page = SimpleNamespace(
        trainer=trainer, pictures=None, study=None, port=0, secret="", is_open=lambda *_: False
    )
    front = Front(page, Listening(port=0))

    async def visit():
        async with TestServer(front._access.application(front.routes())) as server:
            async with TestClient(server, cookie_jar=CookieJar(unsafe=True)) as client:
                if role:
                    rater = trainer.store.accounts.ensure("somebody", role)
                    link = issue_link(trainer.store, read_secret(trainer.data_dir), rater, "")
                    await client.get(link)
                answers = [await client.get(path) for path in paths]
                return [(answer.status, await answer.text()) for answer in answers]

    return asyncio.run(visit())


@pytest.mark.parametrize(("role", "status"), [("", 401), ("annotator", 403), ("researcher", 200)])
def test_only_researchers_get_curves(trainer, role, status):
    ((got, text),) = ask(trainer, f"/curves.json?run={trainer.run}", role=role)
    assert got == status and ("columns" in text) == (status == 200)


def test_any_run_is_told_of_with_its_own_colour(trainer):
    trainer.store.runs.add(run="hop-1", demo="hop", demo_sha256="1", seed=1, config="", version="0")
    train(trainer.store, "hop-1", 1, 4)
    (_, here), (_, there), (_, later) = ask(
        trainer, f"/curves.json?run={trainer.run}", "/curves.json?run=hop-1", "/curves.json?run=hop-1&after=3"
    )
    here, there, later = map(json.loads, (here, there, later))
    assert (here["colour"], here["live"], there["colour"], there["live"]) == (1, True, 2, False)
    assert there["columns"]["number"] == [1, 2, 3, 4] and later["columns"]["number"] == [4]


def test_levels_of_the_demo_are_told_of_any_run_and_of_the_papers_predictor(trainer):
    """That one has no best rating of its own: it is asked about the states behind the video."""
    store, demo = trainer.store, find_demo("hopper-backflip", trainer.data_dir / "demos")
    for run in ("hop-1", "paper-1"):
        store.runs.add(run=run, demo=demo.name, demo_sha256=demo.sha256, seed=1, config="", version="0")
    store.runs.describe("hop-1", title="By three raters", note="")
    train(store, "hop-1", 1, 2)
    store.runs.add_iteration("paper-1", 1, snapshot=1, env_steps=16_000, stats={"predicted": 2.0})
    ratings, shown = world(20, seed=0)
    view = View(
        visual=np.zeros((demo.frames, 8), np.float32), track=None,
        basis=np.ones((demo.frames, 1), np.float32), fps=demo.fps,
    )  # fmt: skip
    net = PredictorConfig(kind="network", appearance=False, members=1, updates=5, visual_dims=8)
    fit(ratings, shown, view, net, number=1, seed=0)[0].save(
        RunDirectory(trainer.data_dir, "paper-1").snapshot(1)
    )
    answers = ask(
        trainer, "/curves.json?run=hop-1", "/curves.json?run=paper-1", "/curves.json?run=paper-1&after=1"
    )
    hop, paper, later = (json.loads(text) for _, text in answers)
    assert (hop["title"], paper["title"]) == ("By three raters", "")
    assert hop["levels"] == {"true_reward": pytest.approx(true_reward_of(demo))}
    assert hop["levels"]["true_reward"] == paper["levels"]["true_reward"]
    assert 1 < paper["levels"]["reference"] < 5 and later["levels"] == paper["levels"]


def test_what_is_asked_wrongly_is_said(trainer):
    wrong = ("", "?run=", "?run=a&after=x", "?run=a&after=-1", f"?run={'a' * 201}", f"?run=a&after={10**12}")
    assert [status for status, _ in ask(trainer, *(f"/curves.json{query}" for query in wrong))] == [400] * 6
    assert ask(trainer, "/curves.json?run=nothing") == [(404, "There is no such run.")]


def test_a_vendored_file_is_served_and_nothing_beside_it(trainer):
    found = ask(
        trainer, "/static/vendor/uplot/uPlot.iife.min.js", "/static/vendor/uplot/LICENSE",
        "/static/vendor/uplot/none.js", "/static/vendor/none/page.css",
        "/static/vendor/uplot/..%2f..%2fpage.css",
    )  # fmt: skip
    assert [status for status, _ in found] == [200, 404, 404, 404, 404]
    assert "uPlot" in found[0][1]


def test_what_is_vendored_is_as_it_was_published():
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["onedemo"]["vendored"]
    vendor = ROOT / "static" / "vendor"
    assert {folder.name for folder in vendor.iterdir()} == set(tools)
    for name, package in tools.items():
        there = {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in (vendor / name).iterdir()}
        assert there == package["sha256"] and "LICENSE" in there
        assert f"v{package['version']}".encode() in (vendor / name / "uPlot.iife.min.js").read_bytes()[:200]
