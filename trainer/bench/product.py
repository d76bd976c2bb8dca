"""The product as people use it: how long a press, a rating and a start take, and how much memory it needs.

The real command runs as a child process; one light process plays the people at its page
(``trainer.bench.annotators``) and reads the database beside it.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import re
import secrets
import sqlite3
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path

import numpy as np
from aiohttp import ClientSession

from trainer.bench.annotators import Press, Tab, browser_session, open_tab, rate_for, rating
from trainer.bench.figures import Figure, Result, Skipped, ratio, single
from trainer.store import FILE_NAME, NewClip, Store

_PATIENCE_S = 120.0
_IN_HAND = 2
"""Clips at each open page: one on screen, one fetched ahead."""
_SPARE = 50
"""Clips beyond those, for the second until more are brought."""


class Server:
    """``onedemo serve`` on a data directory, until ``close``.

    Args:
        data_dir: Of the product.
        settings: ``section.key=value``, as ``--set`` takes them; none for the defaults.

    Raises:
        RuntimeError: If it does not print its links.
    """

    def __init__(self, data_dir: Path, settings: Sequence[str] = ()) -> None:
        self.data_dir = data_dir
        self._log = data_dir.with_name(f"{data_dir.name}.err").open("w+")
        # By name: what is measured here stands above the library, which imports nothing of it.
        command = [sys.executable, "-m", "app.cli", "serve", "--data-dir", str(data_dir), "--port", "0"]
        command += [word for setting in settings for word in ("--set", setting)]
        self._child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self._log, text=True)
        assert self._child.stdout is not None
        lines = [self._child.stdout.readline() for _ in range(2)]
        self.links = dict(line.strip().split(": ", 1) for line in lines if line)
        if len(self.links) != 2:
            self.close()
            self._log.seek(0)
            raise RuntimeError(f"onedemo serve did not start: {self._log.read().strip()}")

    @property
    def base(self) -> str:
        """Address of its front."""
        return self.links["annotator"].split("/login")[0]

    def phase(self) -> str:
        """What the trainer does: "pretrain", "online", "paused", ..."""
        with urllib.request.urlopen(f"{self.base}/healthz", timeout=10) as answer:
            return json.load(answer)["phase"]

    def peak_mib(self) -> float:
        """The most memory the process has had at once, MiB (Linux)."""
        status = Path(f"/proc/{self._child.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+) kB", status)
        assert found is not None
        return int(found[1]) / 1024

    def rows(self, sql: str, *values: object) -> list[tuple]:
        """What its database answers, on a read-only connection of our own."""
        uri = f"{(self.data_dir / FILE_NAME).absolute().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=10)) as db:
            return db.execute(sql, values).fetchall()

    def close(self) -> None:
        """Ends the process as Ctrl-C would."""
        self._child.terminate()
        try:
            self._child.wait(30)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        assert self._child.stdout is not None
        self._child.stdout.close()


@contextmanager
def serving(data_dir: Path, settings: Sequence[str] = ()) -> Iterator[Server]:
    """A server for as long as the block lasts."""
    server = Server(data_dir, settings)
    try:
        yield server
    finally:
        server.close()


def measure(quick: bool) -> list[Result]:
    """Everything of this module.

    Args:
        quick: Fewer ratings, turns and starts: under a minute instead of five.
    """
    if not Path("/proc/self/status").exists():
        return [Skipped("product", "the product is measured on Linux")]
    results: list[Result] = [help_time(3 if quick else 9)]
    with tempfile.TemporaryDirectory(prefix="onedemo-bench-") as place:
        default = Path(place) / "default"
        results += asyncio.run(default_run(default, quick=quick))
        results.append(asyncio.run(start_time(default, 2 if quick else 5)))
        results += asyncio.run(press_times(Path(place) / "press", quick=quick))
    return results


def help_time(repetitions: int) -> Figure:
    """``onedemo --help``, as a process of its own."""
    taken = []
    for _ in range(repetitions):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-m", "app.cli", "--help"], check=True, stdout=subprocess.DEVNULL)
        taken.append(time.perf_counter() - began)
    return single("help_s", "command line to --help", taken, unit="s", reach=0.5)


async def start_time(data_dir: Path, repetitions: int) -> Figure:
    """A start on a data directory that has been used: links printed, page open, clip or waiting state shown."""
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
    """Memory and the way of a rating, in the default run with a page on Rate and one on Watch."""
    pretrain, online, iterations = (12, 6, 4) if quick else (200, 40, 12)
    settings = [f"ratings.pretrain={pretrain}"] if quick else []
    with serving(data_dir, settings) as server:
        async with browser_session() as session:
            watch = await open_tab(session, server.links["researcher"])
            rate = await open_tab(session, server.links["annotator"])
            await _give(rate, pretrain)
            await _reach(lambda: server.rows("SELECT COUNT(*) FROM iterations")[0][0] >= 1, "an iteration")
            given = len(rate.presses)
            for _ in range(online):
                await _give(rate, 1)
                await asyncio.sleep(1.0)
            last = rate.presses[-1]
            await _reach(lambda: _delays(server, [last])[1], "a policy that knows the last rating")
            await _reach(
                lambda: server.rows("SELECT COUNT(*) FROM iterations")[0][0] >= iterations, "iterations"
            )
            delays = _delays(server, rate.presses[given:])
            check_counts(server, rate.presses)
            peak = server.peak_mib()
            await watch.close()
            await rate.close()
    how = f"default run, {pretrain} ratings before, one a second while it practises; a researcher watches"
    return [
        single(
            "rating_to_snapshot_s", "rating to a snapshot that knows it", delays[0], unit="s", reach=5, how=how
        ),
        single(
            "rating_to_policy_s", "rating to a policy trained on it", delays[1], unit="s", reach=10, how=how
        ),
        single(
            "peak_memory_mib", f"peak memory of serve: {pretrain} ratings, {iterations} iterations", [peak],
            unit="MiB", reach=1.2 * 1024, how="VmHWM; one page on Rate, one on Watch; features made anew",
        ),
    ]  # fmt: skip


async def press_times(
    data_dir: Path, *, quick: bool, crowd: int = 50, turns: int | None = None, seconds: float | None = None
) -> list[Result]:
    """Key press to next clip for one annotator and for many, while the trainer runs and while it is paused.

    Args:
        data_dir: A new one.
        quick: Two short turns instead of six long ones.
        crowd: How many the many are.
        turns: Of each side, if not as ``quick`` says.
        seconds: Of a turn, if not as ``quick`` says.
    """
    turns = turns or (2 if quick else 6)
    seconds = seconds or (5.0 if quick else 12.0)
    every = {1: 0.5, crowd: 4.0}
    needed = sum(2 * turns * seconds * people / every_s for people, every_s in every.items())
    # Few ratings before practice; afterwards nothing ends the run or takes clips away. The rest is as ever.
    settings = ["ratings.pretrain=10", "ratings.online=1000000", "ratings.stale_iterations=1000000"]
    results: list[Result] = []
    with serving(data_dir, settings) as server, closing(Store(data_dir)) as store:
        async with browser_session() as session:
            tabs = [await open_tab(session, server.links["annotator"])]
            await _give(tabs[0], 10)
            await _bring(session, server, "paused")
            await tabs[0].until(lambda: tabs[0].clip, "a clip")
            supply = Supply(store, data_dir, int(1.2 * needed) + 2 * crowd * _IN_HAND)
            for people, every_s in every.items():
                supply.fill(people * _IN_HAND + _SPARE)
                for number in range(len(tabs), people):
                    tabs.append(await open_tab(session, _link(server, store, f"annotator {number}")))
                    await tabs[-1].until(lambda: tabs[-1].clip, "a clip")
                filling = asyncio.create_task(supply.keep(people * _IN_HAND + _SPARE))
                sides: dict[str, list[float]] = {"running": [], "paused": []}
                for _ in range(turns):
                    for phase, p95 in sides.items():
                        await _bring(session, server, "online" if phase == "running" else "paused")
                        given = [len(tab.presses) for tab in tabs]
                        await rate_for(tabs, every_s=every_s, seconds=seconds)
                        fresh = [p for tab, n in zip(tabs, given, strict=True) for p in tab.presses[n:]]
                        p95.append(1000 * float(np.percentile([p.seconds for p in fresh], 95)))
                filling.cancel()
                results.append(
                    ratio(
                        f"press_{people}_annotator{'' if people == 1 else 's'}",
                        f"key press to next clip, 95th percentile, {people} rating every {every_s:g} s, "
                        "trainer running",
                        ours=sides["running"],
                        theirs=sides["paused"],
                        against="trainer paused",
                        unit="ms",
                        reach=2,
                        at_least=False,
                        equal="same server and pages by turns; clips drawn before, as copies of a few; the"
                        " clock stops when the next clip and its picture are there",
                    )  # fmt: skip
                )
            check_counts(server, [press for tab in tabs for press in tab.presses])
            for tab in tabs:
                await tab.close()
    return results


def check_counts(server: Server, presses: Sequence[Press]) -> None:
    """Sees that each press is one rating in the database, and that there is no other.

    Raises:
        RuntimeError: If a rating was lost, doubled or changed.
    """
    pressed = Counter((press.clip, press.value) for press in presses)
    events = Counter(server.rows("SELECT clip_id, value FROM events"))
    if pressed != events:
        raise RuntimeError(
            f"{sum(pressed.values())} presses became {sum(events.values())} events: "
            f"lost {dict(pressed - events)}, too many {dict(events - pressed)}"
        )


class Supply:
    """Clips that wait to be rated: drawn ones once more, under numbers of their own.

    Drawing takes a core 0.3 s a clip, so many people would wait for pictures and not for the page.

    Args:
        store: Of the server's data directory.
        data_dir: That directory, with a run that has clips in it.
        count: How many clips to make.
    """

    def __init__(self, store: Store, data_dir: Path, count: int) -> None:
        self._store = store
        self._run: str = store.runs()[-1]["id"]
        drawn = store.waiting_clips(self._run)
        pictures = data_dir / "runs" / self._run / "clips"
        segments = {clip.id: store.segment(clip.id) for clip in drawn}
        originals = [drawn[n % len(drawn)] for n in range(count)]
        new = [
            NewClip(demo_step=clip.demo_step, segment=segments[clip.id], stage="online", iteration=1)
            for clip in originals
        ]
        added = [clip.id for clip in store.add_clips(self._run, new)]
        for clip, original in zip(added, originals, strict=True):
            os.link(pictures / f"{original.id:06d}.webp", pictures / f"{clip:06d}.webp")
        self._left = added

    def fill(self, queue: int) -> None:
        """Lets so many clips wait to be rated.

        Raises:
            RuntimeError: If there are no more.
        """
        missing = queue - len(self._store.waiting_clips(self._run))
        if missing > len(self._left):
            raise RuntimeError("more clips were rated than were made")
        if missing > 0:
            self._store.set_clip_state(self._left[:missing], "ready")
            del self._left[:missing]

    async def keep(self, queue: int) -> None:
        """Fills once a second until cancelled."""
        while True:
            await asyncio.to_thread(self.fill, queue)
            await asyncio.sleep(1.0)


async def _give(tab: Tab, count: int) -> None:
    """Rates so many clips as they come, however long they take."""
    for _ in range(count):
        await _reach(lambda: tab.clip, "a clip to rate")
        await tab.rate(rating(tab))


async def _bring(session: ClientSession, server: Server, phase: str) -> None:
    """Pauses or resumes through the researcher's page and waits until it is so."""
    if await asyncio.to_thread(server.phase) == phase:
        return
    page = await open_tab(session, server.links["researcher"])
    await page.until(lambda: "alt+P" in page.keys, "the key that pauses")
    await page.press("alt+P")
    await _reach(lambda: server.phase() == phase, phase)
    await page.close()


async def _reach(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + _PATIENCE_S
    while not await asyncio.to_thread(condition):
        if time.monotonic() > end:
            raise RuntimeError(f"waited {_PATIENCE_S:.0f} s in vain for {what}")
        await asyncio.sleep(0.2)


def _delays(server: Server, presses: Sequence[Press]) -> tuple[list[float], list[float]]:
    """From each press to the first snapshot, and to the first finished iteration, that knows it, seconds.

    Presses that nothing knows yet are left out.
    """
    event_of = dict(server.rows("SELECT clip_id, id FROM events WHERE kind = 'rate'"))
    snapshots = server.rows("SELECT number, last_event, created_at FROM snapshots ORDER BY number")
    iterations = server.rows("SELECT snapshot, created_at FROM iterations ORDER BY number")
    known: tuple[list[float], list[float]] = [], []
    for press in presses:
        fitted = next((s for s in snapshots if s[1] >= event_of[press.clip]), None)
        if fitted is None:
            continue
        known[0].append(_seconds(fitted[2]) - press.at)
        trained = next((created for snapshot, created in iterations if snapshot >= fitted[0]), None)
        if trained is not None:
            known[1].append(_seconds(trained) - press.at)
    return known


def _seconds(created_at: str) -> float:
    return datetime.fromisoformat(created_at.replace("Z", "+00:00")).timestamp()


def _link(server: Server, store: Store, name: str) -> str:
    """A link for an annotator of that name, as good as one that ``onedemo rater add`` prints."""
    token = secrets.token_urlsafe(32)
    rater = store.ensure_rater(name, "annotator")
    store.add_token(hashlib.sha256(token.encode()).hexdigest(), rater.id, "link")
    return f"{server.base}/login?token={token}"
