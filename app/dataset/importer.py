"""An export back into a data directory: the same events in the same order, so the same predictor.

The files may be anybody's, or edited: each number, name and time is checked where it is read, and what
one file says of another is checked here.
"""

from __future__ import annotations

import re
import sqlite3
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from onedemo.app.dataset import csv_reader as cell
from onedemo.app.dataset.exporter import FILES
from onedemo.app.dataset.parquet import read_about, read_pairs, read_segments
from onedemo.core.files import write_atomic
from onedemo.core.names import check_description, check_name
from onedemo.demos.library import list_demos
from onedemo.errors import UserError
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.storage.comparisons import ANSWERS
from onedemo.storage.run_directory import RunDirectory, check_run_name
from onedemo.storage.store import Store

_RUN = ("id", "demo", "demo_sha256", "seed", "config", "version")
_LONGEST_CONFIG = 1 << 20
_LONGEST_EDITS = 300

_PREDICTION = cell.number(-100.0, 100.0)
_EVENT = {
    "id": cell.whole(1), "run": cell.name, "rater": cell.name, "created_at": cell.time,
    "latency_ms": cell.whole(0),
}  # fmt: skip
_PREDICTED = {"snapshot": cell.whole(0), "predicted?": _PREDICTION}
_MARK = {"mark_start?": cell.number(0.0, 1e6), "mark_end?": cell.number(0.0, 1e6)}
_RATINGS = {
    **_EVENT, "clip_id": cell.whole(1), "value": cell.whole(1, 5), "repeat": cell.whole(0, 1),
    "left_out": cell.whole(0, 1), **_PREDICTED, **_MARK,
}  # fmt: skip
_SKIPS = {
    **_EVENT, "clip_id": cell.whole(1), "reason?": cell.line, "repeat": cell.whole(0, 1),
    "snapshot?": cell.whole(0), "predicted?": _PREDICTION,
}  # fmt: skip
_COMPARISONS = {**_EVENT, "pair_id": cell.whole(1), "answer": cell.one_of(*ANSWERS)}
_HISTORY = {
    **_EVENT, "clip_id?": cell.whole(1), "pair_id?": cell.whole(1), "value?": cell.whole(1, 5),
    "kind": cell.one_of("rate", "skip", "undo", "leave out", "take in", *ANSWERS),
    "repeat": cell.whole(0, 1), **_MARK, "reason?": cell.line, "snapshot?": cell.whole(0),
    "predicted?": _PREDICTION, "by?": cell.name, "withdrawn?": cell.line,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Export:
    """The files of an export; those that are None have nothing in them."""

    ratings: Path | None
    segments: Path
    skips: Path | None = None
    comparisons: Path | None = None
    pairs: Path | None = None
    history: Path | None = None


def export_in(directory: Path) -> Export:
    """The export that ``onedemo export --all`` wrote into a directory.

    Raises:
        UserError: If there is none.
    """
    there = {name.partition(".")[0]: directory / name for name in FILES if (directory / name).is_file()}
    if "segments" not in there:
        raise UserError(f"no segments.parquet in {directory}; is it what onedemo export --all wrote?")
    there.pop("card", None)
    return Export(**{"ratings": None, **there})


def import_data(export: Export, data_dir: Path) -> dict[str, int]:
    """Fills an empty data directory with exported runs, clips, pairs and events. All of it, or nothing.

    Args:
        export: The files.
        data_dir: Where to; must hold no runs yet.

    Returns:
        How many "runs", "clips", "ratings", "comparisons" and "events" of both there are now.

    Raises:
        UserError: If a file is not an export, they do not belong together, or the directory holds data.
    """
    runs, roles = read_about(export.segments)
    for run in runs:
        _check_run(run, export.segments)
    if len({run["id"] for run in runs}) != len(runs):
        raise UserError(f"{export.segments} describes a run twice")
    widths = {run["id"]: _widths(run, export.segments) for run in runs}
    _check_demos(runs, data_dir)
    store = Store(data_dir)
    try:
        if store.runs.all():
            raise UserError(f"{data_dir} holds runs already; import into an empty data directory")
        with store.database.transaction():
            for run in runs:
                store.runs.add(
                    run=run["id"], **{name: run[name] for name in _RUN[1:]},
                    created_at=run.get("created_at"), step_seconds=run.get("step_seconds", 0.008),
                    title=run.get("title", ""), note=run.get("note", ""),
                )  # fmt: skip
            try:
                clips = store.clips.restore(read_segments(export.segments, widths))
                pairs = {}
                if export.pairs is not None:
                    pairs = store.comparisons.restore_pairs(read_pairs(export.pairs, widths))
            except sqlite3.IntegrityError:
                raise UserError("two clips or pairs of the export have one number") from None
            counts = _Events(store, export, clips, pairs, roles).restore()
        for run in runs:
            write_atomic(RunDirectory(data_dir, run["id"]).config, run["config"].encode())
    finally:
        store.close()
    return {"runs": len(runs), "clips": len(clips), **counts}


class _Events:
    """What people said, from four files, in the order of its numbers."""

    def __init__(
        self, store: Store, export: Export, clips: dict[int, str], pairs: dict[int, str],
        roles: dict[str, str],
    ) -> None:  # fmt: skip
        self._store, self._export, self._roles = store, export, roles
        self._clips, self._pairs = clips, pairs
        self._raters: dict[str, int] = {}
        self._seen: dict[tuple[str, int], str] = {}

    def restore(self) -> dict[str, int]:
        events, answers, left_out = [], [], set()
        for where, row in self._rows():
            row |= {"rater_id": self._rater(row["rater"], where), "where": where}
            of_pair = row.get("pair_id") is not None
            self._check(row, of_pair, where)
            if row.get("left_out"):
                left_out.add((row["run"], row["rater_id"]))
            (answers if of_pair else events).append(row)
        last: dict[tuple, str] = {}
        for row in sorted(events, key=lambda row: row["id"]):
            about_rater = row["clip_id"] is None
            key = (row["clip_id"], row["rater_id"], row["repeat"])
            if row["kind"] == "skip" and row["reason"] and last.get(key) == "skip":
                row["latency_ms"] = 0  # an export gives it the time of the skip that it explains
            last[key] = row["kind"]
            self._put(self._store.ratings.restore, row | {"run": row["run"] if about_rater else None})
        for row in sorted(answers, key=lambda row: row["id"]):
            self._put(self._store.comparisons.restore, row)
        if self._export.history is None:
            for run, rater in sorted(left_out):
                self._store.ratings.leave_out(run, rater, by=rater)
        return {
            "ratings": sum("left_out" in row for row in events),
            "comparisons": sum("kind" not in row for row in answers),
            "events": len(events) + len(answers),
        }

    def _rows(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """(file and line, row of a table) of every event."""
        export = self._export
        nothing = {"value": None, "reason": None, "mark_start": None, "mark_end": None}
        if export.ratings is not None:
            for line, row in cell.read_table(export.ratings, "ratings", _RATINGS):
                yield f"{export.ratings}, line {line}", nothing | row | {"kind": "rate"}
        if export.skips is not None:
            table = cell.read_table(export.skips, "skips", _SKIPS, may_lack=("snapshot", "predicted"))
            for line, row in table:
                row["snapshot"] = row["snapshot"] or 0
                yield f"{export.skips}, line {line}", nothing | row | {"kind": "skip"}
        if export.comparisons is not None:
            for line, row in cell.read_table(export.comparisons, "comparisons", _COMPARISONS):
                yield f"{export.comparisons}, line {line}", row
        if export.history is not None:
            for line, row in cell.read_table(export.history, "the history", _HISTORY):
                where = f"{export.history}, line {line}"
                by = row.pop("by")
                row |= {
                    "answer": row["kind"], "snapshot": row["snapshot"] or 0,
                    "by_id": self._rater(by, where) if by is not None else None,
                }  # fmt: skip
                yield where, row

    def _rater(self, name: str, where: str) -> int:
        if name not in self._raters:
            role = self._roles.get(name, "annotator")
            try:
                self._raters[name] = self._store.accounts.ensure(name, role).id
            except UserError as error:
                raise UserError(f"{where}: {error}") from None
        return self._raters[name]

    def _check(self, row: dict[str, Any], of_pair: bool, where: str) -> None:
        kind = "comparison" if of_pair else "rating"
        before = self._seen.setdefault((kind, row["id"]), where)
        if before != where:
            raise UserError(f"{where}: {kind} {row['id']} is there twice, first in {before}")
        known, what = (self._pairs, "pair") if of_pair else (self._clips, "clip")
        number = row["pair_id" if of_pair else "clip_id"]
        if number is None:
            runs = {entry["id"] for entry in self._store.runs.all()}
            if row["kind"] not in ("leave out", "take in") or row["run"] not in runs:
                raise UserError(f"{where}: it is about no clip, no pair and no rater of a run")
            return
        if number not in known:
            file = self._export.pairs if of_pair else self._export.segments
            raise UserError(f"{where}: {what} {number} is not in {file or 'any file that was given'}")
        if known[number] != row["run"]:
            given = ascii(row["run"][:80])
            raise UserError(f"{where}: {what} {number} belongs to run {known[number]!r}, not {given}")
        allowed = (*ANSWERS, "skip", "undo") if of_pair else ("rate", "skip", "undo")
        if row.get("kind", "left") not in allowed:
            raise UserError(f"{where}: a {what} is not for {row['kind']!r}")
        start, end = row.get("mark_start"), row.get("mark_end")
        if (start is None) != (end is None) or (start is not None and not start < end):
            raise UserError(f"{where}: a mark begins at mark_start and ends later, at mark_end")

    def _put(self, restore: Any, row: dict[str, Any]) -> None:
        try:
            restore(row)
        except sqlite3.IntegrityError as error:
            raise UserError(f"{row['where']}: this cannot be kept ({error})") from None


def _check_run(run: Any, file: Path) -> None:
    """Raises UserError unless that can be a run of ours: its name becomes a directory, the rest is shown."""
    try:
        if not isinstance(run, dict):
            raise ValueError("it is no table")
        for name in _RUN:
            if not isinstance(run.get(name), int if name == "seed" else str):
                raise ValueError(f"{name} is missing")
        check_run_name(run["id"])
        check_name(run["demo"])
        if not re.fullmatch(r"[0-9a-f]{64}", run["demo_sha256"], re.ASCII):
            raise ValueError("demo_sha256 is not a SHA-256")
        frames = run.get("demo_frames")
        if frames is not None and (type(frames) is not int or not 0 < frames < 1_000_000):
            raise ValueError("demo_frames is out of range")
        edits = run.get("demo_edits", "")
        if not isinstance(edits, str) or len(edits) > _LONGEST_EDITS or not edits.isprintable():
            raise ValueError("demo_edits is no line of text")
        if not 0 <= run["seed"] < 2**63 or isinstance(run["seed"], bool):
            raise ValueError("seed is out of range")
        if not re.fullmatch(r"[\w.+!-]{1,40}", run["version"], re.ASCII):
            raise ValueError("version is not a version")
        if run.get("created_at") is not None:
            cell.time(run["created_at"])
        if not 1e-6 < float(run.get("step_seconds", 0.008)) < 10:
            raise ValueError("step_seconds is out of range")
        check_description(run.get("title", ""), run.get("note", ""))
        if len(run["config"]) > _LONGEST_CONFIG:
            raise ValueError("config is too long")
        tomllib.loads(run["config"])
    except (UserError, ValueError, TypeError, RecursionError) as error:
        raise UserError(f"{file} does not say what its runs are: {error}") from None


def _check_demos(runs: list[dict[str, Any]], data_dir: Path) -> None:
    """Raises UserError if a demo of the same name is there already, and is not the one that was rated."""
    there = {demo.name: demo for demo in list_demos(data_dir / "demos")}
    for run in runs:
        demo, given = there.get(run["demo"]), run.get("demo_frames")
        if demo is not None and given is not None and demo.sha256 != run["demo_sha256"]:
            edits = f" ({run['demo_edits']})" if run.get("demo_edits") else ""
            raise UserError(
                f"run {run['id']} was rated beside a demo {demo.name} of {given} frames{edits}, and the one "
                f"in {data_dir} has {demo.frames} and other pictures: give that another name (onedemo demo "
                "rename), and put the right one there"
            )


def _widths(run: dict[str, Any], file: Path) -> dict[str, int]:
    """Columns of each array of a run's robot."""
    try:
        robot = robot_named(str(tomllib.loads(run["config"]).get("env", DEFAULT)))
    except UserError as error:
        raise UserError(f"{file}: run {run['id']}: {error}") from None
    return {
        "obs": robot.obs_size, "actions": robot.action_size, "qpos": robot.positions, "qvel": robot.velocities
    }  # fmt: skip
