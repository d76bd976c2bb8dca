"""The way of a press in a real browser: from the key to the next clip on screen."""

from __future__ import annotations

import asyncio
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from load.serving import Stocked, annotator_link, bring, stocked
from onedemo.experiments.speed.figures import Result, Skipped, single

CHROMIUM_FLAGS = [
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",  # what is no WebGL is painted faster without a GPU that is none
    "--disable-gpu-rasterization",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
"""WebGL without a GPU, and no talk to anybody but the page."""
_PAUSE_S = 0.7
"""From a clip on screen to the key; the page takes none within 0.3 s."""
_PATIENCE_S = 30.0
# The clock starts with the time stamp that the browser gave the key. It stops in the first frame after the
# one in which another clip's picture was drawn: by then the browser has painted that.
_WATCH = """() => {
  window.painted = [];
  const player = () => document.querySelector(".od-clip > [data-src][data-clip]");
  addEventListener("keydown", (event) => {
    const before = player()?.dataset.clip;
    const look = () => {
      const now = player();
      if (now && now.dataset.clip !== before && now.dataset.frame !== undefined)
        requestAnimationFrame(() => window.painted.push(performance.now() - event.timeStamp));
      else requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
  }, true);
}"""
_SHOWN = ".od-clip > [data-src][data-clip][data-frame]"


def find_chromium() -> str | None:
    """The program, if there is one."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((found for name in names if (found := shutil.which(name))), None)


def measure(quick: bool) -> list[Result]:
    """Everything of this module.

    Args:
        quick: Few presses.
    """
    try:
        import playwright.async_api  # noqa: F401
    except ImportError:
        return [Skipped(name="painted", reason="playwright is not installed: pip install -e '.[test]'")]
    if sys.platform != "linux" or find_chromium() is None:
        return [Skipped(name="painted", reason="there is no Chromium: install the package chromium")]
    with tempfile.TemporaryDirectory(prefix="onedemo-bench-") as place:
        return asyncio.run(_measure(Path(place) / "data", *((1, 20) if quick else (3, 60))))


async def _measure(data_dir: Path, turns: int, presses: int) -> list[Result]:
    async with stocked(data_dir, people=5) as study:
        return await press_to_paint(study, turns=turns, presses=presses)


async def press_to_paint(study: Stocked, *, turns: int, presses: int) -> list[Result]:
    """Key press to the next clip painted, while the trainer runs and while it is paused.

    Args:
        study: Its other people rest.
        turns: Of each side.
        presses: In a turn.
    """
    from playwright.async_api import async_playwright

    p95: dict[str, list[float]] = {"online": [], "paused": []}
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=find_chromium(), args=CHROMIUM_FLAGS)
        page = await browser.new_page(viewport={"width": 1440, "height": 900})
        await page.goto(annotator_link(study.server, study.store, "at a browser"))
        await page.wait_for_selector(_SHOWN, timeout=1000 * _PATIENCE_S)
        await page.evaluate(_WATCH)
        for _ in range(turns):
            for phase, taken in p95.items():
                await bring(study.session, study.server, phase)
                taken.append(float(np.percentile([await _press(page) for _ in range(presses)], 95)))
        await browser.close()
    how = (
        f"95th percentile of {presses} presses, {turns} turns by turns with practice paused; Chromium with "
        "WebGL in software on the same cores; from the key's time stamp to the frame after the picture was "
        "drawn; each clip drawn for it"
    )
    return [
        single("painted_ms", "key press to next clip painted, 95th percentile, training", p95["online"],
               unit="ms", reach=100, how=how),
        single("painted_paused_ms", "the same, training paused", p95["paused"], unit="ms", how=how),
    ]  # fmt: skip


async def _press(page: Any) -> float:
    """Rates the clip on screen; how long until the next was painted, ms."""
    await asyncio.sleep(_PAUSE_S)
    count = await page.evaluate("painted.length")
    await page.keyboard.press(str(1 + count % 5))
    end = time.monotonic() + _PATIENCE_S  # the page's policy lets nobody wait by a function
    while await page.evaluate("painted.length") == count:
        if time.monotonic() > end:
            raise RuntimeError(f"waited {_PATIENCE_S:.0f} s in vain for the next clip")
        await asyncio.sleep(0.05)
    return await page.evaluate("painted.at(-1)")
