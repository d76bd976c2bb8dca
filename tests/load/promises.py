"""A table of what the long checks found.

``python tests/load/promises.py OUT.md kill.json door.json attack.json soak.json``.

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
    if "mib" in found:
        return [("hours of rating and training", found["line"])]
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
