"""A real server to measure: ``onedemo serve`` as a child process, its database, clips and people."""

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
import time
import urllib.request
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from aiohttp import ClientSession

from load.annotators import Press, Tab, browser_session, open_tab, rate_for, rating
from onedemo.storage.clips import NewClip
from onedemo.storage.database import FILE_NAME
from onedemo.storage.store import Store

FEW_STATES = ("practice.random_lanes=8", "practice.bank_tries=500", "ratings.queue=4")
"""Settings of a run that is not to learn anything: it begins 5 s sooner, and draws fewer clips."""
_PATIENCE_S = 900.0
_IN_HAND = 2
"""Clips at each open page: one on screen, one fetched ahead."""
_SPARE = 50
"""Clips beyond those, for the second until more are brought."""


class Server:
    """``onedemo serve`` on a data directory, until ``close``.

    Args:
        data_dir: Of the product.
        settings: ``section.key=value``, as ``--set`` takes them, for a new run; none to go on with the
            newest run, or to make one with the defaults.

    Raises:
        RuntimeError: If it does not print its links.
    """

    def __init__(self, data_dir: Path, settings: Sequence[str] = ()) -> None:
        self.data_dir = data_dir
        self._log = data_dir.with_name(f"{data_dir.name}.err").open("w+")
        self._child = self.spawn(data_dir, settings, self._log)
        assert self._child.stdout is not None
        lines = [self._child.stdout.readline() for _ in range(2)]
        self.links = dict(line.strip().split(": ", 1) for line in lines if line)
        """Of the researcher and the annotator, by role."""
        if len(self.links) != 2:
            said = Path(self._log.name).read_text().strip()
            self.close()
            raise RuntimeError(f"onedemo serve did not start: {said}")
        with closing(Store(data_dir)) as store:  # nobody practises here
            for rater in store.accounts.raters():
                store.accounts.set_practised(rater.id)

    @staticmethod
    def spawn(
        data_dir: Path, settings: Sequence[str] = (), log: IO[str] | int = subprocess.DEVNULL
    ) -> subprocess.Popen[str]:
        """The process alone, just begun; it says on its standard output when it is ready."""
        # By name: what is measured stands above this package, which imports nothing of it.
        command = [
            sys.executable,
            "-m",
            "onedemo.app.cli",
            "serve",
            "--data-dir",
            str(data_dir),
            "--port",
            "0",
        ]
        command += ["--shared", "0", "--repeated", "0"]  # each press is a rating of another clip
        command += [word for setting in settings for word in ("--set", setting)]
        command += ["--new-run"] if settings else []
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)

    @property
    def base(self) -> str:
        """Address of its front."""
        return self.links["annotator"].split("/login")[0]

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._child.pid

    def phase(self) -> str:
        """What the trainer does: "pretrain", "online", "paused", ..."""
        with urllib.request.urlopen(f"{self.base}/healthz", timeout=10) as answer:
            return json.load(answer)["phase"]

    def peak_mib(self) -> float:
        """The most memory the process has had at once, MiB (Linux)."""
        return self._memory("VmHWM")

    def resident_mib(self) -> float:
        """The memory the process has just now, MiB (Linux)."""
        return self._memory("VmRSS")

    def rows(self, sql: str, *values: object) -> list[tuple]:
        """What its database answers, on a read-only connection of our own."""
        uri = f"{(self.data_dir / FILE_NAME).absolute().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=10)) as db:
            return db.execute(sql, values).fetchall()

    def _memory(self, what: str) -> float:
        status = Path(f"/proc/{self._child.pid}/status").read_text()
        found = re.search(rf"{what}:\s+(\d+) kB", status)
        assert found is not None, f"the kernel tells no {what}"
        return int(found[1]) / 1024

    def kill(self) -> None:
        """Ends the process as a power cut would."""
        self._child.kill()
        self.close()

    def close(self) -> None:
        """Ends the process as the command ``kill`` would; by force if it takes half a minute."""
        self._child.terminate()
        try:
            self._child.wait(30)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        assert self._child.stdout is not None
        self._child.stdout.close()
        self._log.close()


@contextmanager
def serving(data_dir: Path, settings: Sequence[str] = ()) -> Iterator[Server]:
    """A server for as long as the block lasts."""
    server = Server(data_dir, settings)
    try:
        yield server
    finally:
        server.close()


class Supply:
    """Clips that wait to be rated: drawn ones once more, under numbers of their own.

    Drawing takes part of a second of a core for each clip, so many people would wait for pictures and
    not for the page.

    Args:
        store: Of the server's data directory.
        run: The run that is served; drawn clips of it must wait.
        count: How many clips to make.
    """

    def __init__(self, store: Store, run: str, count: int) -> None:
        self._store, self._run = store, run
        drawn = store.clips.waiting(self._run)
        pictures = store.path.parent / "runs" / self._run / "clips"
        segments = {clip.id: store.clips.segment(clip.id) for clip in drawn}
        originals = [drawn[n % len(drawn)] for n in range(count)]
        new = [
            NewClip(demo_step=clip.demo_step, segment=segments[clip.id], stage="online", iteration=1)
            for clip in originals
        ]
        self._left = [clip.id for clip in store.clips.add(self._run, new)]
        for clip, original in zip(self._left, originals, strict=True):
            os.link(pictures / f"{original.id:06d}.jpg", pictures / f"{clip:06d}.jpg")

    def fill(self, queue: int) -> None:
        """Lets so many clips wait to be rated.

        Raises:
            RuntimeError: If there are no more.
        """
        missing = max(0, queue - len(self._store.clips.waiting(self._run)))
        if missing > len(self._left):
            raise RuntimeError("more clips were rated than were made")
        self._store.clips.set_state(self._left[:missing], "ready")
        del self._left[:missing]

    async def keep(self, queue: int) -> None:
        """Fills once a second until cancelled."""
        while True:
            await asyncio.to_thread(self.fill, queue)
            await asyncio.sleep(1.0)


def annotator_link(server: Server, store: Store, name: str) -> str:
    """A link for an annotator of that name, as good as one that ``onedemo rater add`` prints."""
    token = secrets.token_urlsafe(32)
    rater = store.accounts.ensure(name, "annotator")
    store.accounts.set_practised(rater.id)
    store.accounts.add_token(hashlib.sha256(token.encode()).hexdigest(), rater.id, "link")
    return f"{server.base}/login?token={token}"


def check_counts(server: Server, presses: Sequence[Press], *, after: int = 0) -> None:
    """Sees that each press is one rating in the database, and that there is no other.

    Args:
        server: Whose database.
        presses: All that were made since.
        after: The last event before them.

    Raises:
        RuntimeError: If a rating was lost, doubled or changed.
    """
    pressed = Counter((press.clip, press.value) for press in presses)
    events = Counter(server.rows("SELECT clip_id, value FROM events WHERE id > ?", after))
    if pressed != events:
        raise RuntimeError(
            f"{pressed.total()} presses became {events.total()} events: "
            f"lost {dict(pressed - events)}, too many {dict(events - pressed)}"
        )


async def reach(condition: Callable[[], object], what: str) -> None:
    """Waits until something is so, however slow the machine is.

    Raises:
        RuntimeError: If it takes more than a quarter of an hour.
    """
    end = time.monotonic() + _PATIENCE_S
    while not await asyncio.to_thread(condition):
        if time.monotonic() > end:
            raise RuntimeError(f"waited {_PATIENCE_S:.0f} s in vain for {what}")
        await asyncio.sleep(0.1)


async def give(tab: Tab, count: int) -> None:
    """Rates so many clips as they come, however long they take."""
    for _ in range(count):
        await reach(lambda: tab.clip, "a clip to rate")
        await tab.rate(rating(tab))


async def bring(session: ClientSession, server: Server, phase: str) -> None:
    """Pauses or resumes through the researcher's page and waits until it is so."""
    if await asyncio.to_thread(server.phase) == phase:
        return
    page = await open_tab(session, server.links["researcher"])
    await page.until(lambda: "alt+P" in page.keys, "the key that pauses")
    await page.press("alt+P")
    await reach(lambda: server.phase() == phase, f"the phase {phase}")
    await page.close()


@dataclass
class Stocked:
    """A server with drawn clips in stock, and people who rate them. Made by ``stocked``."""

    server: Server
    store: Store
    session: ClientSession
    supply: Supply
    tabs: list[Tab]
    before: int
    """The last event before anybody rated."""

    def fill(self, clips: int) -> None:
        """Lets so many clips wait to be rated, beside those at open pages."""
        self.supply.fill(_IN_HAND * len(self.tabs) + _SPARE + clips)

    async def open(self, people: int) -> None:
        """Opens pages until so many people are there, each with a clip."""
        self.supply.fill(_IN_HAND * people + _SPARE)
        for number in range(len(self.tabs), people):
            link = annotator_link(self.server, self.store, f"annotator {number}")
            self.tabs.append(await open_tab(self.session, link))
        for tab in self.tabs:
            await tab.until(lambda tab=tab: tab.clip, "a clip")

    async def rate(self, every_s: float, seconds: float) -> list[float]:
        """Lets all rate for a while, as ``rate_for``.

        Returns:
            Of each press, the time until the next clip and its picture were there, ms.
        """
        told = [len(tab.presses) for tab in self.tabs]
        filling = asyncio.create_task(self.supply.keep(_IN_HAND * len(self.tabs) + _SPARE))
        try:
            await rate_for(self.tabs, every_s=every_s, seconds=seconds)
        finally:
            filling.cancel()
        pairs = zip(self.tabs, told, strict=True)
        return [1000 * press.seconds for tab, n in pairs for press in tab.presses[n:]]

    def iterations(self) -> int:
        """Iterations of practice in the database, of all runs."""
        return self.server.rows("SELECT COUNT(*) FROM iterations")[0][0]

    def check(self) -> None:
        """As ``check_counts``, of all that was rated here."""
        presses = [press for tab in self.tabs for press in tab.presses]
        check_counts(self.server, presses, after=self.before)


@asynccontextmanager
async def stocked(
    data_dir: Path, *, presses: int, people: int, settings: Sequence[str] = ()
) -> AsyncIterator[Stocked]:
    """A server that practises and need not draw: clips in stock are copies of a few.

    Args:
        data_dir: A new one, or one that was used.
        presses: How many there will be, about.
        people: How many there will be at once, at most.
        settings: More ``section.key=value``.
    """
    # Few ratings before practice; afterwards nothing ends the run or takes clips away. The rest is as ever.
    settings = [
        "ratings.pretrain=10", "ratings.online=1000000", "ratings.stale_iterations=1000000",
        "rollouts.total_steps=1000000000", *settings,
    ]  # fmt: skip
    with serving(data_dir, settings) as server, closing(Store(data_dir)) as store:
        before = store.ratings.last_event()
        async with browser_session() as session:
            tabs = [await open_tab(session, server.links["annotator"])]
            await give(tabs[0], 10)
            await bring(session, server, "paused")
            run = store.runs.all()[-1]["id"]
            await reach(lambda: store.clips.waiting(run), "clips that are drawn")
            supply = Supply(store, run, int(1.2 * presses) + _IN_HAND * people + 2 * _SPARE)
            yield Stocked(server, store, session, supply, tabs, before)
            for tab in tabs:
                await tab.close()
