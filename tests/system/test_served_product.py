"""The bench of the product on a small scale: a real server, people who rate at it, every press counted."""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace

import pytest

from helpers import beside_playwright
from load import crowd, painted, product
from load.annotators import Press, browser_session, open_tab
from load.serving import FEW_STATES, Server, check_counts, give, stocked

pytestmark = pytest.mark.seam

QUICK = (*FEW_STATES, "rollouts.lanes=16")


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory, looked):
    """Shared, so that the demo is looked at once; what the robot looks like is known, roughly."""
    directory = tmp_path_factory.mktemp("bench") / "data"
    shutil.copytree(looked, directory)
    return directory


def test_presses_are_timed_until_the_next_clip_is_there_and_painted(data_dir, chromium):
    """One server for all of it. Raises if a press is lost or doubled."""

    async def all_of_it():
        async with stocked(data_dir, people=5, settings=QUICK) as study:
            return (
                await product.press_times(study, turns=1, seconds=2.0, every_s={1: 0.5, 4: 1.0}),
                await crowd.crowd(study, people=5, every_s=0.5, seconds=2.0, settle_s=0.5),
                await painted.press_to_paint(study, turns=1, presses=4),
            )

    pressed, together, seen = beside_playwright.run(all_of_it())
    assert [figure.name for figure in pressed] == ["press_1_annotator", "press_4_annotators"]
    for figure in pressed:
        assert math.isfinite(figure.value) and figure.reach == 2 and not figure.at_least
        assert all(0 < p95 < 20_000 for side in figure.sides.values() for p95 in side)
    figures = {figure.name: figure for figure in together}
    assert figures["crowd_lost"].met and re.search(r"of ([5-9]|1\d|2[0-5])$", figures["crowd_lost"].what)
    assert 0 < figures["crowd_press_median_ms"].value <= figures["crowd_press_ms"].value < 20_000
    assert 50 < figures["crowd_memory_start_mib"].value < 4000
    training, paused = seen
    assert training.reach == 100 and 0 < paused.value < 20_000 and 0 < training.value < 20_000


def test_lost_doubled_and_changed_ratings_are_noticed(data_dir):
    async def rate_three(server: Server) -> list[Press]:
        async with browser_session() as session:
            tab = await open_tab(session, server.links["annotator"])
            await give(tab, 3)
            await tab.close()
            return tab.presses

    with product.serving(data_dir) as server:
        ((before,),) = server.rows("SELECT IFNULL(MAX(id), 0) FROM events")
        presses = beside_playwright.run(rate_three(server))
        check_counts(server, presses, after=before)
        changed = replace(presses[0], value=presses[0].value % 5 + 1)
        for wrong in (presses[1:], [*presses, presses[0]], [changed, *presses[1:]]):
            with pytest.raises(RuntimeError, match=f"{len(wrong)} presses became 3 events"):
                check_counts(server, wrong, after=before)
        assert 50 < server.peak_mib() < 4000


def test_start_is_timed_until_the_page_shows_something(data_dir):
    assert 0 < beside_playwright.run(product.start_time(data_dir, 1)).value < 60


def test_server_that_cannot_start_says_why(data_dir):
    with pytest.raises(RuntimeError, match="unknown key 'nonsense'"):
        Server(data_dir, ["nonsense=1"])
