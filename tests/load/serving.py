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

from aiohttp import ClientSession

from load.annotators import Press, Tab, browser_session, open_tab, rate_for, rating
from onedemo.storage.database import FILE_NAME
from onedemo.storage.store import Store

FEW_STATES = (
    "practice.random_lanes=8", "practice.bank_tries=500", "ratings.queue=4", "rollouts.threads=1",
)  # fmt: skip
"""Settings of a run that is not to learn anything: it begins 5 s sooner, draws fewer clips, and its second
thread does not wait busily on the core of whoever rates."""
_PATIENCE_S = 900.0
_AHEAD = 6
"""Clips that wait for each person: two are at the page, two may be rated while the robot practises once."""
_SPARE = 12


def command(words: list[str], log: str) -> subprocess.Popen[str]:
    """Begins ``onedemo`` with some words; what it says on stderr goes to the end of the log."""
    # By name: what is measured stands above this package, which imports nothing of it.
    program = [sys.executable, "-m", "onedemo.app.cli", *words]
    with open(log, "a") as errors:
        return subprocess.Popen(program, stdout=subprocess.PIPE, stderr=errors, text=True)


begin = command
"""How servers are begun here. The tests, which do not measure how long that takes, have a quicker way."""


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
        self._child = self.spawn(data_dir, settings, self._log.name)
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
    def spawn(data_dir: Path, settings: Sequence[str] = (), log: str = os.devnull) -> subprocess.Popen[str]:
        """The process alone, just begun; it says on its standard output when it is ready."""
        words = ["serve", "--data-dir", str(data_dir), "--port", "0"]
        words += ["--shared", "0", "--repeated", "0"]  # each press is a rating of another clip
        words += [word for setting in settings for word in ("--set", setting)]
        words += ["--new-run"] if settings else []
        return begin(words, log)

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
        """The most memory that it and the process that draws have had at once, MiB (Linux)."""
        return self._memory("VmHWM")

    def resident_mib(self) -> float:
        """The memory that both have just now, MiB (Linux)."""
        return self._memory("VmRSS")

    def rows(self, sql: str, *values: object) -> list[tuple]:
        """What its database answers, on a read-only connection of our own."""
        uri = f"{(self.data_dir / FILE_NAME).absolute().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=10)) as db:
            return db.execute(sql, values).fetchall()

    def _memory(self, what: str) -> float:
        process = Path(f"/proc/{self._child.pid}")
        draws = {child for task in process.glob("task/*/children") for child in task.read_text().split()}
        total = 0
        for pid in [process.name, *draws]:
            found = re.search(rf"{what}:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
            assert found is not None, f"the kernel tells no {what}"
            total += int(found[1])
        return total / 1024

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
    await page.until(lambda: "alt+2" in page.keys, "the tab Watch", _PATIENCE_S)
    await page.press("alt+2")
    await page.until(lambda: "alt+P" in page.keys, "the key that pauses", _PATIENCE_S)
    await page.press("alt+P")
    await reach(lambda: server.phase() == phase, f"the phase {phase}")
    await page.close()


@dataclass
class Stocked:
    """A server that practises and draws each clip that it serves, and people. Made by ``stocked``."""

    server: Server
    store: Store
    session: ClientSession
    tabs: list[Tab]
    before: int
    """The last event before anybody rated."""

    async def open(self, people: int) -> None:
        """Opens pages until so many people are there, each with a clip."""
        for number in range(len(self.tabs), people):
            link = annotator_link(self.server, self.store, f"annotator {number}")
            self.tabs.append(await open_tab(self.session, link))
        for tab in self.tabs:
            await tab.until(lambda tab=tab: tab.clip, "a clip", _PATIENCE_S)

    async def rate(self, every_s: float, seconds: float) -> list[float]:
        """Lets all rate for a while, as ``rate_for``.

        Returns:
            Of each press, the time until the next clip and its picture were there, ms.
        """
        told = [len(tab.presses) for tab in self.tabs]
        await rate_for(self.tabs, every_s=every_s, seconds=seconds)
        pairs = zip(self.tabs, told, strict=True)
        return [1000 * press.seconds for tab, n in pairs for press in tab.presses[n:]]

    def iterations(self) -> int:
        """Iterations of practice in the database, of all runs."""
        return self.server.rows("SELECT COUNT(*) FROM iterations")[0][0]

    def drawn(self) -> int:
        """Clips that have been drawn, of all runs."""
        return self.server.rows("SELECT COUNT(*) FROM clips WHERE state != 'cut'")[0][0]

    def check(self) -> None:
        """As ``check_counts``, of all that was rated here."""
        presses = [press for tab in self.tabs for press in tab.presses]
        check_counts(self.server, presses, after=self.before)


@asynccontextmanager
async def stocked(data_dir: Path, *, people: int, settings: Sequence[str] = ()) -> AsyncIterator[Stocked]:
    """A server that practises, with clips for so many people at once drawn ahead, and more drawn as they go.

    Args:
        data_dir: A new one, or one that was used.
        people: How many there will be, at most.
        settings: More ``section.key=value``.
    """
    # Few ratings before practice; afterwards nothing ends the run or takes clips away. The rest is as ever.
    queue = _AHEAD * people + _SPARE
    settings = [
        "ratings.pretrain=10", "ratings.online=1000000", "ratings.stale_iterations=1000000",
        "rollouts.total_steps=1000000000", *settings, f"ratings.queue={queue}",
    ]  # fmt: skip
    with serving(data_dir, settings) as server, closing(Store(data_dir)) as store:
        before = store.ratings.last_event()
        async with browser_session() as session:
            tabs = [await open_tab(session, server.links["annotator"])]
            await give(tabs[0], 10)
            run = store.runs.all()[-1]["id"]
            await reach(lambda: store.runs.last_iteration(run) is not None, "clips of the policy")
            await bring(session, server, "paused")
            await reach(lambda: len(store.clips.waiting(run)) > queue / 2, "clips that are drawn")
            yield Stocked(server, store, session, tabs, before)
            for tab in tabs:
                await tab.close()
