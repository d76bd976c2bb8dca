"""Segments as Parquet: what was rated, keyed by clip. The runs they belong to are in the file's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from onedemo.app.dataset.columns import SEGMENTS
from onedemo.errors import UserError
from onedemo.types import ROLES, Clip, Segment

_ARRAYS = ("obs", "actions", "qpos", "qvel")
_RUNS, _ROLES = b"onedemo.training.runs", b"onedemo.annotators.oracle"
_GROUP = 500
"""Clips that are in memory at a time."""

_MATRIX = {
    np.dtype(np.float64): pa.list_(pa.list_(pa.float64())),
    np.dtype(np.float32): pa.list_(pa.list_(pa.float32())),
}


def write_segments(
    file: Path, clips: Iterable[tuple[Clip, Segment]], runs: list[dict[str, Any]], roles: dict[str, str]
) -> int:
    """Writes clips with their segments; every array keeps its numbers exactly.

    Args:
        file: Where to.
        clips: In any order; read one by one.
        runs: Those they belong to, as ``Store.runs.all`` gives them.
        roles: Of the raters, by name.

    Returns:
        How many there were.
    """
    written, block = 0, []
    # Actions are float32, all else float64, as the trainer makes them; older data may differ in width,
    # and is written wider.
    types = {
        "clip_id": pa.int64(), "run": pa.string(), "demo_step": pa.int64(), "stage": pa.string(),
        "iteration": pa.int64(), "snapshot": pa.int64(), "predicted": pa.float64(), "choice": pa.string(),
        "score": pa.float64(), "obs": _MATRIX[np.dtype(np.float64)],
        "actions": _MATRIX[np.dtype(np.float32)], "qpos": _MATRIX[np.dtype(np.float64)],
        "qvel": _MATRIX[np.dtype(np.float64)],
    }  # fmt: skip
    assert list(types) == list(SEGMENTS)
    about = {_RUNS: json.dumps(runs).encode(), _ROLES: json.dumps(roles).encode()}
    schema = pa.schema(list(types.items()), about)
    with pq.ParquetWriter(file, schema, compression="zstd") as writer:
        for clip, segment in clips:
            block.append(_row(clip, segment))
            if len(block) == _GROUP:
                writer.write_table(pa.Table.from_pylist(block, schema))
                block = []
            written += 1
        if block or not written:
            writer.write_table(pa.Table.from_pylist(block, schema))
    return written


def read_about(file: Path) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The runs that a file's clips belong to, and the roles of the raters.

    Raises:
        UserError: If it is no such file.
    """
    try:
        metadata = pq.read_schema(file).metadata or {}
        runs, roles = json.loads(metadata[_RUNS]), json.loads(metadata[_ROLES])
        if not isinstance(runs, list) or not set(roles.values()) <= set(ROLES):
            raise ValueError("of another form")
        return runs, roles
    except FileNotFoundError:
        raise UserError(f"there is no file {file}") from None
    except (OSError, pa.ArrowException, KeyError, ValueError, AttributeError):
        raise UserError(
            f"{file} is not a file of segments that onedemo wrote; make one with onedemo export --segments"
        ) from None


def read_segments(file: Path) -> Iterator[tuple[Clip, Segment]]:
    """The clips of a file with their segments, as they were written.

    Raises:
        UserError: If a row is no clip.
    """
    with pq.ParquetFile(file) as source:
        if source.schema_arrow.names != list(SEGMENTS):
            raise UserError(f"{file} has columns {source.schema_arrow.names}, not {list(SEGMENTS)}")
        for block in source.iter_batches(batch_size=_GROUP):
            for row in block.to_pylist():
                try:
                    arrays = {
                        name: np.array(row[name], np.float32 if name == "actions" else np.float64)
                        for name in _ARRAYS
                    }
                    clip = Clip(
                        id=row["clip_id"], run=row["run"], demo_step=row["demo_step"], stage=row["stage"],
                        iteration=row["iteration"], snapshot=row["snapshot"], predicted=row["predicted"],
                        steps=len(arrays["obs"]), choice=row["choice"], score=row["score"],
                    )  # fmt: skip
                    yield clip, Segment(**arrays)
                except (TypeError, ValueError) as error:
                    raise UserError(f"{file}: clip {row['clip_id']} cannot be read: {error}") from None


def _row(clip: Clip, segment: Segment) -> dict[str, Any]:
    row = {name: getattr(clip, name) for name in SEGMENTS if name not in (*_ARRAYS, "clip_id")}
    return {"clip_id": clip.id, **row} | {name: getattr(segment, name).tolist() for name in _ARRAYS}
