"""Hours of rating and training on a real server, to see that it grows nowhere.

``python tests/load/soak_server.py --minutes 120`` ends with one line of figures; its exit code is 1 if a
promise
was broken: memory a quarter of the way and at the end within 5 %, no more open files or threads, no rating
lost.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from load.serving import Server, bring, stocked

PEOPLE, EVERY_S = 5, 6.0
_SAMPLES = 120
GROWTH = 0.05
_SOME = 5
"""Samples whose median counts as one: memory goes up and down with every iteration."""
_MORE = 4
"""Files or threads more at the end than a quarter of the way: one or two are open by chance."""


@dataclass
class Soak:
    """What was seen, one entry a sample."""

    minutes: list[float] = field(default_factory=list)
    mib: list[float] = field(default_factory=list)
    files: list[int] = field(default_factory=list)
    threads: list[int] = field(default_factory=list)
    ratings: int = 0
    iterations: int = 0

    def look(self, server: Server, minutes: float) -> None:
        """Takes a sample."""
        process = Path(f"/proc/{server.pid}")
        self.minutes.append(round(minutes, 2))
        self.mib.append(round(server.resident_mib(), 1))
        self.files.append(len(list((process / "fd").iterdir())))
        self.threads.append(len(list((process / "task").iterdir())))

    def ends(self, values: list) -> tuple[float, float]:
        """A figure a quarter of the way, and at the end."""
        quarter = len(values) // 4
        return statistics.median(values[quarter : quarter + _SOME]), statistics.median(values[-_SOME:])

    @property
    def growth(self) -> float:
        """Of memory, as a share."""
        early, late = self.ends(self.mib)
        return late / early - 1

    @property
    def kept(self) -> bool:
        """Whether every promise was."""
        more = [late - early for early, late in (self.ends(self.files), self.ends(self.threads))]
        return self.growth <= GROWTH and max(more) <= _MORE and self.iterations > 0

    def line(self) -> str:
        """The figures."""
        memory, files, threads = (self.ends(each) for each in (self.mib, self.files, self.threads))
        return (
            f"{self.minutes[-1]:.0f} minutes, {self.ratings:,} ratings (none lost), {self.iterations:,} "
            f"iterations: memory {memory[0]:,.0f} MiB a quarter of the way, {memory[1]:,.0f} at the end "
            f"({self.growth:+.1%}); open files {files[0]:.0f}, {files[1]:.0f}; threads {threads[0]:.0f}, "
            f"{threads[1]:.0f}"
        )


async def soak(data_dir: Path, minutes: float, *, people: int = PEOPLE) -> Soak:
    """Lets people rate while the robot practises.

    Args:
        data_dir: A new one.
        minutes: How long, after everything has begun.
        people: How many.

    Raises:
        RuntimeError: If a rating was lost or doubled.
    """
    seen, step = Soak(), 60 * minutes / _SAMPLES
    async with stocked(data_dir, people=people) as study:
        await bring(study.session, study.server, "online")
        await study.open(people)
        rating = asyncio.ensure_future(study.rate(EVERY_S, 60 * minutes))
        began = time.monotonic()
        for number in range(_SAMPLES):
            due = began + step * (number + 1)
            await asyncio.wait([rating], timeout=max(0.0, due - time.monotonic()))
            if rating.done():
                break
            seen.look(study.server, step * (number + 1) / 60)
        seen.ratings = len(await rating)
        study.check()
        seen.iterations = study.iterations()
    return seen


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=120)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        seen = asyncio.run(soak(Path(place) / "data", arguments.minutes))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(asdict(seen) | {"kept": seen.kept, "line": seen.line()}) + "\n")
    print(("kept: " if seen.kept else "BROKEN: ") + seen.line())
    return int(not seen.kept)


if __name__ == "__main__":
    sys.exit(main())
