"""A table of what the long checks found.

``python tests/load/promises.py OUT.md kill.json fuzz.json ...``: see the Makefile for all of them.

Files that are missing are left out. Each check writes its figures with ``--json``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines of the table that one check's figures give."""
    if "kills" in found:
        lost = f"{found['lost']} lost, {found['doubled']} doubled"
        return [
            (
                "kills (`kill -9`) survived",
                f"{found['kills']}, {found['in_browser']} with Chromium at the page",
            ),
            ("ratings checked after them", f"{found['given']:,}: {lost}"),
            ("integrity checks that failed", f"{found['damaged']}"),
            ("slowest start after a kill", f"{found['slowest_start_s']:.1f} s"),
        ]
    if "a_second" in found:
        who = f"{found['people']} people, each every {found['every_s']:g} s"
        films = f" beside {found['films']} films" if found["films"] else ""
        drawn = [
            (
                f"{who}, every clip drawn{films}: ratings a second, of those wanted",
                f"{found['a_second']:.1f} of {found['people'] / found['every_s']:.1f}",
            ),
            (
                f"press to next clip and picture{films}: median, 95th percentile, slowest",
                f"{found['median_ms']:.0f}, {found['p95_ms']:.0f}, {found['slowest_ms']:.0f} ms",
            ),
            (f"ratings counted in the database{films}", f"{found['ratings']:,}: 0 lost, 0 doubled"),
        ]
        if films:
            drawn.append(("slowest of those films", f"{found['slowest_film_s']:.0f} s"))
        return drawn
    if "mib" in found:
        return [("hours of rating and training", found["line"])]
    if "hostile archives" in found:
        said = f"{found['hostile archives']}, the slowest in {found['slowest, s']:.1f} s"
        return [("hostile archives refused", said), ("of them broken through", f"{len(found['broken'])}")]
    if "attacks" in found:
        return [
            (
                f"under attack: {seen['kind']}",
                f"health {seen['health_max_s']:.2f} s, next clip {seen['next_clip_max_s']:.1f} s at most, "
                f"{seen['ratings_per_s']:.1f} ratings a second, a new page {seen['page_s']:.1f} s",
            )
            for seen in found["attacks"]
        ] + [("promises broken by them", f"{len(found['broken'])}")]
    videos = found["videos refused"] + found["videos taken"]
    return [
        ("messages fuzzed", f"{found['messages']:,}"),
        ("requests fuzzed", f"{found['requests']:,}"),
        ("bad videos tried", f"{videos:,}"),
        ("memory meanwhile", f"{found['rss_mb before']} to {found['rss_mb after']} MB"),
        ("promises broken by them", f"{len(found['broken'])}"),
    ]


def main() -> int:
    """The command line."""
    out, *files = map(Path, sys.argv[1:])
    lines = ["| what | figure |", "|---|---|"]
    for file in files:
        if file.exists():
            lines += [f"| {what} | {figure} |" for what, figure in rows(json.loads(file.read_text()))]
    out.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
