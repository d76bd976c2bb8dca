"""Runs in the database, with the snapshots and iterations that training recorded for each."""

from __future__ import annotations

import json
import sqlite3

from onedemo.errors import UserError
from onedemo.storage.database import Database, now

_COLUMNS = (
    "id", "demo", "demo_sha256", "seed", "config", "version", "created_at", "step_seconds", "title", "note",
)  # fmt: skip
_OF_A_RUN = ("tallies", "clips", "pairs", "iterations", "snapshots", "run_marks")


class Runs:
    """Runs, their snapshots and their iterations."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(
        self, *, run: str, demo: str, demo_sha256: str, seed: int, config: str, version: str,
        step_seconds: float = 0.008, created_at: str | None = None, title: str = "", note: str = "",
    ) -> None:  # fmt: skip
        """Records a new run.

        Args:
            run: Its name.
            demo: What is to be learned.
            demo_sha256: Of that video.
            seed: Of everything random.
            config: Its settings, TOML.
            version: Of the program that made it.
            step_seconds: Length of its robot's control step.
            created_at: When it was made, if not now.
            title: What people call it, if not by its name.
            note: What they say of it.

        Raises:
            UserError: If a run of that name exists.
        """
        with self._database.transaction() as db:
            try:
                db.execute(
                    f"INSERT INTO runs ({', '.join(_COLUMNS)}) VALUES ({', '.join('?' * len(_COLUMNS))})",
                    (
                        run,
                        demo,
                        demo_sha256,
                        seed,
                        config,
                        version,
                        created_at or now(),
                        step_seconds,
                        title,
                        note,
                    ),
                )
            except sqlite3.IntegrityError:
                raise UserError(f"run {run!r} exists already; choose another name") from None

    def all(self) -> list[dict]:
        """All runs, oldest first, each {id, demo, demo_sha256, ...}: the arguments of ``add``."""
        rows = self._database.rows(f"SELECT {', '.join(_COLUMNS)} FROM runs ORDER BY rowid")
        return [dict(zip(_COLUMNS, row, strict=True)) for row in rows]

    def describe(self, run: str, *, title: str, note: str) -> None:
        """Notes what people call a run and say of it; "" for nothing."""
        with self._database.transaction() as db:
            db.execute("UPDATE runs SET title = ?, note = ? WHERE id = ?", (title, note, run))

    def delete(self, run: str) -> None:
        """Deletes a run with its clips and pairs, and all that people said of them: there is no way back.

        Events are append-only by triggers; they are taken away in this one transaction and put back.
        """
        clips, pairs = (f"(SELECT id FROM {table} WHERE run = :run)" for table in ("clips", "pairs"))
        with self._database.transaction() as db:
            guards = db.execute(
                "SELECT name, sql FROM sqlite_master WHERE type = 'trigger' AND name LIKE '%_keep_delete'"
                " AND tbl_name IN ('events', 'comparisons')"
            ).fetchall()
            for name, _ in guards:
                db.execute(f"DROP TRIGGER {name}")
            for table, which in (
                ("events", f"run = :run OR clip_id IN {clips}"),
                ("comparisons", f"pair_id IN {pairs}"),
                ("segments", f"clip_id IN {clips}"),
                *((table, "run = :run") for table in _OF_A_RUN),
                ("runs", "id = :run"),
            ):
                db.execute(f"DELETE FROM {table} WHERE {which}", {"run": run})
            for _, guard in guards:
                db.execute(guard)

    def rename_demo(self, demo_sha256: str, name: str) -> None:
        """Gives the demo of some runs the name that it has from now on."""
        with self._database.transaction() as db:
            db.execute("UPDATE runs SET demo = ? WHERE demo_sha256 = ?", (name, demo_sha256))

    def add_snapshot(self, run: str, number: int, *, last_event: int, ratings: int, stats: dict) -> None:
        """Records a snapshot whose file is on disk already."""
        with self._database.transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO snapshots VALUES (?, ?, ?, ?, ?, ?)",
                (run, number, last_event, ratings, json.dumps(stats), now()),
            )

    def snapshots(self, run: str) -> list[dict]:
        """All snapshots of a run in order: {number, last_event, ratings, **stats}."""
        rows = self._database.rows(
            "SELECT number, last_event, ratings, stats FROM snapshots WHERE run = ? ORDER BY number",
            (run,),
        )
        return [{"number": n, "last_event": e, "ratings": r, **json.loads(stats)} for n, e, r, stats in rows]

    def mark(self, run: str, iteration: int, kind: str) -> None:
        """Notes that a run was held or went on.

        Args:
            run: Its name.
            iteration: The last one before it.
            kind: "paused", "resumed", "stopped" or "failed".
        """
        with self._database.transaction() as db:
            db.execute(
                "INSERT INTO run_marks (run, iteration, kind, created_at) VALUES (?, ?, ?, ?)",
                (run, iteration, kind, now()),
            )

    def marks(self, run: str) -> list[tuple[int, str, str]]:
        """What happened to a run besides its iterations: (last iteration before it, kind, rater).

        Returns:
            By iteration: what ``mark`` noted, with no rater, and who was excluded from training ("excluded")
            or taken in again ("included").
        """
        return self._database.rows(
            "SELECT iteration, kind, '' FROM run_marks WHERE run = ?1 UNION ALL"
            " SELECT (SELECT COALESCE(MAX(i.number), 0) FROM iterations i"
            "  WHERE i.run = ?1 AND i.created_at <= e.created_at),"
            " CASE e.kind WHEN 'leave out' THEN 'excluded' ELSE 'included' END, p.name"
            " FROM events e JOIN raters p ON p.id = e.rater_id WHERE e.clip_id IS NULL AND e.run = ?1"
            " ORDER BY 1",
            (run,),
        )

    def forecasts(self, run: str) -> list[tuple[str, int, float]]:
        """What was predicted for clips before anybody had rated them, and the first rating of each.

        Returns:
            (time, rating, predicted rating), in the order of the ratings.
        """
        return self._database.rows(
            "SELECT e.created_at, e.value, e.predicted FROM events e JOIN clips c ON c.id = e.clip_id"
            " WHERE c.run = ? AND e.kind = 'rate' AND e.repeat = 0 AND e.predicted IS NOT NULL"
            " AND NOT EXISTS (SELECT 1 FROM events l"
            "  WHERE l.clip_id = e.clip_id AND l.kind = 'rate' AND l.id < e.id) ORDER BY e.id",
            (run,),
        )

    def numbers(self) -> dict[str, int]:
        """A number of each run that no other has, 1 and up, in the order in which they were made."""
        return dict(self._database.rows("SELECT id, rowid FROM runs ORDER BY rowid"))

    def add_iteration(self, run: str, number: int, *, snapshot: int, env_steps: int, stats: dict) -> None:
        """Records an iteration whose checkpoint is on disk already."""
        with self._database.transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO iterations VALUES (?, ?, ?, ?, ?, ?)",
                (run, number, snapshot, env_steps, json.dumps(stats), now()),
            )

    def iterations(self, run: str, after: int = 0) -> list[dict]:
        """Iterations of a run beyond number ``after``: {number, snapshot, env_steps, **stats}."""
        return [row for _, row in self.dated_iterations(run, after)]

    def dated_iterations(self, run: str, after: int = 0) -> list[tuple[str, dict]]:
        """The same, each with when it was recorded."""
        rows = self._database.rows(
            "SELECT created_at, number, snapshot, env_steps, stats FROM iterations"
            " WHERE run = ? AND number > ? ORDER BY number",
            (run, after),
        )
        return [
            (at, {"number": n, "snapshot": s, "env_steps": e, **json.loads(stats)})
            for at, n, s, e, stats in rows
        ]

    def best_iteration(self, run: str) -> int | None:
        """Number of the iteration whose best rollout is the best of all; None if none has one."""
        rows = self._database.rows(
            "SELECT number FROM iterations WHERE run = ? AND json_extract(stats, '$.best') IS NOT NULL"
            " ORDER BY json_extract(stats, '$.best') DESC, number LIMIT 1",
            (run,),
        )
        return rows[0][0] if rows else None

    def last_iteration(self, run: str) -> dict | None:
        """The newest iteration of a run, as ``iterations``; None if there is none."""
        rows = self._database.rows("SELECT MAX(number) FROM iterations WHERE run = ?", (run,))
        newest = rows[0][0]
        return self.iterations(run, after=newest - 1)[0] if newest is not None else None
