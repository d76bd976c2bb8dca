"""The commands for data: ``export``, ``import``; and what commands of all kinds share."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, Token

from onedemo.core.files import check_writable
from onedemo.errors import UserError

DATA = Path("data")
DataDir = Annotated[Path, Parameter(help="Where everything is kept.")]


def _whole(kind: Any, tokens: Sequence[Token]) -> int:
    number = int(tokens[0].value)  # cyclopts would round 1.5
    if abs(number) >= 2**63:  # nothing that takes a number takes a larger one
        raise ValueError(number)
    return number


Whole = Annotated[int, Parameter(converter=_whole)]


def check_output(file: Path, data_dir: Path) -> None:
    """Raises UserError, before any work is done, if a result could not be written there."""
    check_writable(file)
    if file.absolute().parent == data_dir.absolute() and file.name.startswith("onedemo.sqlite3"):
        raise UserError(f"{file} is the database; choose another name")


def export(
    *, data_dir: DataDir = DATA, out: Path | None = None, run: str | None = None, rater: str | None = None,
    segments: Path | None = None, comparisons: Path | None = None, skips: Path | None = None,
    card: Path | None = None,
) -> None:  # fmt: skip
    """The ratings as CSV, what was rated as Parquet.

    Args:
        out: The CSV; standard output if not given.
        run: Only this run.
        rater: Only this rater (of the CSV).
        segments: States and actions behind the clips.
        comparisons: Answers about pairs, as CSV.
        skips: Skipped clips and why, as CSV.
        card: The data card, in Markdown.
    """
    from onedemo.app.dataset.card import card as card_of
    from onedemo.app.dataset.ratings_csv import csv_blocks, write_parquet
    from onedemo.core.files import write_atomic
    from onedemo.storage.comparisons import COMPARISON_COLUMNS
    from onedemo.storage.ratings import SKIP_COLUMNS

    with open_store(data_dir, must_exist=True) as store:
        runs = [entry["id"] for entry in store.runs.all()]
        if run is not None and run not in runs:
            raise UserError(f"no run {run!r}; there are: {', '.join(runs) or 'none'}")
        others = (segments, comparisons, skips, card)
        for file in (out, *others):
            if file is not None:
                check_output(file, data_dir)
        if segments is not None:
            write_parquet(store, run, segments)
        if card is not None:
            write_atomic(card, card_of(store, run).encode())
        if comparisons is not None:
            write_atomic(comparisons, csv_blocks(store.comparisons.stream(run), COMPARISON_COLUMNS))
        if skips is not None:
            write_atomic(skips, csv_blocks(store.ratings.stream_skips(run), SKIP_COLUMNS))
        blocks = csv_blocks(store.ratings.stream(run, rater=rater))
        if out is not None:
            write_atomic(out, blocks)
        elif not any(others):
            for block in blocks:
                sys.stdout.buffer.write(block)
            sys.stdout.buffer.flush()


def import_(ratings: Path, segments: Path, /, *, data_dir: DataDir = DATA) -> None:
    """An export back into an empty data directory.

    Args:
        ratings: RATINGS.csv of the export.
        segments: SEGMENTS.parquet of the export.
    """
    from onedemo.app.dataset.importer import import_data

    there = import_data(ratings, segments, data_dir)
    print("  ".join(f"{count} {what}" for what, count in there.items()))


def open_store(data_dir: Path, must_exist: bool = False) -> Any:
    """The database of a data directory, closed with the block.

    Raises:
        UserError: If there must be one and is none, or it cannot be opened.
    """
    from contextlib import closing

    from onedemo.storage.database import FILE_NAME
    from onedemo.storage.store import Store

    if must_exist and not (data_dir / FILE_NAME).exists():
        raise UserError(f"no {FILE_NAME} in {data_dir}; give the directory with --data-dir")
    return closing(Store(data_dir))
