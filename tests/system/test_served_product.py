"""The bench of the product on a small scale: a real server, people who rate at it, every press counted."""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace

import pytest

from helpers import beside_playwright
from load import crowd, painted, product
from load.serving import FEW_STATES, Server, check_counts, stocked

pytestmark = pytest.mark.seam

QUICK = (*FEW_STATES, "rollouts.lanes=16", "rollouts.steps=50", "predictor.updates=50")
"""It practises in short turns: a pause begins, and a round ends, within moments."""


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory, looked):
    """Shared, so that the demo is looked at once; what the robot looks like is known, roughly."""
    directory = tmp_path_factory.mktemp("bench") / "data"
    shutil.copytree(looked, directory)
    return directory


def test_presses_are_timed_until_the_next_clip_is_painted_and_lost_ones_noticed(data_dir, chromium):
    """One server for all of it. Raises if a press is lost or doubled."""

    async def all_of_it():
        async with stocked(data_dir, people=5, settings=QUICK) as study:
            pressed = await product.press_times(study, turns=1, seconds=1.0, every_s={1: 0.5, 4: 1.0})
            loss_doubling_and_change_are_noticed(study)
            return (
                pressed,
                await crowd.crowd(study, people=5, every_s=0.5, seconds=1.0, settle_s=0.2),
                await painted.press_to_paint(study, turns=1, presses=3),
            )

    pressed, together, seen = beside_playwright.run(all_of_it())
    assert [figure.name for figure in pressed] == ["press_1_annotator", "press_4_annotators"]
    for figure in pressed:
        assert math.isfinite(figure.value) and figure.reach == 2 and not figure.at_least
        assert all(0 < p95 < 120_000 for side in figure.sides.values() for p95 in side)
    figures = {figure.name: figure for figure in together}
    assert figures["crowd_lost"].met and re.search(r"of ([5-9]|1\d)$", figures["crowd_lost"].what)
    assert 0 < figures["crowd_press_median_ms"].value <= figures["crowd_press_ms"].value < 120_000
    assert 50 < figures["crowd_memory_start_mib"].value < 4000
    training, paused = seen
    assert training.reach == 100 and 0 < paused.value < 120_000 and 0 < training.value < 120_000


def loss_doubling_and_change_are_noticed(study):
    presses = [press for tab in study.tabs for press in tab.presses]
    check_counts(study.server, presses, after=study.before)
    changed = replace(presses[0], value=presses[0].value % 5 + 1)
    for wrong in (presses[1:], [*presses, presses[0]], [changed, *presses[1:]]):
        with pytest.raises(RuntimeError, match=f"{len(wrong)} presses became {len(presses)} events"):
            check_counts(study.server, wrong, after=study.before)
    assert 50 < study.server.peak_mib() < 4000


def test_start_is_timed_until_the_page_shows_something(data_dir):
    assert 0 < beside_playwright.run(product.start_time(data_dir, 1)).value < 60


def test_server_that_cannot_start_says_why(data_dir):
    with pytest.raises(RuntimeError, match="unknown key 'nonsense'"):
        Server(data_dir, ["nonsense=1"])
