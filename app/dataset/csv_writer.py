"""Rows as CSV, in blocks, safe to open in a spreadsheet; ``csv_reader`` reads them back."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Generator, Iterable, Sequence
from datetime import UTC, datetime
from itertools import islice

from onedemo.storage.rating_records import RATING_COLUMNS

_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def defuse(value: object) -> object:
    """A cell that no spreadsheet takes for a formula: text that looks like one gets an apostrophe.

    Numbers stay as they are.
    """
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value


def armed(cell: str) -> str:
    """The reverse of ``defuse``."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


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
