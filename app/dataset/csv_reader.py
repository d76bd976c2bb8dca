"""CSV that onedemo wrote and somebody may have edited: read strictly, what is wrong said with its line."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from onedemo.app.dataset.csv_writer import armed
from onedemo.errors import UserError
from onedemo.storage.rating_records import MOST_REASON

_MOST = 10**12
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?Z", re.ASCII)
_LONGEST_NAME = 100


def whole(low: int, high: int = _MOST) -> Callable[[str], int]:
    """Reads a whole number of that range."""

    def read(cell: str) -> int:
        if not re.fullmatch(r"-?\d{1,15}(\.0)?", cell, re.ASCII) or not low <= int(float(cell)) <= high:
            raise ValueError(f"a whole number from {low} to {high}")
        return int(float(cell))

    return read


def number(low: float, high: float) -> Callable[[str], float]:
    """Reads a number of that range."""

    def read(cell: str) -> float:
        value = float(cell) if re.fullmatch(r"[-+.\deE]{1,40}", cell, re.ASCII) else math.nan
        if not low <= value <= high:
            raise ValueError(f"a number from {low:g} to {high:g}")
        return value

    return read


def time(cell: str) -> str:
    """Reads a time as the database keeps it."""
    try:
        if _TIME.fullmatch(cell):
            datetime.fromisoformat(cell)
            return cell
    except ValueError:  # a day that is not in the calendar
        pass
    raise ValueError("a time in UTC such as 2026-01-02T03:04:05.678Z (spreadsheets change it)")


def one_of(*choices: str) -> Callable[[str], str]:
    """Reads one of these words."""

    def read(cell: str) -> str:
        if cell not in choices:
            raise ValueError(f"one of {', '.join(choices)}")
        return cell

    return read


def name(cell: str) -> str:
    """Reads a name, as it was before it was made harmless to spreadsheets."""
    cell = armed(cell)
    if not 1 <= len(cell) <= _LONGEST_NAME or not cell.isprintable():
        raise ValueError(f"a name of 1 to {_LONGEST_NAME} characters")
    return cell


def line(cell: str) -> str:
    """Reads the reason of a skip."""
    cell = armed(cell)
    if not 1 <= len(cell) <= MOST_REASON or not cell.isprintable():
        raise ValueError(f"a line of 1 to {MOST_REASON} characters")
    return cell


def read_table(
    file: Path, what: str, columns: Mapping[str, Callable[[str], Any]], *, may_lack: tuple[str, ...] = ()
) -> Iterator[tuple[int, dict[str, Any]]]:
    """The rows of a CSV with the number of the line that each begins at, as they are read.

    Args:
        file: UTF-8, with commas; a byte-order mark is fine.
        what: What it is an export of.
        columns: What reads a cell of each, and raises a ValueError that says what it should be; those
            whose cells may be empty, None then, have a "?" behind their name. Others are not looked at.
        may_lack: Columns that older exports have not.

    Raises:
        UserError: In one sentence, with the line, if something in it is not as onedemo wrote it.
    """
    readers = {column.rstrip("?"): (column.endswith("?"), read) for column, read in columns.items()}
    try:
        with file.open(newline="", encoding="utf-8-sig") as source:
            reader = csv.DictReader(source, strict=True)
            heads = reader.fieldnames or []
            if missing := [column for column in readers if column not in (*heads, *may_lack)]:
                other = next((sign for sign in ";\t|" if sign in "".join(heads[:1])), None)
                raise UserError(
                    f"{file} is separated by {other!r}: save it with commas between its columns"
                    if other else
                    f"{file} has no column {', '.join(sorted(missing))}; is it an export of {what}?"
                )  # fmt: skip
            if len(set(heads)) != len(heads):
                raise UserError(f"{file} has two columns of one name")
            for row in reader:
                yield reader.line_num, _cells(row, readers, f"{file}, line {reader.line_num}")
    except FileNotFoundError:
        raise UserError(f"there is no file {file}") from None
    except UnicodeDecodeError:
        raise UserError(f"{file} is not in UTF-8: save it as CSV in UTF-8") from None
    except (OSError, csv.Error) as error:
        raise UserError(f"{file} cannot be read as CSV: {error}") from None


def _cells(row: dict, readers: Mapping[str, tuple[bool, Callable]], where: str) -> dict[str, Any]:
    if None in row or None in row.values():
        raise UserError(f"{where}: it has {'more' if None in row else 'fewer'} cells than there are columns")
    cells: dict[str, Any] = {}
    for column, (may_be_empty, read) in readers.items():
        cell = row.get(column, "")
        if cell == "" and (may_be_empty or column not in row):
            cells[column] = None
            continue
        try:
            cells[column] = read(cell)
        except ValueError as error:
            raise UserError(f"{where}: {column} is {cell[:80]!a}, not {error}") from None
    return cells
