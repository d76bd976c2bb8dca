"""Pairs in the database: two clips of the robot beside one moment of the demo, and which one is nearer.

The questions of learning from preferences (``trainer/baselines/preferences.py``). Answers are append-only
events, like ratings, in a table of their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from onedemo.storage.database import Database, now
from onedemo.storage.rating_records import LOOKED_BACK, MOST_REASON, AlreadyAnswered
from onedemo.storage.segment_codec import pack_segment, unpack_segment
from onedemo.types import Segment

ANSWERS = ("left", "right", "equal")
"""What may be said of a pair, besides skipping it."""
COMPARISON_COLUMNS = (
    "id", "pair_id", "run", "demo", "rater", "answer", "stage", "iteration", "created_at", "latency_ms",
    "demo_step", "steps",
)  # fmt: skip
"""Columns of the view ``answers``, in order."""


@dataclass(frozen=True, kw_only=True, slots=True)
class NewPair:
    """A pair that has no number yet."""

    demo_step: int
    left: Segment
    right: Segment
    stage: str
    iteration: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Pair:
    """Two clips of W control steps beside the demo from ``demo_step`` on."""

    id: int
    demo_step: int
    steps: int
    iteration: int


class Comparisons:
    """Pairs and what was said of them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add_pairs(self, run: str, pairs: Sequence[NewPair]) -> list[Pair]:
        """Stores pairs with their segments, all or none."""
        with self._database.transaction() as db:
            added = []
            for pair in pairs:
                cursor = db.execute(
                    "INSERT INTO pairs (run, demo_step, steps, stage, iteration, left_segment, right_segment,"
                    " created_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                    (run, pair.demo_step, len(pair.left), pair.stage, pair.iteration,
                     pack_segment(pair.left), pack_segment(pair.right), now()),
                )  # fmt: skip
                assert cursor.lastrowid is not None
                added.append(
                    Pair(
                        id=cursor.lastrowid, demo_step=pair.demo_step, steps=len(pair.left),
                        iteration=pair.iteration,
                    )
                )  # fmt: skip
            return added

    def set_pair_state(self, pair_ids: Sequence[int], state: str) -> None:
        """Moves pairs to "cut" (no picture yet), "ready" (may be shown) or "withdrawn" (too old)."""
        with self._database.transaction() as db:
            db.executemany("UPDATE pairs SET state = ? WHERE id = ?", [(state, i) for i in pair_ids])

    def waiting_pairs(self, run: str, state: str = "ready") -> list[Pair]:
        """Pairs in that state of which nobody has said anything that holds, oldest first."""
        rows = self._database.rows(
            "SELECT id, demo_step, steps, iteration FROM pairs p WHERE run = ? AND state = ? AND NOT EXISTS ("
            " SELECT 1 FROM comparisons c WHERE c.pair_id = p.id AND c.answer != 'undo' AND NOT EXISTS ("
            "  SELECT 1 FROM comparisons l WHERE l.pair_id = c.pair_id AND l.rater_id = c.rater_id"
            "  AND l.id > c.id)) ORDER BY id",
            (run, state),
        )
        return [Pair(id=i, demo_step=d, steps=s, iteration=k) for i, d, s, k in rows]

    def pair_run(self, pair_id: int) -> str | None:
        """The run of a pair; None if there is no such pair."""
        rows = self._database.rows("SELECT run FROM pairs WHERE id = ?", (pair_id,))
        return rows[0][0] if rows else None

    def pair_step(self, pair_id: int) -> int:
        """The demo step that a pair begins beside.

        Raises:
            KeyError: If there is no such pair.
        """
        rows = self._database.rows("SELECT demo_step FROM pairs WHERE id = ?", (pair_id,))
        if not rows:
            raise KeyError(f"no pair {pair_id}")
        return rows[0][0]

    def pair_segments(self, pair_id: int) -> tuple[Segment, Segment]:
        """Left and right of a pair.

        Raises:
            KeyError: If there is no such pair.
        """
        rows = self._database.rows("SELECT left_segment, right_segment FROM pairs WHERE id = ?", (pair_id,))
        if not rows:
            raise KeyError(f"no pair {pair_id}")
        return unpack_segment(rows[0][0]), unpack_segment(rows[0][1])

    def compare(
        self, pair_id: int, rater_id: int, answer: str, latency_ms: int, *, reason: str | None = None
    ) -> int:
        """Commits what a rater says of a pair and returns the event's number.

        Args:
            pair_id: The pair.
            rater_id: Who says it.
            answer: One of ``ANSWERS``, "skip", or "undo": takes back what the rater said of it.
            latency_ms: From the pair on screen to the press.
            reason: Of a skip, in the rater's words, 1 to ``MOST_REASON`` characters; it may be said of a skip
                that holds and has none.

        Raises:
            AlreadyAnswered: If the rater's answer holds already.
            ValueError: If it is no answer, there is no such pair, or there is none to take back.
        """
        if answer not in (*ANSWERS, "skip", "undo"):
            raise ValueError(f"a pair is {', '.join(ANSWERS)} or skipped, not {answer!r}")
        if reason is not None and not (answer == "skip" and 0 < len(reason) <= MOST_REASON):
            raise ValueError(f"a reason is of a skip and has 1 to {MOST_REASON} characters")
        with self._database.transaction() as db:
            rows = db.execute(
                "SELECT (SELECT answer || (reason IS NOT NULL) FROM comparisons"
                "  WHERE pair_id = p.id AND rater_id = ? ORDER BY id DESC LIMIT 1)"
                " FROM pairs p WHERE p.id = ?",
                (rater_id, pair_id),
            ).fetchall()
            if not rows:
                raise ValueError(f"no pair {pair_id}")
            last = rows[0][0]
            holds = last not in (None, "undo0")
            if holds and answer != "undo" and not (reason is not None and last == "skip0"):
                raise AlreadyAnswered(f"pair {pair_id} is answered already")
            if not holds and answer == "undo":
                raise ValueError("nothing to take back")
            cursor = db.execute(
                "INSERT INTO comparisons (pair_id, rater_id, answer, latency_ms, created_at, reason)"
                " VALUES (?, ?, ?, ?, ?, ?)",
                (pair_id, rater_id, answer, max(0, int(latency_ms)), now(), reason),
            )
            assert cursor.lastrowid is not None
            return cursor.lastrowid

    def last_compared(self, run: str, rater_id: int) -> tuple[int, str] | None:
        """The pair that a rater answered or skipped last in a run, of those that hold, with the answer.

        Only among the rater's last 400 answers.
        """
        rows = self._database.rows(
            "SELECT c.pair_id, c.answer FROM comparisons c JOIN pairs p ON p.id = c.pair_id"
            " WHERE c.rater_id = ?1 AND p.run = ?2 AND c.answer != 'undo'"
            " AND c.id > COALESCE((SELECT id FROM comparisons WHERE rater_id = ?1 ORDER BY id DESC LIMIT 1"
            f"  OFFSET {LOOKED_BACK}), 0) AND NOT EXISTS ("
            "  SELECT 1 FROM comparisons l WHERE l.pair_id = c.pair_id AND l.rater_id = c.rater_id"
            "  AND l.id > c.id) ORDER BY c.id DESC LIMIT 1",
            (rater_id, run),
        )
        return rows[0] if rows else None

    def count(self, run: str) -> int:
        """How many answers hold in a run."""
        return self._database.rows("SELECT COUNT(*) FROM answers WHERE run = ?", (run,))[0][0]

    def stream(self, run: str | None = None) -> Iterator[tuple]:
        """Rows of the view ``answers`` in order of their number, streamed."""
        return self._database.stream(
            f"SELECT {', '.join(COMPARISON_COLUMNS)} FROM answers WHERE ?1 IS NULL OR run = ?1 ORDER BY id",
            (run,),
        )

    def stream_history(self, run: str | None = None) -> Iterator[tuple]:
        """What ``stream`` does not give, as ``Ratings.stream_history``: skips, undos, what was taken back."""
        return self._database.stream(
            "SELECT c.id, NULL, c.pair_id, p.run, a.name, c.answer, NULL, 0, NULL, NULL, c.reason, NULL,"
            " NULL, c.latency_ms, c.created_at, NULL, NULL"
            " FROM comparisons c JOIN pairs p ON p.id = c.pair_id JOIN raters a ON a.id = c.rater_id"
            " WHERE (?1 IS NULL OR p.run = ?1) AND (c.answer IN ('skip', 'undo') OR EXISTS ("
            "  SELECT 1 FROM comparisons l WHERE l.pair_id = c.pair_id AND l.rater_id = c.rater_id"
            "  AND l.id > c.id)) ORDER BY c.id",
            (run,),
        )

    def compared(self, run: str | None = None) -> Iterator[tuple[int, str, NewPair]]:
        """Every pair of which anybody ever said anything: its number, run and content, streamed."""
        rows = self._database.stream(
            "SELECT id, run, demo_step, stage, iteration, left_segment, right_segment FROM pairs"
            " WHERE (?1 IS NULL OR run = ?1) AND id IN (SELECT pair_id FROM comparisons) ORDER BY id",
            (run,),
        )
        for number, of_run, step, stage, iteration, left, right in rows:
            pair = NewPair(
                demo_step=step, stage=stage, iteration=iteration, left=unpack_segment(left),
                right=unpack_segment(right),
            )  # fmt: skip
            yield number, of_run, pair

    def restore_pairs(self, pairs: Iterable[tuple[int, str, NewPair]]) -> dict[int, str]:
        """Stores pairs of an export under the numbers they had; nobody is asked them.

        Returns:
            The run of each, by its number.
        """
        numbers = {}
        with self._database.transaction() as db:
            for number, run, pair in pairs:
                db.execute(
                    "INSERT INTO pairs (id, run, demo_step, steps, stage, iteration, left_segment,"
                    " right_segment, state, created_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?, 'withdrawn', ?)",
                    (number, run, pair.demo_step, len(pair.left), pair.stage, pair.iteration,
                     pack_segment(pair.left), pack_segment(pair.right), now()),
                )  # fmt: skip
                numbers[number] = run
        return numbers

    def restore(self, row: Mapping[str, Any]) -> None:
        """Stores what was said of a pair as it was: a row of the table ``comparisons``."""
        names = ("id", "pair_id", "rater_id", "answer", "latency_ms", "created_at", "reason")
        with self._database.transaction() as db:
            db.execute(
                f"INSERT INTO comparisons ({', '.join(names)}) VALUES (:{', :'.join(names)})",
                {name: row.get(name) for name in names},
            )
