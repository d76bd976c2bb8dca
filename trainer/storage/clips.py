"""Clips in the database, and the segment behind each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from onedemo.storage.database import Database, now
from onedemo.storage.segment_codec import pack_segment, unpack_segment
from onedemo.types import Clip, Segment

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


class Clips:
    """Clips and their segments."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, run: str, clips: Sequence[NewClip]) -> list[Clip]:
        """Stores clips with the segments behind them, all or none."""
        with self._database.transaction() as db:
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

    def restore(self, clips: Iterable[tuple[Clip, Segment]]) -> dict[int, str]:
        """Stores clips of an export under the numbers they had; nobody is asked them.

        Returns:
            The run of each, by its number.
        """
        numbers = {}
        with self._database.transaction() as db:
            for clip, segment in clips:
                db.execute(
                    f"INSERT INTO clips ({_CLIP}, state, created_at)"
                    " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, 'withdrawn', ?)",
                    (*(getattr(clip, name) for name in _CLIP.split(", ")), now()),
                )
                db.execute("INSERT INTO segments VALUES (?, ?)", (clip.id, pack_segment(segment)))
                numbers[clip.id] = clip.run
        return numbers

    def answered(self, run: str | None = None) -> Iterator[tuple[Clip, Segment]]:
        """Every clip that anybody ever rated or skipped, with its segment, in order, streamed."""
        columns = ", ".join(f"c.{name}" for name in _CLIP.split(", "))
        rows = self._database.stream(
            f"SELECT {columns}, s.data FROM clips c JOIN segments s ON s.clip_id = c.id"
            " WHERE (?1 IS NULL OR c.run = ?1) AND c.id IN (SELECT clip_id FROM events) ORDER BY c.id",
            (run,),
        )
        for *values, data in rows:
            clip = Clip(**dict(zip(_CLIP.split(", "), values, strict=True)))
            yield clip, unpack_segment(data)

    def set_state(self, clip_ids: Sequence[int], state: str) -> None:
        """Moves clips to "cut" (no picture yet), "ready" (may be shown) or "withdrawn" (too old)."""
        with self._database.transaction() as db:
            db.executemany("UPDATE clips SET state = ? WHERE id = ?", [(state, i) for i in clip_ids])

    def set_predictions(self, snapshot: int, predicted: dict[int, float]) -> None:
        """Notes what a newer snapshot predicts for clips that wait to be rated."""
        with self._database.transaction() as db:
            db.executemany(
                "UPDATE clips SET snapshot = ?, predicted = ? WHERE id = ?",
                [(snapshot, value, clip) for clip, value in predicted.items()],
            )

    def get(self, clip_id: int) -> Clip | None:
        """One clip, or None if there is none of that number."""
        rows = self._database.rows(f"SELECT {_CLIP} FROM clips WHERE id = ?", (clip_id,))
        return Clip(**dict(zip(_CLIP.split(", "), rows[0], strict=True))) if rows else None

    def waiting(self, run: str, state: str = "ready") -> list[Clip]:
        """Clips in that state that nobody has rated or skipped, oldest first."""
        rows = self._database.rows(
            f"SELECT {_CLIP} FROM clips WHERE run = ? AND state = ? AND answers = 0 ORDER BY id",
            (run, state),
        )
        return [Clip(**dict(zip(_CLIP.split(", "), row, strict=True))) for row in rows]

    def count(self, run: str) -> int:
        """How many clips were ever cut in a run."""
        rows = self._database.rows("SELECT clips FROM runs WHERE id = ?", (run,))
        return rows[0][0] if rows else 0

    def segment(self, clip_id: int) -> Segment:
        """The states and actions behind a clip.

        Raises:
            KeyError: If there is no such clip.
        """
        rows = self._database.rows("SELECT data FROM segments WHERE clip_id = ?", (clip_id,))
        if not rows:
            raise KeyError(f"no clip {clip_id}")
        return unpack_segment(rows[0][0])
