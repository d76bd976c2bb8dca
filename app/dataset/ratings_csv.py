"""Ratings as CSV, in pieces, safe to open in a spreadsheet; and the segments behind them."""

from __future__ import annotations

import csv
import io
from collections.abc import Generator, Iterable, Sequence
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from onedemo.app.dataset.parquet import write_segments
from onedemo.core.files import replacing
from onedemo.storage.ratings import RATING_COLUMNS
from onedemo.storage.store import Store

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def defuse(value: object) -> object:
    """A cell that no spreadsheet takes for a formula: text that looks like one gets an apostrophe.

    Numbers stay as they are.
    """
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def csv_blocks(
    rows: Iterable[tuple], columns: Sequence[str] = RATING_COLUMNS, *, rows_per_block: int = 500
) -> Generator[bytes, None, None]:
    """The rows as UTF-8 CSV with one header, in blocks.

    Args:
        rows: In the order of the columns.
        columns: Their names.
        rows_per_block: How many rows to put in a block.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer)
    writer.writerow(columns)
    rows = iter(rows)
    while block := list(islice(rows, rows_per_block)):
        writer.writerows([[defuse(cell) for cell in row] for row in block])
        yield _drain(buffer)
    if buffer.tell():  # no row at all: the header
        yield _drain(buffer)


def file_name(what: str, suffix: str, now: datetime | None = None) -> str:
    """A name for a download: what it is, the day and the time in UTC."""
    return f"onedemo-{what}-{now or datetime.now(UTC):%Y%m%d-%H%M%S}.{suffix}"


def _drain(buffer: io.StringIO) -> bytes:
    data = buffer.getvalue().encode()
    buffer.seek(0)
    buffer.truncate()
    return data


def write_parquet(store: Store, run: str | None, file: Path) -> int:
    """Writes the segments of all rated clips, of one run or of all; returns how many.

    A file that is there already is replaced once the new one is whole.
    """
    runs = [entry for entry in store.runs.all() if run in (None, entry["id"])]
    roles = {rater.name: rater.role for rater in store.accounts.raters()}
    with replacing(file) as half:
        return write_segments(half, store.clips.rated(run), runs, roles)
