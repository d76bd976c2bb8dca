"""All SQL: people, runs, clips and rating events in one SQLite file.

One connection, one lock: every call is short, whatever the number of ratings; what reads all of them
does so over a connection of its own. A write returns after ``COMMIT`` with
``synchronous=FULL``, so what it acknowledged survives the death of the process and of the machine.
"""

from __future__ import annotations

import json
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from trainer.errors import UserError
from trainer.migrations import check_version, migrate
from trainer.records import Clip, Rater, Segment
from trainer.segments import pack_segment, unpack_segment

FILE_NAME = "onedemo.sqlite3"

RATING_COLUMNS = (
    "id", "clip_id", "run", "demo", "rater", "value", "stage", "iteration", "created_at",
    "latency_ms", "snapshot", "predicted", "demo_step", "steps",
)  # fmt: skip
"""Columns of the view ``ratings``, in order."""

_CLIP = "id, run, demo_step, stage, iteration, snapshot, predicted, steps"


@dataclass(frozen=True, kw_only=True, slots=True)
class NewClip:
    """A clip that has no number yet."""

    demo_step: int
    segment: Segment
    stage: str
    iteration: int
    snapshot: int = 0
    predicted: float | None = None


class Rating(NamedTuple):
    """One rating that holds: a row of the training set."""

    event: int
    clip: int
    demo_step: int
    value: int


@dataclass(frozen=True, kw_only=True, slots=True)
class RatedSegment:
    """One rating that holds, with what was rated: what a predictor is fitted on."""

    event: int
    demo_step: int
    segment: Segment
    value: int


class Store:
    """The database in ``data_dir``; made or migrated when opened.

    Safe to use from many threads. Close it when done.

    Raises:
        UserError: If the directory is not writable, the file is not a database, or it is newer.
    """

    def __init__(self, data_dir: Path) -> None:
        self.path = Path(data_dir) / FILE_NAME
        self._lock = threading.RLock()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False, timeout=10)
        except (OSError, sqlite3.Error) as error:
            raise UserError(
                f"the data directory {data_dir} is not writable ({error}); choose another with --data-dir"
            ) from None
        try:
            check_version(self._db)  # before anything is written
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.execute("PRAGMA synchronous = FULL")
            self._db.execute("PRAGMA foreign_keys = ON")
            migrate(self._db)
        except ValueError as error:
            self._db.close()
            raise UserError(
                f"{self.path} was written by a newer onedemo ({error}); update onedemo to open it"
            ) from None
        except sqlite3.DatabaseError as error:
            self._db.close()
            raise UserError(
                f"{self.path} cannot be opened for writing ({error}); "
                "check its permissions or choose another --data-dir"
            ) from None

    def close(self) -> None:
        """Closes the connection; the store cannot be used afterwards."""
        with self._lock:
            self._db.close()

    # People and their links

    def ensure_rater(self, name: str, role: str) -> Rater:
        """The rater of that name, made if there is none.

        Raises:
            UserError: If the name belongs to a rater of another role.
        """
        with self._transaction() as db:
            db.execute(
                "INSERT OR IGNORE INTO raters (name, role, created_at) VALUES (?, ?, ?)",
                (name, role, _now()),
            )
            row = db.execute("SELECT id, name, role FROM raters WHERE name = ?", (name,)).fetchone()
        rater = Rater(id=row[0], name=row[1], role=row[2])
        if rater.role != role:
            raise UserError(f"rater {name!r} exists already as {rater.role}; choose another name")
        return rater

    def raters(self) -> list[Rater]:
        """Everybody, in the order they were added."""
        rows = self._rows("SELECT id, name, role FROM raters ORDER BY id")
        return [Rater(id=i, name=n, role=r) for i, n, r in rows]

    def add_token(self, token_hash: str, rater_id: int, kind: str) -> None:
        """Lets a token stand for a rater; a token that is known already stays as it is.

        Args:
            token_hash: SHA-256 of the token, hex.
            rater_id: Whose it is.
            kind: "link" or "session".
        """
        with self._transaction() as db:
            db.execute(
                "INSERT OR IGNORE INTO tokens (hash, rater_id, kind, created_at) VALUES (?, ?, ?, ?)",
                (token_hash, rater_id, kind, _now()),
            )

    def rater_of(self, token_hash: str, kind: str) -> Rater | None:
        """Whose token that is, or None if it is unknown or revoked."""
        rows = self._rows(
            "SELECT p.id, p.name, p.role FROM tokens t JOIN raters p ON p.id = t.rater_id"
            " WHERE t.hash = ? AND t.kind = ? AND t.revoked_at IS NULL",
            (token_hash, kind),
        )
        return Rater(id=rows[0][0], name=rows[0][1], role=rows[0][2]) if rows else None

    def count_revoked_links(self, rater_id: int) -> int:
        """How many links of a rater were ended."""
        return self._rows(
            "SELECT COUNT(*) FROM tokens WHERE rater_id = ? AND kind = 'link' AND revoked_at IS NOT NULL",
            (rater_id,),
        )[0][0]

    def revoke_tokens(self, rater_id: int) -> int:
        """Ends every link and session of a rater; returns how many."""
        with self._transaction() as db:
            return db.execute(
                "UPDATE tokens SET revoked_at = ? WHERE rater_id = ? AND revoked_at IS NULL",
                (_now(), rater_id),
            ).rowcount

    # Runs

    def add_run(self, *, run: str, demo: str, demo_sha256: str, seed: int, config: str, version: str) -> None:
        """Records a new run.

        Raises:
            UserError: If a run of that name exists.
        """
        with self._transaction() as db:
            try:
                db.execute(
                    "INSERT INTO runs (id, demo, demo_sha256, seed, config, version, created_at)"
                    " VALUES (?, ?, ?, ?, ?, ?, ?)",
                    (run, demo, demo_sha256, seed, config, version, _now()),
                )
            except sqlite3.IntegrityError:
                raise UserError(f"run {run!r} exists already; choose another name") from None

    def runs(self) -> list[dict]:
        """All runs, oldest first, as {id, demo, demo_sha256, seed, config, version, created_at}."""
        names = ("id", "demo", "demo_sha256", "seed", "config", "version", "created_at")
        rows = self._rows(f"SELECT {', '.join(names)} FROM runs ORDER BY rowid")
        return [dict(zip(names, row, strict=True)) for row in rows]

    # Clips

    def add_clips(self, run: str, clips: Sequence[NewClip]) -> list[Clip]:
        """Stores clips with the segments behind them, all or none."""
        with self._transaction() as db:
            added = []
            for clip in clips:
                cursor = db.execute(
                    "INSERT INTO clips (run, demo_step, steps, stage, iteration, snapshot, predicted,"
                    " created_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                    (run, clip.demo_step, len(clip.segment), clip.stage, clip.iteration,
                     clip.snapshot, clip.predicted, _now()),
                )  # fmt: skip
                assert cursor.lastrowid is not None
                db.execute(
                    "INSERT INTO segments VALUES (?, ?)",
                    (cursor.lastrowid, pack_segment(clip.segment)),
                )
                added.append(
                    Clip(
                        id=cursor.lastrowid,
                        run=run,
                        demo_step=clip.demo_step,
                        stage=clip.stage,
                        iteration=clip.iteration,
                        snapshot=clip.snapshot,
                        predicted=clip.predicted,
                        steps=len(clip.segment),
                    )
                )
            return added

    def set_clip_state(self, clip_ids: Sequence[int], state: str) -> None:
        """Moves clips to "cut" (no picture yet), "ready" (may be shown) or "withdrawn" (too old)."""
        with self._transaction() as db:
            db.executemany("UPDATE clips SET state = ? WHERE id = ?", [(state, i) for i in clip_ids])

    def set_predictions(self, snapshot: int, predicted: dict[int, float]) -> None:
        """Notes what a newer snapshot predicts for clips that wait to be rated."""
        with self._transaction() as db:
            db.executemany(
                "UPDATE clips SET snapshot = ?, predicted = ? WHERE id = ?",
                [(snapshot, value, clip) for clip, value in predicted.items()],
            )

    def clip(self, clip_id: int) -> Clip | None:
        """One clip, or None if there is none of that number."""
        rows = self._rows(f"SELECT {_CLIP} FROM clips WHERE id = ?", (clip_id,))
        return Clip(**dict(zip(_CLIP.split(", "), rows[0], strict=True))) if rows else None

    def waiting_clips(self, run: str, state: str = "ready") -> list[Clip]:
        """Clips in that state that nobody has rated or skipped, oldest first."""
        rows = self._rows(
            f"SELECT {_CLIP} FROM clips WHERE run = ? AND state = ? AND answers = 0 ORDER BY id",
            (run, state),
        )
        return [Clip(**dict(zip(_CLIP.split(", "), row, strict=True))) for row in rows]

    def count_clips(self, run: str) -> int:
        """How many clips were ever cut in a run."""
        rows = self._rows("SELECT clips FROM runs WHERE id = ?", (run,))
        return rows[0][0] if rows else 0

    def segment(self, clip_id: int) -> Segment:
        """The states and actions behind a clip.

        Raises:
            KeyError: If there is no such clip.
        """
        rows = self._rows("SELECT data FROM segments WHERE clip_id = ?", (clip_id,))
        if not rows:
            raise KeyError(f"no clip {clip_id}")
        return unpack_segment(rows[0][0])

    # Rating events

    def rate(self, clip_id: int, rater_id: int, value: int, latency_ms: int) -> int:
        """Commits one rating and returns its event number.

        Raises:
            ValueError: If the value is not a whole number from 1 to 5, there is no such clip, or
                the rater's rating of this clip holds already.
        """
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 5:
            raise ValueError(f"a rating is a whole number from 1 to 5, got {value!r}")
        return self._event(clip_id, rater_id, "rate", value, latency_ms)

    def skip(self, clip_id: int, rater_id: int, latency_ms: int) -> int:
        """Commits that the rater would not rate this clip; returns the event number.

        Raises:
            ValueError: As ``rate``.
        """
        return self._event(clip_id, rater_id, "skip", None, latency_ms)

    def undo(self, clip_id: int, rater_id: int) -> int:
        """Takes a rater's rating or skip of a clip back; returns the event number.

        Raises:
            ValueError: If there is nothing to take back.
        """
        return self._event(clip_id, rater_id, "undo", None, 0)

    def _event(self, clip_id: int, rater_id: int, kind: str, value: int | None, latency_ms: int) -> int:
        with self._transaction() as db:
            clip = db.execute("SELECT snapshot, predicted FROM clips WHERE id = ?", (clip_id,)).fetchone()
            if clip is None:
                raise ValueError(f"no clip {clip_id}")
            last = db.execute(
                "SELECT kind FROM events WHERE clip_id = ? AND rater_id = ? ORDER BY id DESC LIMIT 1",
                (clip_id, rater_id),
            ).fetchone()
            holds = last is not None and last[0] != "undo"
            if kind == "undo" and not holds:
                raise ValueError(f"clip {clip_id} has nothing to take back")
            if kind != "undo" and holds:
                raise ValueError(f"clip {clip_id} is rated already by this rater")
            cursor = db.execute(
                "INSERT INTO events (clip_id, rater_id, kind, value, snapshot, predicted, latency_ms,"
                " created_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (clip_id, rater_id, kind, value, *clip, max(0, int(latency_ms)), _now()),
            )
            assert cursor.lastrowid is not None
            return cursor.lastrowid

    def last_event(self) -> int:
        """Number of the newest event of all runs, 0 if there is none."""
        return self._rows("SELECT MAX(id) FROM events")[0][0] or 0

    def ratings_as_of(self, run: str, as_of: int | None = None) -> list[Rating]:
        """The ratings of a run that held when event ``as_of`` was written (default: now), in order.

        The same events give the same list, so a snapshot can be traced to its ratings and made again
        (``TrainingSet`` adds the segments).
        """
        limit = as_of if as_of is not None else 2**62
        rows = self._stream(
            "SELECT e.id, e.clip_id, c.demo_step, e.value FROM events e JOIN clips c ON c.id = e.clip_id"
            " WHERE c.run = ? AND e.kind = 'rate' AND e.id <= ? AND NOT EXISTS ("
            "  SELECT 1 FROM events l WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id"
            "  AND l.id > e.id AND l.id <= ?) ORDER BY e.id",
            (run, limit, limit),
        )
        return [Rating._make(row) for row in rows]

    def ratings_by_class(self, run: str | None = None) -> list[int]:
        """How many ratings of 1, 2, 3, 4 and 5 hold, in one run or in all."""
        where, values = ("", ()) if run is None else ("WHERE run = ?", (run,))
        counts = dict(self._rows(f"SELECT value, SUM(ratings) FROM tallies {where} GROUP BY value", values))
        return [counts.get(value, 0) for value in range(1, 6)]

    def tallies(self, run: str) -> dict[tuple[str, str], list[int]]:
        """Ratings of 1 to 5 that hold in a run, by (rater's name, stage), sorted."""
        rows = self._rows(
            "SELECT name, stage, value, ratings FROM tallies JOIN raters ON raters.id = rater_id"
            " WHERE run = ? AND ratings > 0 ORDER BY name, stage",
            (run,),
        )
        counts: dict[tuple[str, str], list[int]] = {}
        for name, stage, value, ratings in rows:
            counts.setdefault((name, stage), [0] * 5)[value - 1] = ratings
        return counts

    def iter_ratings(self, run: str | None = None) -> Iterator[tuple]:
        """Rows of the view ``ratings`` in order of their number, streamed."""
        return self._stream(
            f"SELECT {', '.join(RATING_COLUMNS)} FROM ratings WHERE ?1 IS NULL OR run = ?1 ORDER BY id",
            (run,),
        )

    # What the trainer did

    def add_snapshot(self, run: str, number: int, *, last_event: int, ratings: int, stats: dict) -> None:
        """Records a snapshot whose file is on disk already."""
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO snapshots VALUES (?, ?, ?, ?, ?, ?)",
                (run, number, last_event, ratings, json.dumps(stats), _now()),
            )

    def snapshots(self, run: str) -> list[dict]:
        """All snapshots of a run in order: {number, last_event, ratings, **stats}."""
        rows = self._rows(
            "SELECT number, last_event, ratings, stats FROM snapshots WHERE run = ? ORDER BY number",
            (run,),
        )
        return [{"number": n, "last_event": e, "ratings": r, **json.loads(stats)} for n, e, r, stats in rows]

    def add_iteration(self, run: str, number: int, *, snapshot: int, env_steps: int, stats: dict) -> None:
        """Records an iteration whose checkpoint is on disk already."""
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO iterations VALUES (?, ?, ?, ?, ?, ?)",
                (run, number, snapshot, env_steps, json.dumps(stats), _now()),
            )

    def iterations(self, run: str, after: int = 0) -> list[dict]:
        """Iterations of a run beyond number ``after``: {number, snapshot, env_steps, **stats}."""
        rows = self._rows(
            "SELECT number, snapshot, env_steps, stats FROM iterations"
            " WHERE run = ? AND number > ? ORDER BY number",
            (run, after),
        )
        return [{"number": n, "snapshot": s, "env_steps": e, **json.loads(stats)} for n, s, e, stats in rows]

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
            except BaseException:
                if self._db.in_transaction:  # SQLite ends it by itself on a full disk, say
                    self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _rows(self, sql: str, values: Sequence = ()) -> list[tuple]:
        with self._lock:
            return self._db.execute(sql, values).fetchall()

    def _stream(self, sql: str, values: Sequence) -> Iterator[tuple]:
        """Rows one by one, over a read-only connection of their own: no press waits for them."""
        db = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro", uri=True, timeout=10)
        try:
            yield from db.execute(sql, values)
        finally:
            db.close()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
