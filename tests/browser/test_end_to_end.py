"""The product as a person uses it: the real command, a real browser, and what is in the files afterwards."""

import csv
import json
import os
import shutil
import sqlite3
import time
import urllib.request
from contextlib import closing

import pytest

from browser.test_page import drag_slider, opened, shown_clip, until
from helpers.server_process import Serving
from helpers.stick_figure import backflip_video
from onedemo.app.cli.main import main
from onedemo.storage.database import FILE_NAME

pytestmark = pytest.mark.seam


# Few ratings, small iterations: the whole way in a minute. Everything else is as it is for people.
SETTINGS = {
    "ratings.pretrain": 5,
    "ratings.online": 40,
    "ratings.queue": 4,
    "rollouts.lanes": 16,
    "rollouts.threads": 1,
    "predictor.updates": 100,
    "practice.random_lanes": 8,
    "practice.bank_tries": 500,
}
TINY = {"width": 700, "height": 500}
"""The live robot is drawn 30 times a second."""
BRIEF = ["--set", "rollouts.total_steps=12000"]
"""Three iterations: a run that goes on for ever takes a core from the browser."""
QUICK = ["--port", "0", *(word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}"))]


@pytest.fixture
def serving(tmp_path, looked):
    shutil.copytree(looked, tmp_path / "data")
    serving = Serving(tmp_path / "data")
    yield serving
    serving.close()


def rows(data_dir, columns="clip_id, value"):
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        return db.execute(f"SELECT {columns} FROM ratings ORDER BY id").fetchall()


def skip_practice(page):
    """Somebody new begins with practice clips."""
    page.wait_for_selector("[data-introduction]", timeout=90_000)
    page.click("[data-go]")
    page.wait_for_selector(".od-practice [data-frame]", timeout=90_000)
    page.keyboard.press("s")


def health(link):
    with urllib.request.urlopen(link.split("/login")[0] + "/healthz", timeout=10) as answer:
        return json.load(answer)


def rate(page, data_dir, value, how="key"):
    """Rates the clip on screen and returns (clip, value) once the database holds it."""
    clip, before = shown_clip(page, guard_ms=350), len(rows(data_dir))
    if how == "key":
        page.keyboard.press(str(value))
    elif how == "button":
        page.click(f'.od-answers [data-key="{value}"]')
    else:
        drag_slider(page, value)
        page.click("[data-submit]")
    until(lambda: len(rows(data_dir)) > before)
    page.wait_for_function(
        "clip => document.querySelector('.od-clip .od-player')?.dataset.clip !== clip", arg=str(clip)
    )
    return clip, value


IN_SIGHT = """() => {
  const canvas = document.querySelector('canvas[data-engine]').getBoundingClientRect();
  return canvas.width > 150 && canvas.left >= 0 && canvas.right <= innerWidth + 1
    && canvas.top >= 0 && canvas.top < innerHeight;
}"""
"""Whether the 3-D view is in the window: it lies outside until Watch is shown."""


def rate_five_and_look(chromium, serving, tmp_path, *options, method="onedemo"):
    data_dir = serving.data_dir
    _, links, log = serving.start(*QUICK, *BRIEF, *options)
    assert links, log.read_text()
    ways = [(1, "key"), (2, "button"), (5, "slider"), (3, "key"), (4, "button")]
    with opened(chromium, links["annotator"]) as page:
        skip_practice(page)
        expected = [rate(page, data_dir, value, how) for value, how in ways]
    assert rows(data_dir) == expected
    until(lambda: health(links["annotator"])["phase"] in ("online", "done"), 600)
    with opened(chromium, links["researcher"], TINY) as page:
        page.click('.od-tabs >> text="Watch"')
        page.wait_for_function(IN_SIGHT)
        seen: set[bytes] = set()  # empty, drawn, and moving

        def look() -> None:  # where it is at that moment
            where = page.locator("canvas[data-engine]").bounding_box()
            seen.add(page.screenshot(clip=where, timeout=60_000))

        until(lambda: look() or len(seen) >= 4, 600)
        page.click('.od-tabs >> text="Data"')
        page.wait_for_selector(f".od-data >> text=method {method}")
        with page.expect_download() as download:
            page.click("text=Download CSV")
        download.value.save_as(tmp_path / "ratings.csv")
    with (tmp_path / "ratings.csv").open(newline="") as file:
        downloaded = [(int(row["clip_id"]), int(row["value"])) for row in csv.DictReader(file)]
    assert downloaded == expected


def test_ratings_teach_another_body_filmed_by_anybody(chromium, serving, tmp_path):
    video = backflip_video(tmp_path / "filmed.mp4")
    add = ["demo", "add", str(video), "--name", "figure", "--data-dir", str(serving.data_dir)]
    assert main(add) == 0
    rate_five_and_look(chromium, serving, tmp_path, "--demo", "figure")


@pytest.mark.skipif(not os.environ.get("ONEDEMO_LONG"), reason="as the test above, longer: ONEDEMO_LONG=1")
def test_ratings_teach_the_papers_method(chromium, serving, tmp_path):
    rate_five_and_look(chromium, serving, tmp_path, "--method", "paper", method="paper")


def test_kill_9_in_the_middle_of_rating_loses_nothing(chromium, serving):
    data_dir = serving.data_dir
    child, links, _ = serving.start(*QUICK)
    with opened(chromium, links["annotator"]) as page:
        skip_practice(page)
        given = [rate(page, data_dir, value) for value in (1, 2, 3, 1, 2)]
        until(lambda: iterations(data_dir) >= 2, 600)
        given += [rate(page, data_dir, value) for value in (4, 2)]
        page.keyboard.press("3")  # and the process dies in that moment
        child.kill()
        child.wait()
    before = rows(data_dir)
    assert [row for row in before if row in given] == given and len(before) - len(given) in (0, 1)
    done = iterations(data_dir)
    began = time.monotonic()
    _, again, log = serving.start(*QUICK)
    assert again, log.read_text()
    assert time.monotonic() - began < 600
    assert [link.split("token=")[1] for link in again.values()] == [
        link.split("token=")[1] for link in links.values()
    ]
    assert rows(data_dir) == before
    with opened(chromium, again["annotator"]) as page:
        page.wait_for_selector(f".od-progress >> text=Everybody: {len(before)} of 45")
        rate(page, data_dir, 5)
    until(lambda: iterations(data_dir) > done, 600)
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        assert db.execute("SELECT COUNT(*) FROM runs").fetchone() == (1,)
        numbers = [n for (n,) in db.execute("SELECT number FROM iterations ORDER BY number")]
        steps = [n for (n,) in db.execute("SELECT env_steps FROM iterations ORDER BY number")]
        assert numbers == list(range(1, len(numbers) + 1)) and steps == [4000 * n for n in numbers]
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def iterations(data_dir):
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        return db.execute("SELECT COUNT(*) FROM iterations").fetchone()[0]
