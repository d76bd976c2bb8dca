"""People who all rate while the robot practises and somebody opens films: every clip and film is drawn.

``python tests/load/drawn_server.py --seconds 1200 --films 8`` ends with one line of figures; its exit code is
1 if a rating was lost or doubled, or a film did not come.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from load.annotators import Tab, open_tab
from load.serving import Stocked, bring, stocked
from onedemo.storage.run_directory import RunDirectory
from onedemo.training.best_rollouts import Gallery

PEOPLE, EVERY_S = 50, 4.0
_SETTLE_S = 5.0
_ROLLOUT_S = 8.0
"""Length of what is filmed: the built-in demo's."""
_FIRST = 900_001
"""Iterations that never were: their best rollouts are laid down here, to be filmed."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Drawn:
    """What was seen."""

    people: int
    every_s: float
    seconds: float
    ratings: int
    a_second: float
    p95_ms: float
    median_ms: float
    slowest_ms: float
    drawn_a_second: float
    iterations: int
    films: int
    slowest_film_s: float

    @property
    def wanted(self) -> float:
        """Ratings a second that the people would give if they never had to wait."""
        return self.people / self.every_s

    def line(self) -> str:
        """The figures."""
        films = f", {self.films} films beside it, slowest {self.slowest_film_s:.0f} s" if self.films else ""
        return (
            f"{self.people} people, each every {self.every_s:g} s for {self.seconds:.0f} s: "
            f"{self.a_second:.1f} ratings a second of {self.wanted:.1f} wanted, press to next clip "
            f"{self.median_ms:.0f} ms, 95th percentile {self.p95_ms:.0f}, slowest {self.slowest_ms:.0f}; "
            f"{self.drawn_a_second:.1f} clips drawn a second; {self.iterations} iterations of practice; "
            f"{self.ratings:,} ratings, 0 lost, 0 doubled{films}"
        )


async def rate_and_film(
    study: Stocked, *, people: int, every_s: float, seconds: float, films: int, phase: str = "online"
) -> Drawn:
    """Lets people rate while the robot practises, and asks for films after a quarter of the time.

    Args:
        study: With clips for all.
        people: How many.
        every_s: Seconds from press to press of each.
        seconds: How long.
        films: How many films a researcher opens.
        phase: "online", or "paused": without practice.

    Raises:
        RuntimeError: If a rating was lost or doubled, or a film did not come.
    """
    lay_down(study, films)
    await bring(study.session, study.server, phase)
    await study.open(people)
    await asyncio.sleep(_SETTLE_S)
    page = await open_tab(study.session, study.server.links["researcher"])
    iterations, drawn, began = study.iterations(), study.drawn(), time.monotonic()
    told = sum(len(tab.presses) for tab in study.tabs)

    async def ask() -> list[float]:
        await asyncio.sleep(seconds / 4)
        return await asyncio.gather(*(film(page, _FIRST + number) for number in range(films)))

    filming = asyncio.create_task(ask())
    taken = await study.rate(every_s, seconds)
    took, drawn = time.monotonic() - began, study.drawn() - drawn
    iterations = study.iterations() - iterations
    filmed = await filming
    study.check()
    await page.close()
    count = sum(len(tab.presses) for tab in study.tabs) - told
    return Drawn(
        people=people, every_s=every_s, seconds=took, ratings=count, a_second=count / took,
        p95_ms=float(np.percentile(taken, 95)), median_ms=float(np.median(taken)), slowest_ms=max(taken),
        drawn_a_second=drawn / took, iterations=iterations,
        films=films, slowest_film_s=max(filmed, default=0.0),
    )  # fmt: skip


def lay_down(study: Stocked, films: int) -> None:
    """Rollouts to be filmed: a robot that turns over, beside the whole demo."""
    run = study.store.runs.all()[-1]["id"]
    gallery = Gallery(RunDirectory(study.server.data_dir, run).rollouts, None)
    steps = int(_ROLLOUT_S / 0.008)
    for number in range(films):
        qpos = np.zeros((steps, 6))
        qpos[:, 1], qpos[:, 2] = 1.25, -np.linspace(0, 2 * np.pi * (1 + number), steps)
        gallery.keep(_FIRST + number, qpos, np.arange(steps) * 240 // steps)


async def film(page: Tab, iteration: int) -> float:
    """Asks for a film as the Watch tab does; how long it takes, seconds."""
    began = time.monotonic()
    address = f"{page.base}/rollouts/{iteration}.webm"
    async with page.session.get(address, headers=page.headers, timeout=None) as answer:
        content = await answer.read()
        if answer.status != 200 or len(content) < 1000:
            raise RuntimeError(f"film {iteration} did not come: {answer.status}")
    return time.monotonic() - began


async def check(data_dir: Path, *, people: int, every_s: float, seconds: float, films: int) -> Drawn:
    """The whole of it, on a new data directory."""
    async with stocked(data_dir, people=people) as study:
        return await rate_and_film(study, people=people, every_s=every_s, seconds=seconds, films=films)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1200)
    parser.add_argument("--people", type=int, default=PEOPLE)
    parser.add_argument("--films", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        seen = asyncio.run(
            check(
                Path(place) / "data", people=arguments.people, every_s=EVERY_S, seconds=arguments.seconds,
                films=arguments.films,
            )
        )  # fmt: skip
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(asdict(seen) | {"line": seen.line()}) + "\n")
    print(f"kept: {seen.line()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
