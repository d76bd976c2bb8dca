"""Segments as Parquet: the motion behind clips and pairs. What runs they belong to is in the file's metadata.

Shapes: W control steps, o observations, a actions, q positions, v velocities.
"""

from __future__ import annotations

import json
import os
import re
import resource
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from onedemo.app.dataset.columns import PAIRS, SEGMENTS
from onedemo.errors import UserError
from onedemo.storage.comparisons import NewPair
from onedemo.types import ROLES, Clip, Segment

_ARRAYS = ("obs", "actions", "qpos", "qvel")
_RUNS, _ROLES = b"onedemo.training.runs", b"onedemo.annotators.oracle"
_GROUP = 500
"""Clips that are in memory at a time."""
_MOST_NUMBERS, _MOST_TIMES = 1 << 23, 2
"""Of a file; or so many times its bytes. Motion has one for some eight bytes: it can hardly be packed."""
_MOST_AT_A_TIME = 64 << 20
"""Bytes that so many clips unpack to; they have some 4 MB."""
_MOST_ABOUT = 1 << 24
"""Bytes of what the file says of itself, at its end: columns, row groups, runs with their settings."""
_MEMORY, _MEMORY_TIMES = 1 << 29, 4
"""Bytes that reading may take, and so many times the file's size besides."""
_MOST_STEPS = 10_000
"""Of a segment; one has some 40."""
_MOST, _MOST_DEMO = 10**9, 10**7
_CHOICE = re.compile(r"([A-Za-z][A-Za-z _-]{0,39})?", re.ASCII)
_Row = TypeVar("_Row")

# Actions are float32, all else float64, as the trainer makes them; older data may differ in width, and is
# written wider.
_MATRIX = {name: pa.list_(pa.list_(pa.float32() if name == "actions" else pa.float64())) for name in _ARRAYS}
_CLIP_TYPES = {
    "clip_id": pa.int64(), "run": pa.string(), "demo_step": pa.int64(), "stage": pa.string(),
    "iteration": pa.int64(), "snapshot": pa.int64(), "predicted": pa.float64(), "choice": pa.string(),
    "score": pa.float64(), **_MATRIX,
}  # fmt: skip
_PAIR_TYPES = {
    "pair_id": pa.int64(), "run": pa.string(), "demo_step": pa.int64(), "stage": pa.string(),
    "iteration": pa.int64(),
    **{f"{side}_{name}": kind for side in ("left", "right") for name, kind in _MATRIX.items()},
}  # fmt: skip
assert (list(_CLIP_TYPES), list(_PAIR_TYPES)) == (list(SEGMENTS), list(PAIRS))


def write_segments(
    file: Path, clips: Iterable[tuple[Clip, Segment]], runs: list[dict[str, Any]], roles: dict[str, str]
) -> int:
    """Writes clips with their segments; every array keeps its numbers exactly.

    Args:
        file: Where to.
        clips: In any order; read one by one.
        runs: Those they belong to, as ``Store.runs.all`` gives them; ``demo_frames`` and
            ``demo_edits`` besides, if known.
        roles: Of the raters, by name.

    Returns:
        How many there were.
    """
    about = {_RUNS: json.dumps(runs).encode(), _ROLES: json.dumps(roles).encode()}
    names = [name for name in SEGMENTS if name not in (*_ARRAYS, "clip_id")]
    rows = (
        {"clip_id": clip.id, **{name: getattr(clip, name) for name in names}, **_lists(segment)}
        for clip, segment in clips
    )
    return _write(file, pa.schema(list(_CLIP_TYPES.items()), about), rows)


def write_pairs(file: Path, pairs: Iterable[tuple[int, str, NewPair]]) -> int:
    """Writes pairs with both segments of each, as ``write_segments``; returns how many there were."""
    rows = (
        {"pair_id": number, "run": run, "demo_step": pair.demo_step, "stage": pair.stage,
         "iteration": pair.iteration, **_lists(pair.left, "left_"), **_lists(pair.right, "right_")}
        for number, run, pair in pairs
    )  # fmt: skip
    return _write(file, pa.schema(list(_PAIR_TYPES.items())), rows)


def read_about(file: Path) -> tuple[list[Any], dict[str, str]]:
    """The runs that a file's clips belong to, not checked yet, and the roles of the raters.

    Raises:
        UserError: If it is no such file.
    """
    try:
        with _opened(file) as source:
            metadata = source.schema_arrow.metadata or {}
        runs, roles = json.loads(metadata[_RUNS]), json.loads(metadata[_ROLES])
        if not isinstance(runs, list) or not set(roles.values()) <= set(ROLES):
            raise ValueError("of another form")
        return runs, roles
    except FileNotFoundError:
        raise UserError(f"there is no file {file}") from None
    except (OSError, pa.ArrowException, KeyError, ValueError, TypeError, AttributeError, RecursionError):
        raise UserError(
            f"{file} is not a file of segments that onedemo wrote; make one with onedemo export --segments"
        ) from None


def read_segments(file: Path, widths: dict[str, dict[str, int]]) -> Iterator[tuple[Clip, Segment]]:
    """The clips of a file with their segments, as they were written.

    Args:
        file: What ``write_segments`` wrote, perhaps.
        widths: Of each run: of each of its arrays.

    Raises:
        UserError: If it is damaged, or a row is no clip of one of these runs.
    """

    def clip(row: dict[str, Any]) -> tuple[Clip, Segment]:
        segment = _segment(row, widths[_run(row, widths)])
        if not _CHOICE.fullmatch(choice := row["choice"]):
            raise ValueError(f"choice is {choice[:80]!a}, not a word")
        return Clip(
            id=_whole(row, "clip_id", 1), run=row["run"], stage=_stage(row),
            demo_step=_whole(row, "demo_step", most=_MOST_DEMO), iteration=_whole(row, "iteration"),
            snapshot=_whole(row, "snapshot"), predicted=_finite(row, "predicted"), steps=len(segment),
            choice=choice, score=_finite(row, "score"),
        ), segment  # fmt: skip

    return _read(file, _CLIP_TYPES, clip)


def read_pairs(file: Path, widths: dict[str, dict[str, int]]) -> Iterator[tuple[int, str, NewPair]]:
    """The pairs of a file, as ``read_segments``."""

    def pair(row: dict[str, Any]) -> tuple[int, str, NewPair]:
        run = _run(row, widths)
        left, right = (_segment(row, widths[run], side) for side in ("left_", "right_"))
        if len(left) != len(right):
            raise ValueError("its two clips are not of one length")
        new = NewPair(
            demo_step=_whole(row, "demo_step", most=_MOST_DEMO), stage=_stage(row),
            iteration=_whole(row, "iteration"), left=left, right=right,
        )  # fmt: skip
        return _whole(row, "pair_id", 1), run, new

    return _read(file, _PAIR_TYPES, pair)


def _write(file: Path, schema: pa.Schema, rows: Iterable[dict[str, Any]]) -> int:
    written, block = 0, []
    with pq.ParquetWriter(file, schema, compression="zstd") as writer:
        for row in rows:
            block.append(row)
            if len(block) == _GROUP:
                writer.write_table(pa.Table.from_pylist(block, schema))
                block = []
            written += 1
        if block or not written:
            writer.write_table(pa.Table.from_pylist(block, schema))
    return written


def _read(
    file: Path, types: dict[str, pa.DataType], read: Callable[[dict[str, Any]], _Row]
) -> Iterator[_Row]:
    try:
        with _opened(file) as source:
            there = source.schema_arrow
            if there.names != list(types):
                raise UserError(f"{file} has columns {there.names}, not {list(types)}")
            for name, kind in types.items():
                if there.field(name).type != kind:
                    raise UserError(f"{file}: its column {name} is {there.field(name).type}, not {kind}")
            about = source.metadata
            groups = [about.row_group(k) for k in range(about.num_row_groups)]
            numbers = sum(group.column(k).num_values for group in groups for k in range(group.num_columns))
            if numbers > max(_MOST_NUMBERS, _MOST_TIMES * file.stat().st_size):
                raise UserError(f"{file} would unpack to {numbers:,} numbers: no export of onedemo does")
            for block in source.iter_batches(batch_size=_GROUP, use_threads=False):
                numbers -= sum(_count(column) for column in block.columns)
                if numbers < 0 or block.nbytes > _MOST_AT_A_TIME:  # what was said of them is not true
                    raise UserError(f"{file} holds more than it says: no export of onedemo does")
                for row in block.to_pylist():
                    try:
                        yield read(row)
                    except (TypeError, ValueError, KeyError) as error:
                        key = next(iter(types))
                        kind = key.removesuffix("_id")
                        raise UserError(f"{file}: {kind} {row[key]} cannot be read: {error}") from None
    except FileNotFoundError:
        raise UserError(f"there is no file {file}") from None
    except MemoryError:
        raise UserError(f"{file} takes more memory than any export of its size: it is damaged") from None
    except (OSError, pa.ArrowException) as error:
        said = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise UserError(f"{file} is damaged: {said}") from None


@contextmanager
def _opened(file: Path) -> Iterator[pq.ParquetFile]:
    """A Parquet file whose end is no larger than one of ours, read within bounds on memory.

    Sizes and numbers in it may be anything: what a page says of itself is believed when memory for it is
    asked for, so it is memory that is bounded, where the system can.

    Raises:
        UserError, OSError, MemoryError, pa.ArrowException: If it is none.
    """
    with file.open("rb") as raw:
        size = raw.seek(0, os.SEEK_END)
        raw.seek(max(0, size - 8))
        about, mark = int.from_bytes(raw.read(4), "little"), raw.read(4)
        if mark == b"PAR1" and about > _MOST_ABOUT:
            raise UserError(f"{file} says more of itself than any export of onedemo")
    with _memory_within(_MEMORY + _MEMORY_TIMES * size), pq.ParquetFile(file, pre_buffer=False) as source:
        yield source


@contextmanager
def _memory_within(more: int) -> Iterator[None]:
    """Memory that goes beyond what this process has by so many bytes is refused, where the system can."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with suppress(OSError, ValueError):  # a system without /proc, or without such a limit
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + more
        if soft == resource.RLIM_INFINITY or most < soft:
            resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    try:
        yield
    finally:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _count(column: pa.Array) -> int:
    """Values of a column as Parquet counts them: of nested lists the innermost."""
    while pa.types.is_list(column.type):
        column = column.flatten()
    return len(column)


def _lists(segment: Segment, side: str = "") -> dict[str, list]:
    return {side + name: getattr(segment, name).tolist() for name in _ARRAYS}


def _segment(row: dict[str, Any], widths: dict[str, int], side: str = "") -> Segment:
    arrays = {}
    for name in _ARRAYS:
        array = np.array(row[side + name], np.float32 if name == "actions" else np.float64)
        if array.ndim != 2 or array.shape[1] != widths[name] or not 1 <= len(array) <= _MOST_STEPS:
            raise ValueError(f"{side}{name} is {array.shape}, not (steps, {widths[name]})")
        if not np.isfinite(array).all():
            raise ValueError(f"{side}{name} has numbers that are not finite")
        arrays[name] = array
    return Segment(**arrays)


def _run(row: dict[str, Any], widths: dict[str, dict[str, int]]) -> str:
    if row["run"] not in widths:
        raise ValueError(f"it is of run {str(row['run'])[:80]!a}, which the file does not describe")
    return row["run"]


def _stage(row: dict[str, Any]) -> str:
    if row["stage"] not in ("pretrain", "online"):
        raise ValueError(f"stage is {str(row['stage'])[:80]!a}, not pretrain or online")
    return row["stage"]


def _whole(row: dict[str, Any], name: str, least: int = 0, most: int = _MOST) -> int:
    if not isinstance(row[name], int) or not least <= row[name] <= most:
        raise ValueError(f"{name} is {row[name]}, not a whole number from {least} to {most:,}")
    return row[name]


def _finite(row: dict[str, Any], name: str) -> float | None:
    if row[name] is not None and not np.isfinite(row[name]):
        raise ValueError(f"{name} is {row[name]}")
    return row[name]
