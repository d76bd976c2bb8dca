"""The product as people use it: how long a press, a rating and a start take, and how much memory it needs.

The real command runs as a child process; one light process plays the people at its page
(``load.annotators``) and reads the database beside it.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from load.annotators import Press, browser_session, open_tab
from load.serving import Server, Stocked, bring, check_counts, give, reach, serving, stocked
from onedemo.experiments.speed.figures import Figure, Result, Skipped, ratio, single

CROWD = 50
_EVERY_S = {1: 0.4, CROWD: 4.0}
"""Seconds from press to press of each person, by how many they are; the one makes haste to give figures."""


def measure(quick: bool) -> list[Result]:
    """Everything of this module.

    Args:
        quick: Fewer ratings, turns and starts: under a minute instead of five.
    """
    if sys.platform != "linux":
        return [Skipped(name="product", reason="memory and pages of a server are measured on Linux only")]
    with tempfile.TemporaryDirectory(prefix="onedemo-bench-") as place:
        data_dir = Path(place) / "data"
        return [
            help_time(3 if quick else 9),
            *asyncio.run(default_run(data_dir, quick=quick)),
            asyncio.run(start_time(data_dir, 1 if quick else 5)),
            *asyncio.run(_presses(data_dir, *((1, 2.0) if quick else (6, 10.0)))),
        ]


def help_time(repetitions: int) -> Figure:
    """``onedemo --help``, as a process of its own."""
    taken = []
    for _ in range(repetitions):
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "onedemo.app.cli", "--help"], check=True, stdout=subprocess.DEVNULL
        )
        taken.append(time.perf_counter() - began)
    return single("help_s", "command line to --help", taken, unit="s", reach=0.5)


async def start_time(data_dir: Path, repetitions: int) -> Figure:
    """A start on a data directory that has been used, until the page shows a clip or that it waits."""
    taken = []
    for _ in range(repetitions):
        began = time.perf_counter()
        with serving(data_dir) as server:
            async with browser_session() as session:
                tab = await open_tab(session, server.links["annotator"])
                await tab.until(lambda tab=tab: tab.clip or tab.waiting, "the page")
                taken.append(time.perf_counter() - began)
                await tab.close()
    return single(
        "start_s", "second start of serve to page ready", taken, unit="s", reach=6,
        how="default run that has practised; from the process to the page's first clip or waiting state",
    )  # fmt: skip


async def default_run(data_dir: Path, *, quick: bool) -> list[Result]:
    """Memory and the way of a rating, in the default run with a page on Rate and one on Watch.

    Args:
        data_dir: A new one.
        quick: Few ratings before practice, few iterations.
    """
    pretrain, online, iterations = (12, 2, 1) if quick else (200, 40, 12)
    with serving(data_dir, [f"ratings.pretrain={pretrain}"] if quick else []) as server:
        async with browser_session() as session:
            watch = await open_tab(session, server.links["researcher"])
            await watch.until(lambda: "alt+2" in watch.keys, "the tab Watch")
            await watch.press("alt+2")
            rate = await open_tab(session, server.links["annotator"])
            await give(rate, pretrain)
            await reach(lambda: _iterations(server) >= 1, "an iteration")
            for _ in range(online):
                await asyncio.sleep(1.0)
                await give(rate, 1)
            practised = rate.presses[pretrain:]
            await reach(lambda: len(_delays(server, practised)[1]) == online, "a policy that knows all")
            await reach(lambda: _iterations(server) >= iterations, "iterations")
            to_snapshot, to_policy = _delays(server, practised)
            check_counts(server, rate.presses)
            peak = server.peak_mib()
            await watch.close()
            await rate.close()
    how = f"default run, {pretrain} ratings before, one a second while it practises; a researcher watches"
    return [
        single("rating_to_snapshot_s", "rating to a snapshot that knows it", to_snapshot, unit="s",
               reach=5, how=how),
        single("rating_to_policy_s", "rating to a policy trained on it", to_policy, unit="s",
               reach=10, how=how),
        single("peak_memory_mib", f"peak memory of serve, {iterations} iterations", [peak], unit="MiB",
               reach=1.2 * 1024, how=f"VmHWM; {how}; the demo's features made anew"),
    ]  # fmt: skip


async def _presses(data_dir: Path, turns: int, seconds: float) -> list[Result]:
    async with stocked(data_dir, people=CROWD) as study:
        return await press_times(study, turns=turns, seconds=seconds)


async def press_times(
    study: Stocked, *, turns: int, seconds: float, every_s: dict[int, float] = _EVERY_S
) -> list[Result]:
    """Key press to next clip, while the trainer runs and while it is paused.

    Args:
        study: With clips for all.
        turns: Of each side.
        seconds: Of a turn.
        every_s: Seconds from press to press of each person, by how many they are, ascending.

    Raises:
        RuntimeError: If a press was lost or doubled.
    """
    results: list[Result] = []
    for people, pause in every_s.items():
        await study.open(people)
        p95: dict[str, list[float]] = {"online": [], "paused": []}
        for _ in range(turns):
            for phase, taken in p95.items():
                await bring(study.session, study.server, phase)
                taken.append(float(np.percentile(await study.rate(pause, seconds), 95)))
        results.append(_press_figure(people, pause, p95))
    study.check()
    return results


def _press_figure(people: int, pause: float, p95: dict[str, list[float]]) -> Figure:
    name = f"press_{people}_annotator{'' if people == 1 else 's'}"
    return ratio(
        name, f"key press to next clip, 95th percentile, people rating: {people}, each every {pause:g} s",
        ours=p95["online"], theirs=p95["paused"], against="trainer paused", unit="ms", reach=2,
        at_least=False,
        equal="one server and its open pages by turns; each clip drawn for it; the clock stops when the next "
        "clip and its picture are there",
    )  # fmt: skip


def _iterations(server: Server) -> int:
    return server.rows("SELECT COUNT(*) FROM iterations")[0][0]


def _delays(server: Server, presses: Sequence[Press]) -> tuple[list[float], list[float]]:
    """From each press to the first snapshot, and to the first finished iteration, that knows it, seconds.

    The rows say themselves when they were written. Presses that nothing knows yet are left out.
    """
    event_of = dict(server.rows("SELECT clip_id, id FROM events WHERE kind = 'rate'"))
    snapshots = server.rows("SELECT number, last_event, created_at FROM snapshots ORDER BY number")
    iterations = server.rows("SELECT snapshot, created_at FROM iterations ORDER BY number")
    to_snapshot, to_policy = [], []
    for press in presses:
        event = event_of[press.clip]
        fitted = [(number, written) for number, last_event, written in snapshots if last_event >= event]
        trained = [written for snapshot, written in iterations if fitted and snapshot >= fitted[0][0]]
        to_snapshot += [_time(written) - press.at for _, written in fitted[:1]]
        to_policy += [_time(written) - press.at for written in trained[:1]]
    return to_snapshot, to_policy


def _time(written: str) -> float:
    return datetime.fromisoformat(written).timestamp()
