"""Many people at once for a while: how long they wait, what it costs in memory, whether a rating is lost."""

from __future__ import annotations

import asyncio
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from load.serving import Stocked, bring, reach, stocked
from onedemo.experiments.speed.figures import Result, Skipped, single

PEOPLE = 50
EVERY_S = 4.0
SECONDS = 180.0


def measure(quick: bool) -> list[Result]:
    """Everything of this module.

    Args:
        quick: For a few seconds instead of three minutes.
    """
    if sys.platform != "linux":
        return [Skipped(name="crowd", reason="memory of a server is measured on Linux only")]
    with tempfile.TemporaryDirectory(prefix="onedemo-bench-") as place:
        return asyncio.run(_measure(Path(place) / "data", 12.0 if quick else SECONDS))


async def _measure(data_dir: Path, seconds: float) -> list[Result]:
    async with stocked(data_dir, people=PEOPLE) as study:
        return await crowd(study, people=PEOPLE, every_s=EVERY_S, seconds=seconds)


async def crowd(
    study: Stocked, *, people: int, every_s: float, seconds: float, settle_s: float = 5.0
) -> list[Result]:
    """People who all rate at a steady pace while the robot practises.

    Args:
        study: With clips for all.
        people: How many.
        every_s: Seconds from press to press of each.
        seconds: How long.
        settle_s: Seconds that all pages are open before memory is read for the first time.

    Raises:
        RuntimeError: If a rating was lost or doubled, or practice stood still.
    """
    await bring(study.session, study.server, "online")
    await study.open(people)
    await asyncio.sleep(settle_s)
    before, start, began = study.iterations(), study.server.resident_mib(), time.monotonic()
    taken = await study.rate(every_s, seconds)
    pace = len(taken) / (time.monotonic() - began)
    end, iterations = study.server.resident_mib(), study.iterations() - before
    study.check()
    # On a busy machine an iteration may outlast a short turn; one that never ends is a fault.
    await reach(lambda: study.iterations() > before, "an iteration of practice")
    count = len(taken)
    how = (
        f"{people} sockets, each a rating every {every_s:g} s for {seconds:g} s, {iterations} iterations of "
        f"practice meanwhile; {count} ratings counted in the database; each clip drawn for it"
    )
    return [
        single("crowd_press_ms", f"press to next clip and its picture, 95th percentile, {people} people",
               [float(np.percentile(taken, 95))], unit="ms", how=how),
        single("crowd_press_median_ms", "the same, median", [float(np.median(taken))], unit="ms", how=how),
        single("crowd_pace", "ratings a second, all together", [pace], unit="1/s", how=how),
        single("crowd_lost", f"ratings lost or doubled, of {count}", [0.0], unit="", reach=0, how=how),
        single("crowd_memory_start_mib", "memory of the server as they begin", [start], unit="MiB", how=how),
        single("crowd_memory_end_mib", "memory of the server at the end", [end], unit="MiB", how=how),
    ]  # fmt: skip
