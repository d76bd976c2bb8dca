"""Archives made to harm, restored for real: ``PYTHONPATH=tests python tests/load/hostile_archives.py``.

Prints a table: archive, expected, got, seconds. Ends with status 1 if one was not refused as it should be,
touched a file that is none of its business, left anything behind, or took longer than it may.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from helpers.hostile_archives import HOSTILE, good_backup, make
from onedemo.app.admin.restore import restore
from onedemo.errors import UserError
from onedemo.types import Segment

_SECONDS = 30.0
_WIDTHS = {"obs": 11, "actions": 3, "qpos": 6, "qvel": 6}


def main() -> int:
    """Tries them all; the number of promises broken, at most 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures there")
    arguments = parser.parse_args()
    rows, broken = [], []
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        segment = Segment(**{name: np.zeros((3, width)) for name, width in _WIDTHS.items()})
        good = good_backup(root, segment)
        for number, hostile in enumerate(HOSTILE):
            place = root / str(number)
            place.mkdir()
            victim, file = place / "victim", place / "sent.zip"
            victim.write_text("years of work")
            make(hostile, good, file, victim)
            there = set(place.iterdir())
            began = time.monotonic()
            try:
                restore(file, place / "again")
                got = "RESTORED"
            except UserError as error:
                got = "refused" if re.search(hostile.refused, str(error)) else f"REFUSED FOR: {error}"
            except Exception as error:
                got = f"{type(error).__name__.upper()}: {error}"
            took = time.monotonic() - began
            if not victim.exists():
                got += ", VICTIM DELETED"
            if set(place.iterdir()) != there:
                got += ", SOMETHING LEFT"
            if took > _SECONDS:
                got += ", TOO SLOW"
            rows.append((hostile.what, "refused", got, took))
            broken += [hostile.what] if got != "refused" else []
    for row in (("archive", "expected", "got", "seconds"), ("---",) * 4, *rows):
        print("| " + " | ".join(f"{cell:.2f}" if isinstance(cell, float) else cell for cell in row) + " |")
    found = {
        "hostile archives": len(rows),
        "slowest, s": round(max(row[3] for row in rows), 2),
        "broken": broken,
    }
    print(json.dumps(found))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found) + "\n")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
