"""An export back into a data directory: the same ratings in the same order, so the same predictor."""

from __future__ import annotations

import csv
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from onedemo.app.dataset.columns import RATINGS
from onedemo.app.dataset.parquet import read_about, read_segments
from onedemo.core.files import write_atomic
from onedemo.core.names import LONGEST
from onedemo.errors import UserError
from onedemo.storage.run_directory import RunDirectory, check_run_name
from onedemo.storage.store import Store

_RUN = ("id", "demo", "demo_sha256", "seed", "config", "version")


def import_data(ratings: Path, segments: Path, data_dir: Path) -> dict[str, int]:
    """Fills an empty data directory with exported runs, clips and ratings. All of it, or nothing.

    Args:
        ratings: The CSV.
        segments: The Parquet file.
        data_dir: Where to; must hold no ratings yet.

    Returns:
        How many "runs", "clips" and "ratings" there are now.

    Raises:
        UserError: If a file is not an export, they do not belong together, or the directory holds data.
    """
    runs, roles = read_about(segments)
    rows = list(_rows(ratings))
    store = Store(data_dir)
    try:
        if store.runs.all():
            raise UserError(f"{data_dir} holds runs already; import into an empty data directory")
        with store.database.transaction():
            for run in runs:
                _check_run(run, segments)
                store.runs.add(run=run["id"], **{name: run[name] for name in _RUN[1:]})
            clips = store.clips.restore(read_segments(segments))
            raters: dict[str, int] = {}
            for number, row in enumerate(rows, start=2):
                if row["clip_id"] not in clips:
                    raise UserError(f"{ratings}, line {number}: clip {row['clip_id']} is not in {segments}")
                if row["rater"] not in raters:
                    role = roles.get(row["rater"], "annotator")
                    if not 1 <= len(row["rater"]) <= LONGEST or not row["rater"].isprintable():
                        raise UserError(f"{ratings}, line {number}: {row['rater'][:80]!a} is no rater's name")
                    raters[row["rater"]] = store.accounts.ensure(row["rater"], role).id
                try:
                    store.ratings.restore(row, raters[row["rater"]])
                except sqlite3.IntegrityError as error:
                    raise UserError(f"{ratings}, line {number}: {error}") from None
            for run, rater in sorted({(row["run"], row["rater"]) for row in rows if row["left_out"]}):
                store.ratings.leave_out(run, raters[rater], by=raters[rater])
        for run in runs:
            write_atomic(RunDirectory(data_dir, run["id"]).config, run["config"].encode())
    finally:
        store.close()
    return {"runs": len(runs), "clips": len(clips), "ratings": len(rows)}


_NUMBERS: dict[str, type] = {
    "id": int, "clip_id": int, "value": int, "latency_ms": int, "snapshot": int, "repeat": int,
    "left_out": int, "predicted": float, "mark_start": float, "mark_end": float,
}  # fmt: skip


def _rows(file: Path) -> Iterator[dict[str, Any]]:
    try:
        with file.open(newline="", encoding="utf-8") as source:
            reader = csv.DictReader(source)
            missing = set(RATINGS) - set(reader.fieldnames or ())
            if missing:
                raise UserError(
                    f"{file} has no column {', '.join(sorted(missing))}; is it an export of ratings?"
                )
            for number, row in enumerate(reader, start=2):
                try:
                    values: dict[str, Any] = {
                        name: kind(row[name]) if row[name] != "" else None for name, kind in _NUMBERS.items()
                    }
                    if values["value"] not in range(1, 6):
                        raise ValueError(f"value must be 1 to 5, got {row['value']!r}")
                except (TypeError, ValueError) as error:
                    raise UserError(f"{file}, line {number}: {error}") from None
                text = {name: _armed(row[name]) for name in ("run", "rater", "created_at")}
                yield values | text
    except FileNotFoundError:
        raise UserError(f"there is no file {file}") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{file} cannot be read as CSV: {error}") from None


def _armed(cell: str) -> str:
    """A cell before it was made harmless to spreadsheets (``onedemo.app.dataset.ratings_csv.defuse``)."""
    return cell[1:] if cell.startswith("'") and cell[1:2] in ("=", "+", "-", "@", "\t", "\r") else cell


def _check_run(run: Any, file: Path) -> None:
    if not isinstance(run, dict) or not all(
        isinstance(run.get(n), int if n == "seed" else str) for n in _RUN
    ):
        raise UserError(f"{file} does not say what its runs are")
    check_run_name(run["id"])
