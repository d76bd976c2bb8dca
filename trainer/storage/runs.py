"""Runs in the database, with the snapshots and iterations that training recorded for each."""

from __future__ import annotations

import json
import sqlite3

from onedemo.errors import UserError
from onedemo.storage.database import Database, now


class Runs:
    """Runs, their snapshots and their iterations."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(
        self, *, run: str, demo: str, demo_sha256: str, seed: int, config: str, version: str,
        step_seconds: float = 0.008, created_at: str | None = None,
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

        Raises:
            UserError: If a run of that name exists.
        """
        with self._database.transaction() as db:
            try:
                db.execute(
                    "INSERT INTO runs"
                    " (id, demo, demo_sha256, seed, config, version, created_at, step_seconds)"
                    " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                    (run, demo, demo_sha256, seed, config, version, created_at or now(), step_seconds),
                )
            except sqlite3.IntegrityError:
                raise UserError(f"run {run!r} exists already; choose another name") from None

    def all(self) -> list[dict]:
        """All runs, oldest first: id, demo, demo_sha256, seed, config, version, created_at, step_seconds."""
        names = ("id", "demo", "demo_sha256", "seed", "config", "version", "created_at", "step_seconds")
        rows = self._database.rows(f"SELECT {', '.join(names)} FROM runs ORDER BY rowid")
        return [dict(zip(names, row, strict=True)) for row in rows]

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

    def add_iteration(self, run: str, number: int, *, snapshot: int, env_steps: int, stats: dict) -> None:
        """Records an iteration whose checkpoint is on disk already."""
        with self._database.transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO iterations VALUES (?, ?, ?, ?, ?, ?)",
                (run, number, snapshot, env_steps, json.dumps(stats), now()),
            )

    def iterations(self, run: str, after: int = 0) -> list[dict]:
        """Iterations of a run beyond number ``after``: {number, snapshot, env_steps, **stats}."""
        rows = self._database.rows(
            "SELECT number, snapshot, env_steps, stats FROM iterations"
            " WHERE run = ? AND number > ? ORDER BY number",
            (run, after),
        )
        return [{"number": n, "snapshot": s, "env_steps": e, **json.loads(stats)} for n, s, e, stats in rows]

    def last_iteration(self, run: str) -> dict | None:
        """The newest iteration of a run, as ``iterations``; None if there is none."""
        rows = self._database.rows("SELECT MAX(number) FROM iterations WHERE run = ?", (run,))
        newest = rows[0][0]
        return self.iterations(run, after=newest - 1)[0] if newest is not None else None
