"""All there is in the database, in one object: people, answers, pairs, runs and clips, what was trained."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from onedemo.errors import UserError
from onedemo.storage.accounts import People
from onedemo.storage.comparisons import Pairs
from onedemo.storage.database import FILE_NAME, now
from onedemo.storage.ratings import RATING_COLUMNS, Answers, RatedSegment, Rating
from onedemo.storage.segment_codec import pack_segment, unpack_segment
from onedemo.types import Clip, Segment

__all__ = ["FILE_NAME", "RATING_COLUMNS", "NewClip", "RatedSegment", "Rating", "Store"]

_CLIP = "id, run, demo_step, stage, iteration, snapshot, predicted, steps, choice, score"


@dataclass(frozen=True, kw_only=True, slots=True)
class NewClip:
    """A clip that has no number yet."""

    demo_step: int
    segment: Segment
    stage: str
    iteration: int
    snapshot: int = 0
    predicted: float | None = None
    choice: str = ""
    score: float | None = None


class Store(People, Answers, Pairs):
    """The database in ``data_dir``. Arguments and errors as ``onedemo.storage.database.Database``."""

    # Runs

    def add_run(self, *, run: str, demo: str, demo_sha256: str, seed: int, config: str, version: str) -> None:
        """Records a new run.

        Raises:
            UserError: If a run of that name exists.
        """
        with self.transaction() as db:
            try:
                db.execute(
                    "INSERT INTO runs (id, demo, demo_sha256, seed, config, version, created_at)"
                    " VALUES (?, ?, ?, ?, ?, ?, ?)",
                    (run, demo, demo_sha256, seed, config, version, now()),
                )
            except sqlite3.IntegrityError:
                raise UserError(f"run {run!r} exists already; choose another name") from None

    def runs(self) -> list[dict]:
        """All runs, oldest first, as {id, demo, demo_sha256, seed, config, version, created_at}."""
        names = ("id", "demo", "demo_sha256", "seed", "config", "version", "created_at")
        rows = self.rows(f"SELECT {', '.join(names)} FROM runs ORDER BY rowid")
        return [dict(zip(names, row, strict=True)) for row in rows]

    # Clips

    def add_clips(self, run: str, clips: Sequence[NewClip]) -> list[Clip]:
        """Stores clips with the segments behind them, all or none."""
        with self.transaction() as db:
            added = []
            for clip in clips:
                cursor = db.execute(
                    "INSERT INTO clips (run, demo_step, steps, stage, iteration, snapshot, predicted,"
                    " choice, score, created_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                    (run, clip.demo_step, len(clip.segment), clip.stage, clip.iteration,
                     clip.snapshot, clip.predicted, clip.choice, clip.score, now()),
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
                        choice=clip.choice,
                        score=clip.score,
                    )
                )
            return added

    def restore_clips(self, clips: Iterable[tuple[Clip, Segment]]) -> set[int]:
        """Stores clips of an export under the numbers they had, which it returns; nobody is asked them."""
        numbers = set()
        with self.transaction() as db:
            for clip, segment in clips:
                db.execute(
                    f"INSERT INTO clips ({_CLIP}, state, created_at)"
                    " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, 'withdrawn', ?)",
                    (*(getattr(clip, name) for name in _CLIP.split(", ")), now()),
                )
                db.execute("INSERT INTO segments VALUES (?, ?)", (clip.id, pack_segment(segment)))
                numbers.add(clip.id)
        return numbers

    def rated_clips(self, run: str | None = None) -> Iterator[tuple[Clip, Segment]]:
        """Every clip that has a rating, with its segment, in order, streamed."""
        columns = ", ".join(f"c.{name}" for name in _CLIP.split(", "))
        rows = self.stream(
            f"SELECT {columns}, s.data FROM clips c JOIN segments s ON s.clip_id = c.id"
            " WHERE (?1 IS NULL OR c.run = ?1) AND c.id IN (SELECT clip_id FROM ratings) ORDER BY c.id",
            (run,),
        )
        for *values, data in rows:
            clip = Clip(**dict(zip(_CLIP.split(", "), values, strict=True)))
            yield clip, unpack_segment(data)

    def set_clip_state(self, clip_ids: Sequence[int], state: str) -> None:
        """Moves clips to "cut" (no picture yet), "ready" (may be shown) or "withdrawn" (too old)."""
        with self.transaction() as db:
            db.executemany("UPDATE clips SET state = ? WHERE id = ?", [(state, i) for i in clip_ids])

    def set_predictions(self, snapshot: int, predicted: dict[int, float]) -> None:
        """Notes what a newer snapshot predicts for clips that wait to be rated."""
        with self.transaction() as db:
            db.executemany(
                "UPDATE clips SET snapshot = ?, predicted = ? WHERE id = ?",
                [(snapshot, value, clip) for clip, value in predicted.items()],
            )

    def clip(self, clip_id: int) -> Clip | None:
        """One clip, or None if there is none of that number."""
        rows = self.rows(f"SELECT {_CLIP} FROM clips WHERE id = ?", (clip_id,))
        return Clip(**dict(zip(_CLIP.split(", "), rows[0], strict=True))) if rows else None

    def waiting_clips(self, run: str, state: str = "ready") -> list[Clip]:
        """Clips in that state that nobody has rated or skipped, oldest first."""
        rows = self.rows(
            f"SELECT {_CLIP} FROM clips WHERE run = ? AND state = ? AND answers = 0 ORDER BY id",
            (run, state),
        )
        return [Clip(**dict(zip(_CLIP.split(", "), row, strict=True))) for row in rows]

    def count_clips(self, run: str) -> int:
        """How many clips were ever cut in a run."""
        rows = self.rows("SELECT clips FROM runs WHERE id = ?", (run,))
        return rows[0][0] if rows else 0

    def segment(self, clip_id: int) -> Segment:
        """The states and actions behind a clip.

        Raises:
            KeyError: If there is no such clip.
        """
        rows = self.rows("SELECT data FROM segments WHERE clip_id = ?", (clip_id,))
        if not rows:
            raise KeyError(f"no clip {clip_id}")
        return unpack_segment(rows[0][0])

    # What the trainer did

    def add_snapshot(self, run: str, number: int, *, last_event: int, ratings: int, stats: dict) -> None:
        """Records a snapshot whose file is on disk already."""
        with self.transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO snapshots VALUES (?, ?, ?, ?, ?, ?)",
                (run, number, last_event, ratings, json.dumps(stats), now()),
            )

    def snapshots(self, run: str) -> list[dict]:
        """All snapshots of a run in order: {number, last_event, ratings, **stats}."""
        rows = self.rows(
            "SELECT number, last_event, ratings, stats FROM snapshots WHERE run = ? ORDER BY number",
            (run,),
        )
        return [{"number": n, "last_event": e, "ratings": r, **json.loads(stats)} for n, e, r, stats in rows]

    def add_iteration(self, run: str, number: int, *, snapshot: int, env_steps: int, stats: dict) -> None:
        """Records an iteration whose checkpoint is on disk already."""
        with self.transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO iterations VALUES (?, ?, ?, ?, ?, ?)",
                (run, number, snapshot, env_steps, json.dumps(stats), now()),
            )

    def iterations(self, run: str, after: int = 0) -> list[dict]:
        """Iterations of a run beyond number ``after``: {number, snapshot, env_steps, **stats}."""
        rows = self.rows(
            "SELECT number, snapshot, env_steps, stats FROM iterations"
            " WHERE run = ? AND number > ? ORDER BY number",
            (run, after),
        )
        return [{"number": n, "snapshot": s, "env_steps": e, **json.loads(stats)} for n, s, e, stats in rows]

    def last_iteration(self, run: str) -> dict | None:
        """The newest iteration of a run, as ``iterations``; None if there is none."""
        rows = self.rows("SELECT MAX(number) FROM iterations WHERE run = ?", (run,))
        newest = rows[0][0]
        return self.iterations(run, after=newest - 1)[0] if newest is not None else None
