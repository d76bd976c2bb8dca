"""Kills a real server again and again while people rate at it, and counts what became of their ratings.

``python tests/load/kill_server.py --kills 100`` ends with one line of figures; its exit code is 1 if a
promise was broken. A rating counts as given when the page has shown what comes next: from then on it must
be in the database, once, whatever happens. One that was on its way when the process died may be there or not.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import random
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from load.annotators import browser_session, open_tab, rating
from load.painted import CHROMIUM_FLAGS, find_chromium
from load.serving import FEW_STATES, Server, annotator_link
from onedemo.storage.database import FILE_NAME
from onedemo.storage.store import Store

SETTINGS = [
    "predictor.appearance=false", "ratings.pretrain=30", "ratings.online=1000000", "ratings.rounds=2",
    "ratings.stale_iterations=1000000", "rollouts.lanes=16", "rollouts.steps=100", "predictor.updates=100",
    *FEW_STATES,
]  # fmt: skip
"""Small, so that refits, snapshots and checkpoints are written all the time."""
START_S = 10.0
"""What a start may take, until a clip or a waiting state is shown."""
_EARLY = 0.15
"""Share of kills while it starts."""
_RATED = 0.8
"""Share of lives in which it is waited for a first rating."""
_LONG = 4
"""Times as long is the rest of some lives, in which the robot practises, too."""
_PATIENCE_S = 20.0
_SHOWN = ".od-clip > [data-src][data-clip][data-frame]"


@dataclass
class Tally:
    """What happened."""

    kills: int = 0
    in_browser: int = 0
    """With a real Chromium at the page."""
    given: int = 0
    """Ratings that were acknowledged."""
    on_the_way: int = 0
    """Ratings that were not, when the process died."""
    arrived: int = 0
    """Of these, those that are in the database."""
    lost: int = 0
    doubled: int = 0
    damaged: int = 0
    """Integrity checks of the database that failed."""
    slowest_start_s: float = 0.0
    iterations: int = 0
    """Of practice, at the end."""
    notes: list[str] = field(default_factory=list)

    @property
    def whole(self) -> bool:
        """Whether nothing was lost, doubled or damaged, and everybody could rate."""
        return not (self.lost or self.doubled or self.damaged or self.notes)

    @property
    def kept(self) -> bool:
        """Whether every promise was."""
        return self.whole and self.slowest_start_s < START_S

    def line(self) -> str:
        """The figures."""
        return (
            f"{self.kills} kills ({self.in_browser} with Chromium), {self.given:,} ratings given: "
            f"{self.lost} lost, {self.doubled} doubled; {self.on_the_way} on their way, {self.arrived} of "
            f"them arrived; {self.damaged} databases damaged; slowest start {self.slowest_start_s:.1f} s; "
            f"{self.iterations} iterations of practice"
        )


class Ratings:
    """What was pressed, by clip and value."""

    def __init__(self) -> None:
        self.given: Counter[tuple[int, int]] = Counter()
        self.open: Counter[tuple[int, int]] = Counter()
        """Not acknowledged."""


async def at_a_socket(link: str, ratings: Ratings, opened: Callable[[], None]) -> None:
    """Somebody who rates until the server is gone, speaking as a browser does."""
    async with browser_session() as session:
        tab = await open_tab(session, link)
        try:
            await tab.until(lambda: tab.clip or tab.waiting, "the page")
            opened()
            while True:
                await tab.until(lambda: tab.clip, "a clip", math.inf)  # until it is drawn
                press = (tab.clip or 0, rating(tab))
                ratings.open[press] += 1
                await tab.rate(press[1])
                ratings.open[press] -= 1
                ratings.given[press] += 1
        finally:
            await tab.close()


def at_chromium(browser) -> Callable[[str, Ratings, Callable[[], None]], Awaitable[None]]:
    """The same with a real browser."""

    async def person(link: str, ratings: Ratings, opened: Callable[[], None]) -> None:
        page = await browser.new_page()
        try:
            await page.goto(link)
            await page.wait_for_selector(f"{_SHOWN}, .od-waiting", timeout=30_000)
            opened()
            while True:
                await page.wait_for_selector(_SHOWN, timeout=60_000)
                await asyncio.sleep(0.5)
                clip = int(await page.get_attribute(_SHOWN, "data-clip"))
                press = (clip, 1 + clip % 5)
                ratings.open[press] += 1
                await page.keyboard.press(str(press[1]))
                end = time.monotonic() + 20
                while await page.get_attribute(_SHOWN, "data-clip", timeout=20_000) == str(clip):
                    assert time.monotonic() < end
                    await asyncio.sleep(0.02)
                ratings.open[press] -= 1
                ratings.given[press] += 1
        finally:
            with suppress(Exception):
                await page.close()

    return person


async def one_life(
    data_dir: Path, settings: list[str], rng: random.Random, tally: Tally, ratings: Ratings, person
) -> None:
    """Starts the server, lets two people rate, kills it."""
    began = time.monotonic()
    if rng.random() < _EARLY and not settings:
        child = Server.spawn(data_dir)
        await asyncio.sleep(rng.uniform(0.0, 2.0))
        child.kill()
        child.wait()
        assert child.stdout is not None
        child.stdout.close()
        tally.kills += 1
        return
    server = await asyncio.to_thread(Server, data_dir, settings)
    with closing(Store(data_dir)) as store:
        second = annotator_link(server, store, "second")
    shown = asyncio.Event()
    people = [
        asyncio.ensure_future(person(server.links["annotator"], ratings, shown.set)),
        asyncio.ensure_future(at_a_socket(second, ratings, shown.set)),
    ]
    try:
        await asyncio.wait_for(shown.wait(), 60)
        if not settings:  # the first of all looks at the demo
            tally.slowest_start_s = max(tally.slowest_start_s, time.monotonic() - began)
        given = ratings.given.total()
        end = time.monotonic() + (_PATIENCE_S if rng.random() < _RATED else 0)
        while ratings.given.total() == given and time.monotonic() < end:
            await asyncio.sleep(0.05)
        await asyncio.sleep(rng.uniform(0.1, 3.0) * (_LONG if rng.random() < 0.2 else 1))
    except TimeoutError:
        tally.notes.append("a start showed nothing within a minute")
    for somebody in people:
        if somebody.done():
            tally.notes.append(f"somebody could not rate: {somebody.exception()!r}")
    server.kill()
    tally.kills += 1
    done = await asyncio.gather(*people, return_exceptions=True)
    for problem in done:  # each ends because the server does
        if not isinstance(problem, Exception):
            tally.notes.append(f"a person ended with {problem!r}")


def compare(data_dir: Path, tally: Tally, ratings: Ratings) -> None:
    """Looks at what the dead process left."""
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        tally.damaged += db.execute("PRAGMA integrity_check").fetchall() != [("ok",)]
        kept = Counter(db.execute("SELECT clip_id, value FROM events WHERE kind = 'rate'").fetchall())
        tally.iterations = db.execute("SELECT COUNT(*) FROM iterations").fetchone()[0]
    tally.given = ratings.given.total()
    tally.lost = (ratings.given - kept).total()
    tally.on_the_way = (+ratings.open).total()
    tally.arrived = (kept - ratings.given).total()
    tally.doubled = (kept - ratings.given - +ratings.open).total()


async def check(data_dir: Path, kills: int, seed: int, *, browser_share: float = 0.05) -> Tally:
    """Kills so many times.

    Args:
        data_dir: A new one.
        kills: How many.
        seed: Of the moments.
        browser_share: Share of lives with a real browser, if there is one.
    """
    rng, tally, ratings = random.Random(seed), Tally(), Ratings()
    playwright = browser = None
    if browser_share and find_chromium():
        from playwright.async_api import async_playwright

        playwright = await async_playwright().start()
        browser = await playwright.chromium.launch(executable_path=find_chromium(), args=CHROMIUM_FLAGS)
    try:
        while tally.kills < kills:
            real = browser is not None and rng.random() < browser_share
            person = at_chromium(browser) if real else at_a_socket
            tally.in_browser += real
            await one_life(data_dir, [] if tally.kills else SETTINGS, rng, tally, ratings, person)
            compare(data_dir, tally, ratings)
            if not tally.whole:
                break
    finally:
        if playwright is not None:
            await browser.close()
            await playwright.stop()
    if tally.kills >= 20 and not tally.iterations:
        tally.notes.append("the robot never practised")
    return tally


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        tally = asyncio.run(check(Path(place) / "data", arguments.kills, arguments.seed))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(asdict(tally) | {"kept": tally.kept}, indent=1) + "\n")
    for note in tally.notes:
        print(note, file=sys.stderr)
    print(("kept: " if tally.kept else "BROKEN: ") + tally.line())
    return int(not tally.kept)


if __name__ == "__main__":
    sys.exit(main())
