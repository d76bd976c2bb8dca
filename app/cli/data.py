"""The commands for data: ``export``, ``import``; and what commands of all kinds share."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from onedemo.core.files import check_writable
from onedemo.errors import UserError


def add_data_commands(commands: Any, command: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds them to the command line.

    Args:
        commands: Where sub-commands are added.
        command: Adds one: (commands, name, function, summary).
    """
    export = command(commands, "export", _export, "the ratings as CSV, what was rated as Parquet")
    add_data_dir(export)
    export.add_argument("--out", type=Path, metavar="FILE", help="the CSV; standard output if not given")
    export.add_argument("--run", dest="run_name", metavar="NAME", help="only this run")
    export.add_argument("--rater", metavar="NAME", help="only this rater (of the CSV)")
    export.add_argument("--segments", type=Path, metavar="FILE", help="states and actions behind the clips")
    export.add_argument("--comparisons", type=Path, metavar="FILE", help="answers about pairs, as CSV")
    export.add_argument("--skips", type=Path, metavar="FILE", help="skipped clips and why, as CSV")
    export.add_argument("--card", type=Path, metavar="FILE", help="the data card, in Markdown")

    back = command(commands, "import", _import, "an export back into an empty data directory")
    back.add_argument("ratings", type=Path, metavar="RATINGS.csv")
    back.add_argument("segments", type=Path, metavar="SEGMENTS.parquet")
    add_data_dir(back)


def add_data_dir(parser: argparse.ArgumentParser) -> None:
    """The option ``--data-dir``."""
    parser.add_argument(
        "--data-dir", type=Path, default=Path("data"), metavar="DIR", help="where everything is kept (./data)"
    )


def check_output(file: Path, data_dir: Path) -> None:
    """Raises UserError, before any work is done, if a result could not be written there."""
    check_writable(file)
    if file.absolute().parent == data_dir.absolute() and file.name.startswith("onedemo.sqlite3"):
        raise UserError(f"{file} is the database; choose another name")


def _export(arguments: argparse.Namespace) -> None:
    from onedemo.app.dataset.card import card
    from onedemo.app.dataset.ratings_csv import csv_blocks, write_parquet
    from onedemo.core.files import write_atomic
    from onedemo.storage.comparisons import COMPARISON_COLUMNS
    from onedemo.storage.ratings import SKIP_COLUMNS

    with open_store(arguments, must_exist=True) as store:
        run, runs = arguments.run_name, [entry["id"] for entry in store.runs.all()]
        if run is not None and run not in runs:
            raise UserError(f"no run {run!r}; there are: {', '.join(runs) or 'none'}")
        others = (arguments.segments, arguments.comparisons, arguments.skips, arguments.card)
        for file in (arguments.out, *others):
            if file is not None:
                check_output(file, arguments.data_dir)
        if arguments.segments is not None:
            write_parquet(store, run, arguments.segments)
        if arguments.card is not None:
            write_atomic(arguments.card, card(store, run).encode())
        if arguments.comparisons is not None:
            write_atomic(arguments.comparisons, csv_blocks(store.comparisons.stream(run), COMPARISON_COLUMNS))
        if arguments.skips is not None:
            write_atomic(arguments.skips, csv_blocks(store.ratings.stream_skips(run), SKIP_COLUMNS))
        blocks = csv_blocks(store.ratings.stream(run, rater=arguments.rater))
        if arguments.out is not None:
            write_atomic(arguments.out, blocks)
        elif not any(others):
            for block in blocks:
                sys.stdout.buffer.write(block)
            sys.stdout.buffer.flush()


def _import(arguments: argparse.Namespace) -> None:
    from onedemo.app.dataset.importer import import_data

    there = import_data(arguments.ratings, arguments.segments, arguments.data_dir)
    print("  ".join(f"{count} {what}" for what, count in there.items()))


def open_store(arguments: argparse.Namespace, must_exist: bool = False) -> Any:
    """The database in ``--data-dir``, closed with the block.

    Raises:
        UserError: If there must be one and is none, or it cannot be opened.
    """
    from contextlib import closing

    from onedemo.storage.database import FILE_NAME
    from onedemo.storage.store import Store

    if must_exist and not (arguments.data_dir / FILE_NAME).exists():
        raise UserError(f"no {FILE_NAME} in {arguments.data_dir}; give the directory with --data-dir")
    return closing(Store(arguments.data_dir))
