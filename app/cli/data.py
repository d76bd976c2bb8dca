"""The commands for data: ``export``, ``import``; and what commands of all kinds share."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, Token

from onedemo.core.outputs import check_outputs
from onedemo.errors import UserError, in_words

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
    check_outputs(file)
    if file.absolute().parent == data_dir.absolute() and file.name.startswith("onedemo.sqlite3"):
        raise UserError(f"{file} is the database; choose another name")


def export(
    *, data_dir: DataDir = DATA, out: Path | None = None, run: str | None = None, rater: str | None = None,
    segments: Path | None = None, comparisons: Path | None = None, pairs: Path | None = None,
    skips: Path | None = None, history: Path | None = None, card: Path | None = None,
    all_: Annotated[Path | None, Parameter(name="--all")] = None,
) -> None:  # fmt: skip
    """The ratings as CSV, what was rated as Parquet.

    Args:
        out: The CSV; standard output if not given.
        run: Only this run.
        rater: Only this rater (of the CSV).
        segments: States and actions behind the clips.
        comparisons: Answers about pairs, as CSV.
        pairs: States and actions behind the pairs.
        skips: Skipped clips and why, as CSV.
        history: What was taken back, and who was left out, as CSV.
        card: The data card, in Markdown.
        all_: Everything, into this new directory, for `onedemo import`.
    """
    from onedemo.app.dataset.csv_writer import csv_blocks
    from onedemo.app.dataset.exporter import FILES, write_export, write_file
    from onedemo.core.directories import make_directory
    from onedemo.core.files import write_atomic

    others = {
        "segments.parquet": segments, "comparisons.csv": comparisons, "pairs.parquet": pairs,
        "skips.csv": skips, "history.csv": history, "card.md": card,
    }  # fmt: skip
    with open_store(data_dir, must_exist=True) as store, written():
        runs = [entry["id"] for entry in store.runs.all()]
        if run is not None and run not in runs:
            raise UserError(f"no run {run!r}; there are: {', '.join(runs) or 'none'}")
        for file in (out, *others.values()):
            if file is not None:
                check_output(file, data_dir)
        if all_ is not None:
            if any((all_ / name).exists() for name in FILES):
                raise UserError(f"{all_} holds an export already; choose another directory")
            make_directory(all_)
            write_export(store, run, all_)
        for name, file in others.items():
            if file is not None:
                write_file(store, run, name, file)
        blocks = csv_blocks(store.ratings.stream(run, rater=rater))
        if out is not None:
            write_atomic(out, blocks)
        elif all_ is None and not any(others.values()):
            for block in blocks:
                sys.stdout.buffer.write(block)
            sys.stdout.buffer.flush()


def import_(
    source: Path, segments: Path | None = None, /, *, comparisons: Path | None = None,
    pairs: Path | None = None, skips: Path | None = None, history: Path | None = None,
    data_dir: DataDir = DATA,
) -> None:  # fmt: skip
    """An export back into an empty data directory.

    Args:
        source: The directory of `onedemo export --all`, or RATINGS.csv of an export.
        segments: SEGMENTS.parquet of the export.
        comparisons: COMPARISONS.csv of the export.
        pairs: PAIRS.parquet of the export.
        skips: SKIPS.csv of the export.
        history: HISTORY.csv of the export.
    """
    from onedemo.app.dataset.importer import Export, export_in, import_data
    from onedemo.robots import registry
    from onedemo.robots.library import copy_robot, robots_in

    registry.use(data_dir)
    if source.is_dir():
        given = export_in(source)
        for _, robot in robots_in(source):
            copy_robot(robot, data_dir)
    elif segments is None:
        raise UserError("give RATINGS.csv and SEGMENTS.parquet, or the directory of onedemo export --all")
    else:
        given = Export(
            ratings=source, segments=segments, comparisons=comparisons, pairs=pairs, skips=skips,
            history=history,
        )  # fmt: skip
    there = import_data(given, data_dir)
    print("  ".join(f"{count} {what}" for what, count in there.items()))


@contextmanager
def written() -> Iterator[None]:
    """Turns an error of writing (a full disk, say) into a sentence.

    Raises:
        UserError: In place of OSError.
    """
    try:
        yield
    except BrokenPipeError:  # whoever reads our output has enough
        raise
    except OSError as error:
        where = f"cannot write {error.filename}" if error.filename else "the result cannot be written"
        raise UserError(f"{where}: {in_words(error)}") from None


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
