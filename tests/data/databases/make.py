"""Makes the stored databases of each schema version: ``python tests/data/databases/make.py``.

Those that are there are left as they are: a database of an old version is made once, when that version
is the newest, and then only read.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np

from onedemo.storage.schema import STEPS
from onedemo.storage.segment_codec import pack_segment
from onedemo.types import Segment

HERE = Path(__file__).parent
AT = "2026-01-02T03:04:05.678Z"
SIZES = {"obs": 11, "actions": 3, "qpos": 6, "qvel": 6}


def segment(number: int) -> Segment:
    """Four steps whose numbers tell which segment it is."""
    return Segment(**{name: np.full((4, size), number + size / 100) for name, size in SIZES.items()})


def make(version: int, file: Path) -> None:
    """A database of that version, with rows in every table it has."""
    with closing(sqlite3.connect(file, isolation_level=None)) as db:
        db.execute("PRAGMA page_size = 1024")
        for number, step in sorted(STEPS.items()):
            if number <= version:
                db.executescript(step)
        db.execute(f"PRAGMA user_version = {version}")
        put = db.execute
        for name, role in (("ada", "researcher"), ("bo", "annotator"), ("oracle", "simulated")):
            put("INSERT INTO raters (name, role, created_at) VALUES (?, ?, ?)", (name, role, AT))
        for mark, kind, gone in (("a", "link", None), ("b", "session", None), ("c", "link", AT)):
            put("INSERT INTO tokens (hash, rater_id, kind, created_at, revoked_at) VALUES (?, 2, ?, ?, ?)",
                (mark * 64, kind, AT, gone))  # fmt: skip
        put("INSERT INTO runs (id, demo, demo_sha256, seed, config, version, created_at)"
            " VALUES ('hop-1', 'hop', 'd', 3, 'seed = 3', '0.1.0', ?)", (AT,))  # fmt: skip
        for number in range(1, 7):
            put("INSERT INTO clips (run, demo_step, steps, stage, iteration, snapshot, predicted, state,"
                " created_at) VALUES ('hop-1', ?, 4, ?, 0, 1, 2.5, 'ready', ?)",
                (10 * number, "pretrain" if number < 4 else "online", AT))  # fmt: skip
            put("INSERT INTO segments VALUES (?, ?)", (number, pack_segment(segment(number))))
        presses = ((1, 2, "rate", 5), (2, 2, "rate", 1), (2, 2, "undo", None), (2, 2, "rate", 2),
                   (3, 2, "skip", None), (1, 1, "rate", 4), (4, 3, "rate", 3))  # fmt: skip
        for clip, rater, kind, value in presses:
            put("INSERT INTO events (clip_id, rater_id, kind, value, snapshot, predicted, latency_ms,"
                " created_at) VALUES (?, ?, ?, ?, 1, 2.5, 900, ?)",
                (clip, rater, kind, value, AT))  # fmt: skip
        put("INSERT INTO snapshots VALUES ('hop-1', 1, 4, 2, '{\"loss\": 0.5}', ?)", (AT,))
        put("INSERT INTO iterations VALUES ('hop-1', 1, 1, 16000, '{\"predicted\": 2.0}', ?)", (AT,))
        start, end, *mark = (
            ("mark_from", "mark_to", 1, 3) if version >= 6 else ("mark_start", "mark_end", 0.1, 0.2)
        )
        put(f"INSERT INTO events (clip_id, rater_id, kind, value, repeat, {start}, {end},"
            " snapshot, latency_ms, created_at)"
            " VALUES (1, 2, 'rate', 4, 1, ?, ?, 1, 800, ?)", (*mark, AT))  # fmt: skip
        put("INSERT INTO events (clip_id, rater_id, kind, reason, snapshot, latency_ms, created_at)"
            " VALUES (5, 2, 'skip', 'too dark', 1, 700, ?)", (AT,))  # fmt: skip
        put("INSERT INTO events (rater_id, kind, snapshot, latency_ms, run, by_id, created_at)"
            " VALUES (3, 'leave out', 1, 0, 'hop-1', 1, ?)", (AT,))  # fmt: skip
        put("INSERT INTO pairs (run, demo_step, steps, stage, iteration, left_segment, right_segment,"
            " state, created_at) VALUES ('hop-1', 20, 4, 'online', 1, ?, ?, 'ready', ?)",
            (pack_segment(segment(7)), pack_segment(segment(8)), AT))  # fmt: skip
        put("INSERT INTO comparisons (pair_id, rater_id, answer, latency_ms, created_at)"
            " VALUES (1, 2, 'left', 600, ?)", (AT,))  # fmt: skip
        if version >= 10:
            put("INSERT INTO comparisons (pair_id, rater_id, answer, latency_ms, created_at, reason)"
                " VALUES (1, 1, 'skip', 500, ?, 'too dark')", (AT,))  # fmt: skip
        put("UPDATE tokens SET once = 1, expires_at = ? WHERE hash = ?", ("2099" + AT[4:], "a" * 64))
        if version >= 9:
            put("UPDATE runs SET title = 'With marks', note = 'Bo left at half.'")
        put("INSERT INTO audit (at, who, what, detail) VALUES (?, 'ada', 'came in', 'link 1')", (AT,))
        if version >= 8:
            put(
                "INSERT INTO run_marks (run, iteration, kind, created_at) VALUES ('hop-1', 1, 'paused', ?)",
                (AT,),
            )
        put("VACUUM")


if __name__ == "__main__":
    for number in STEPS:
        if not (HERE / f"v{number}.sqlite3").exists():
            make(number, HERE / f"v{number}.sqlite3")
