"""Everything that people gave, as files that ``onedemo import`` takes in again."""

from __future__ import annotations

import tomllib
from collections.abc import Generator
from itertools import chain
from pathlib import Path

from onedemo.app.dataset.card import card
from onedemo.app.dataset.csv_writer import csv_blocks
from onedemo.app.dataset.parquet import write_pairs, write_segments
from onedemo.core.files import replacing, write_atomic
from onedemo.demos.library import list_demos
from onedemo.robots.library import copy_robot, robots_in
from onedemo.storage.comparisons import COMPARISON_COLUMNS
from onedemo.storage.rating_records import HISTORY_COLUMNS, RATING_COLUMNS, SKIP_COLUMNS
from onedemo.storage.store import Store

FILES = (
    "history.csv", "ratings.csv", "skips.csv", "comparisons.csv", "pairs.parquet", "segments.parquet",
    "card.md",
)  # fmt: skip
"""Of a whole export, in the order in which they are written: people may go on rating meanwhile. What does
not hold any more stays so, and whatever an event is about was there before it."""


def write_export(store: Store, run: str | None, directory: Path) -> None:
    """Writes the files of a whole export, of one run or of all; each is there once it is whole.

    The robots of one's own that the runs are about are copied to ``robots/`` beside them.

    Raises:
        UserError: If one of these robots is damaged.
        OSError: If one cannot be written.
    """
    for name in FILES:
        write_file(store, run, name, directory / name)
    wanted = {
        tomllib.loads(entry["config"]).get("env") for entry in store.runs.all() if run in (None, entry["id"])
    }
    for name, file in robots_in(store.path.parent):
        if name in wanted:
            copy_robot(file, directory)


def write_file(store: Store, run: str | None, name: str, file: Path) -> None:
    """Writes one of ``FILES`` under another name; a file that is there is replaced once it is whole."""
    if name == "segments.parquet":
        demos = {
            demo.sha256: {"demo_frames": demo.frames, "demo_edits": demo.edits}
            for demo in list_demos(store.path.parent / "demos")
        }
        runs = [
            entry | demos.get(entry["demo_sha256"], {"demo_frames": None})
            for entry in store.runs.all()
            if run in (None, entry["id"])
        ]
        roles = {rater.name: rater.role for rater in store.accounts.raters()}
        with replacing(file) as half:
            write_segments(half, store.clips.answered(run), runs, roles)
    elif name == "pairs.parquet":
        with replacing(file) as half:
            write_pairs(half, store.comparisons.compared(run))
    else:
        write_atomic(file, card(store, run).encode() if name == "card.md" else csv_of(store, run, name))


def csv_of(store: Store, run: str | None, name: str) -> Generator[bytes, None, None]:
    """One of the CSVs of ``FILES``, in blocks."""
    if name == "history.csv":
        rows = chain(store.ratings.stream_history(run), store.comparisons.stream_history(run))
        return csv_blocks(rows, HISTORY_COLUMNS)
    if name == "comparisons.csv":
        return csv_blocks(store.comparisons.stream(run), COMPARISON_COLUMNS)
    if name == "skips.csv":
        return csv_blocks(store.ratings.stream_skips(run), SKIP_COLUMNS)
    return csv_blocks(store.ratings.stream(run), RATING_COLUMNS)
