"""Fixtures shared by the tests: a browser, and a page with a stand-in trainer behind a real front."""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from onedemo.core.process import prepare_process

prepare_process()  # as every program of onedemo does, before NumPy and MuJoCo are imported
if "PYTEST_XDIST_WORKER" in os.environ:  # before torch: the cores are taken by the tests side by side
    os.environ.setdefault("OMP_NUM_THREADS", "1")


LONGEST = (
    "test_end_to_end test_rating_flow test_page test_charts test_layout test_researcher test_served_product"
    " test_line test_faults test_trainer test_clip_player test_jobs test_accessible test_cli test_renderer"
    " test_learner test_backup_doctor test_addresses_and_demos test_resume test_start test_speed test_kills"
    " test_installed test_foreign_code test_custom test_security test_speed_pictures test_sandboxed_decoder"
    " test_warm_start test_pictures test_warp_physics test_proxies test_drawing_process test_packages"
    " test_preferences test_uploads test_http_server test_learned_distance test_library test_overload"
).split()
"""Files of tests by how long they take, the longest first: begun in that order, all workers end together."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; within a file the order stays."""
    place = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Playwright's synchronous interface keeps a loop in this thread; who has no browser may run another."""
    loop = asyncio._get_running_loop()
    if "chromium" not in getattr(item, "fixturenames", ()):
        asyncio._set_running_loop(None)
    try:
        return (yield)
    finally:
        asyncio._set_running_loop(loop)


@pytest.fixture(scope="session", autouse=True)
def warm_servers() -> None:
    """Servers are forks of a process that has imported what they need."""
    from helpers import warm
    from load import serving

    serving.begin = warm.begin


@pytest.fixture(scope="session")
def looked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory that knows the demo already, to be copied: made once for all processes."""
    from onedemo.core.files import hold
    from onedemo.demos.library import find_demo
    from onedemo.vision.encoders import demo_features, make_encoder

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    directory = shared / "looked"
    with hold(shared / "looked.lock", wait=True):
        encoder = make_encoder("efficientnet-lite0")
        demo_features(find_demo("hopper-backflip", directory / "demos"), encoder, directory / "demos")
    return directory


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory, looked: Path) -> Path:
    """Where runs of the tests are kept, with a cache of what they share."""
    directory = tmp_path_factory.mktemp("results")
    shutil.copytree(looked, directory / "cache")
    return directory


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A real headless Chromium, launched by Playwright."""
    from load.painted import CHROMIUM_FLAGS, find_chromium

    path = find_chromium()
    if path is None:
        reason = "there is no Chromium: install the package chromium"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM_FLAGS)
        yield browser
        browser.close()


@dataclass
class Site:
    """A running front with a page and a trainer behind it."""

    trainer: Any
    page: Any
    front: Any
    url: str
    links: dict[str, str] = field(default_factory=dict)

    def events(self) -> list[tuple]:
        """What raters did: (kind, clip, value, rater), oldest first, read past the store."""
        import sqlite3
        from contextlib import closing

        with closing(sqlite3.connect(self.trainer.store.path)) as db:
            return db.execute(
                "SELECT e.kind, e.clip_id, e.value, p.name FROM events e JOIN raters p ON p.id = e.rater_id"
                " ORDER BY e.id"
            ).fetchall()


_ports: list[int] = []
"""Where the last front was: at the same address a browser has the page's files, compiled."""


@pytest.fixture
def live_fps() -> float:
    """Frames a second of the live robot: without a GPU each keeps a core busy for a quarter of a second."""
    return 0.5


@pytest.fixture
def site(tmp_path: Path, live_fps: float) -> Iterator[Site]:
    """A front with links for a researcher ("ada") and two annotators ("bo", "cy")."""
    from helpers.fake_trainer import StandIn
    from onedemo.app.annotation.assignment import Again
    from onedemo.app.http.server import Front
    from onedemo.app.http.tokens import issue_link, read_secret
    from onedemo.app.network.bind import Listening
    from onedemo.app.services.demo_images import Pictures
    from onedemo.app.ui.app import Page
    from onedemo.errors import UserError

    trainer = StandIn(tmp_path)
    page = Page(
        trainer,
        pictures=Pictures(trainer.demo, read=lambda _: trainer.frames, track=lambda: trainer.track),
        again=Again(shared=0, repeated=0),
        guard_seconds=0.05,
        live_fps=live_fps,
    )
    try:
        front = Front(page, Listening(port=_ports.pop() if _ports else 0))
        url = front.start()
    except UserError:  # somebody else has taken it meanwhile
        front = Front(page, Listening(port=0))
        url = front.start()
    _ports.append(front.port)
    site = Site(trainer, page, front, url)
    secret = read_secret(tmp_path)
    for title, name in (("researcher", "ada"), ("annotator", "bo"), ("second annotator", "cy")):
        rater = trainer.store.accounts.ensure(name, title.split()[-1])
        trainer.store.accounts.set_practised(rater.id)
        site.links[title] = issue_link(trainer.store, secret, rater, url)
    yield site
    front.close()
    page.close()
    trainer.store.close()
