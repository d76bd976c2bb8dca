"""Attacks on a real server, each for a while, and what somebody who rates meanwhile sees of it.

    .venv/bin/python tests/load/attack_http.py [--seconds N] [--descriptors N] [--json FILE] [KIND ...]

Prints a table: latency of the health check, of a rating until its next clip, ratings a second, how long a new
page takes to open, what the log grew. Ends with exit status 1 if a promise is broken: an answer to the health
check within 2 s, a next clip within 5 s, a page within 20 s, 1 MB of log at most, an end within 10 s of
SIGTERM, no rating lost or doubled.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AsyncExitStack, ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import aiohttp

from load import attackers
from load.annotators import Tab, browser_session, open_tab, rating
from onedemo.app.http.tokens import issue_link, read_secret
from onedemo.storage.store import Store

SETTINGS = (
    "predictor.appearance=false", "ratings.pretrain=1000000", "ratings.rounds=2", "predictor.updates=50",
)  # fmt: skip
"""Clips are drawn for as long as it lasts."""
MOST = {"health_max_s": 2.0, "next_clip_max_s": 5.0, "page_s": 20.0, "log_mb": 1.0}
END_S = 10.0
_PATIENCE_S = 60.0


@dataclass
class Site:
    """What is attacked, and rated at."""

    base: str
    data_dir: Path
    log: Path
    end_s: float = 0.0
    """From SIGTERM to the end of the process."""

    @property
    def port(self) -> int:
        """Of its front."""
        return int(self.base.rsplit(":", 1)[1])


@dataclass
class Seen:
    """What was seen during one attack."""

    kind: str
    health_s: list[float] = field(default_factory=list)
    next_clip_s: list[float] = field(default_factory=list)
    page_s: float = _PATIENCE_S
    """Until somebody who comes during the attack has a clip."""
    log_mb: float = 0.0
    seconds: float = _PATIENCE_S
    notes: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, float]:
        """By name; those of ``MOST`` are promised."""
        return {
            "health_median_s": statistics.median(self.health_s or [_PATIENCE_S]),
            "health_max_s": max(self.health_s, default=_PATIENCE_S),
            "next_clip_median_s": statistics.median(self.next_clip_s or [_PATIENCE_S]),
            "next_clip_max_s": max(self.next_clip_s, default=_PATIENCE_S),
            "ratings_per_s": len(self.next_clip_s) / self.seconds,
            "page_s": self.page_s,
            "log_mb": self.log_mb,
        }

    def broken(self, slack: float) -> list[str]:
        """The promises that were, on a machine that is so much slower."""
        figures, most = self.figures(), {name: slack * value for name, value in MOST.items()}
        too_much = [f"{self.kind}: {name} {figures[name]:.2f}" for name in most if figures[name] > most[name]]
        return too_much + [f"{self.kind}: {note}" for note in self.notes]


@contextmanager
def real_server(data_dir: Path, descriptors: int) -> Iterator[Site]:
    """``onedemo serve`` with so many file descriptors at most."""
    command = [sys.executable, "-m", "onedemo.app.cli", "serve", "--data-dir", str(data_dir), "--port", "0"]
    command += ["--shared", "0", "--repeated", "0", *(w for each in SETTINGS for w in ("--set", each))]
    log = data_dir.with_suffix(".log")
    limited = ["sh", "-c", 'ulimit -n "$0" && exec "$@"', str(descriptors), *command]
    with ExitStack() as stack:
        errors = stack.enter_context(log.open("w"))
        child = subprocess.Popen(limited, stdout=subprocess.PIPE, stderr=errors, text=True)
        site = Site("", data_dir, log)
        stack.callback(end, child, site)
        assert child.stdout is not None
        stack.callback(child.stdout.close)
        links = [child.stdout.readline().partition(": ")[2].strip() for _ in range(2)]
        if not links[1]:
            raise RuntimeError(f"onedemo serve did not start: {log.read_text()}")
        site.base = links[1].split("/login")[0]
        yield site


def end(child: subprocess.Popen, site: Site) -> None:
    """As the command ``kill``; by force if that takes a minute."""
    began = time.monotonic()
    child.terminate()
    try:
        child.wait(60)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
    site.end_s = time.monotonic() - began


def link_of(site: Site, name: str) -> str:
    """Of an annotator who has practised."""
    with closing(Store(site.data_dir)) as store:
        rater = store.accounts.ensure(name, "annotator")
        store.accounts.set_practised(rater.id)
        return issue_link(store, read_secret(site.data_dir), rater, site.base)


async def watch_health(site: Site, seen: Seen) -> None:
    """Asks again and again how the server is, each time over a connection of its own."""
    while True:
        began = time.monotonic()
        try:
            async with asyncio.timeout(_PATIENCE_S), aiohttp.ClientSession() as session:
                async with session.get(f"{site.base}/healthz") as answer:
                    await answer.read()
        except (aiohttp.ClientError, OSError, TimeoutError):
            pass  # it is as slow as the next one that gets through
        else:
            seen.health_s.append(time.monotonic() - began)
            began = time.monotonic()
        await asyncio.sleep(0.1)


async def rate(tab: Tab, seen: Seen, until: float, given: Counter[tuple[int, int]]) -> None:
    """Rates as fast as clips come."""
    while time.monotonic() < until:
        await tab.until(lambda: tab.clip, "a clip", _PATIENCE_S)
        press = await tab.rate(rating(tab))
        given[press.clip, press.value] += 1
        seen.next_clip_s.append(press.seconds)


async def come_in(link: str, seen: Seen) -> None:
    """Somebody opens the page during the attack."""
    began = time.monotonic()
    async with browser_session() as session:
        while True:
            try:
                async with asyncio.timeout(_PATIENCE_S):
                    tab = await open_tab(session, link)
                    await tab.until(lambda tab=tab: tab.token, "the page", _PATIENCE_S)
                break
            except (aiohttp.ClientError, OSError, TimeoutError, RuntimeError):
                if time.monotonic() > began + _PATIENCE_S:
                    seen.notes.append("nobody could come in")
                    return
        seen.page_s = time.monotonic() - began
        await tab.close()


async def under(kind: str, site: Site, connections: int, seconds: float, given: Counter) -> Seen:
    """Rates for so long while one attack goes on; "" is none."""
    seen = Seen(kind or "none")
    async with browser_session() as session, AsyncExitStack() as stack:
        size = site.log.stat().st_size
        try:
            tab = await open_tab(session, link_of(site, "bo"))
            stack.push_async_callback(tab.close)
            await tab.until(lambda: tab.clip, "a clip", 5 * _PATIENCE_S)  # of all, the first has to be drawn
            if kind:
                guest = await open_tab(session, link_of(site, "mallory"))
                await guest.close()
                place = guest.address.removeprefix(site.base)
                words = [kind, site.port, connections, seconds + 120, guest.headers["Cookie"], place]
                attacker = subprocess.Popen([sys.executable, attackers.__file__, *map(str, words)])
                stack.callback(attacker.wait)
                stack.callback(attacker.kill)
                await asyncio.sleep(min(3.0, seconds / 2))
            began = time.monotonic()
            health = asyncio.ensure_future(watch_health(site, seen))
            stack.callback(health.cancel)
            comer = asyncio.ensure_future(come_in(link_of(site, "cy"), seen))
            stack.callback(comer.cancel)
            await rate(tab, seen, began + seconds, given)
            await comer
            seen.seconds = time.monotonic() - began
        except (RuntimeError, aiohttp.ClientError, OSError, TimeoutError) as error:
            seen.notes.append(f"somebody could not rate: {error!r}")
        seen.log_mb = (site.log.stat().st_size - size) / 1e6
    return seen


async def attacked(
    site: Site, kinds: Sequence[str], connections: int, seconds: float, *, slack: float = 1.0
) -> tuple[list[Seen], list[str]]:
    """What is seen without an attack and during each; and the promises that were broken.

    Args:
        site: A server at which nobody else rates.
        kinds: Of ``attackers.KINDS``.
        connections: At once, of the attacks that hold them.
        seconds: Of each attack.
        slack: Times as long as promised may everything take.
    """
    given: Counter[tuple[int, int]] = Counter()
    found = [await under(kind, site, connections, seconds, given) for kind in ("", *kinds)]
    with closing(Store(site.data_dir)) as store:
        kept = Counter(store.database.rows("SELECT clip_id, value FROM events WHERE kind = 'rate'"))
    broken = [note for seen in found for note in seen.broken(slack)]
    if lost := given - kept:
        broken.append(f"{lost.total()} ratings were lost")
    if doubled := kept - Counter(set(kept)):
        broken.append(f"{doubled.total()} ratings were doubled")
    return found, broken


def table(found: list[Seen]) -> str:
    """As Markdown."""
    lines = [
        "| attack | health check, median and slowest | next clip, median and slowest | ratings a second "
        "| a new page | log |",
        "|---|---|---|---|---|---|",
    ]
    for seen in found:
        f = seen.figures()
        lines.append(
            f"| {seen.kind} | {1000 * f['health_median_s']:.0f} and {1000 * f['health_max_s']:.0f} ms "
            f"| {1000 * f['next_clip_median_s']:.0f} and {1000 * f['next_clip_max_s']:.0f} ms "
            f"| {f['ratings_per_s']:.1f} | {f['page_s']:.1f} s | {f['log_mb']:.2f} MB |"
        )
    return "\n".join(lines)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(attackers.KINDS))
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--descriptors", type=int, default=1024)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        with real_server(Path(place) / "data", arguments.descriptors) as site:
            kinds = arguments.kinds or list(attackers.KINDS)
            found, broken = asyncio.run(attacked(site, kinds, 2 * arguments.descriptors, arguments.seconds))
    if site.end_s > END_S:
        broken.append(f"the server ended {site.end_s:.1f} s after SIGTERM")
    print(table(found))
    print(f"\n{arguments.descriptors} descriptors; it ended {site.end_s:.1f} s after SIGTERM")
    for note in broken:
        print("BROKEN", note)
    if arguments.json is not None:
        told = {
            "end_s": site.end_s,
            "attacks": [{"kind": seen.kind} | seen.figures() for seen in found],
            "broken": broken,
        }
        arguments.json.write_text(json.dumps(told, indent=1) + "\n")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
