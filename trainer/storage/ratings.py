"""What raters said, in the database: append-only events, and the ratings that hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from onedemo.storage.database import Database, now
from onedemo.storage.rating_counts import Counting, Counts
from onedemo.storage.rating_records import (
    LOOKED_BACK,
    MOST_REASON,
    RATING_COLUMNS,
    AlreadyAnswered,
    Answered,
    Given,
    LastAnswer,
    Rating,
)


class Ratings:
    """Ratings, skips and undos, and who is left out of training."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._counting = Counting(database)

    def rate(
        self, clip_id: int, rater_id: int, value: int, latency_ms: int, *,
        mark: tuple[int, int] | None = None, repeat: bool = False,
    ) -> int:  # fmt: skip
        """Commits one rating and returns its event number.

        Args:
            clip_id: What is rated.
            rater_id: By whom.
            value: 1 to 5.
            latency_ms: From the clip on screen to the press.
            mark: Where it goes wrong: first control step of the clip, step after the last.
            repeat: It is the rater's second opinion, to see how steady the first one was: it is kept
                beside it, and nothing learns from it.

        Raises:
            AlreadyAnswered: If the rater's rating of this clip holds already.
            ValueError: If the value is not a whole number from 1 to 5, there is no such clip, or the mark
                is no stretch of its steps.
        """
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 5:
            raise ValueError(f"a rating is a whole number from 1 to 5, got {value!r}")
        return self._event(clip_id, rater_id, "rate", value, latency_ms, mark=mark, repeat=repeat)

    def skip(
        self, clip_id: int, rater_id: int, latency_ms: int, *, reason: str | None = None, repeat: bool = False
    ) -> int:
        """Commits that the rater would not rate this clip; returns the event number.

        The reason may follow later: a skip with a reason takes the place of one without.

        Raises:
            ValueError: As ``rate``; or the reason is longer than 200 characters.
        """
        if reason is not None and not 1 <= len(reason) <= MOST_REASON:
            raise ValueError(f"a reason is 1 to {MOST_REASON} characters, got {len(reason)}")
        return self._event(clip_id, rater_id, "skip", None, latency_ms, reason=reason, repeat=repeat)

    def undo(self, clip_id: int, rater_id: int, *, repeat: bool = False) -> int:
        """Takes a rater's rating or skip of a clip back; returns the event number.

        Raises:
            ValueError: If there is nothing to take back.
        """
        return self._event(clip_id, rater_id, "undo", None, 0, repeat=repeat)

    def withdraw(self, event: int, reason: str, *, by: int | None = None) -> Given:
        """Takes any one rating back, later and for its rater: nothing learns from it from now on.

        One more event, an undo with the reason. A clip that nobody else has answered is not asked again.

        Args:
            event: Number of the rating.
            reason: Why, 1 to 200 printable characters.
            by: The researcher; None: at the command line.

        Returns:
            The rating.

        Raises:
            ValueError: If there is no such rating, it does not hold any more, or the reason is none.
        """
        reason = reason.strip()
        if not 1 <= len(reason) <= MOST_REASON or not reason.isprintable():
            raise ValueError(f"a reason is one line of 1 to {MOST_REASON} characters")
        with self._database.transaction() as db:
            row = db.execute(
                "SELECT e.clip_id, e.rater_id, p.name, e.value, e.repeat, e.created_at, EXISTS ("
                "  SELECT 1 FROM events l WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id"
                "  AND l.repeat = e.repeat AND l.id > e.id)"
                " FROM events e JOIN raters p ON p.id = e.rater_id WHERE e.id = ? AND e.kind = 'rate'",
                (event,),
            ).fetchone()
            if row is None:
                raise ValueError(f"there is no rating {event}")
            clip, rater, name, value, repeat, created_at, over = row
            if over:
                raise ValueError(f"rating {event} does not hold any more: it was taken back before")
            db.execute(
                "INSERT INTO events (clip_id, rater_id, kind, repeat, withdrawn, by_id, snapshot, predicted,"
                " latency_ms, created_at) SELECT id, ?, 'undo', ?, ?, ?, snapshot, predicted, 0, ?"
                " FROM clips WHERE id = ?",
                (rater, repeat, reason, by, now(), clip),
            )
            db.execute("UPDATE clips SET state = 'withdrawn' WHERE id = ? AND answers = 0", (clip,))
        return Given(event, clip, name, value, bool(repeat), created_at, reason, None)

    def given(
        self, run: str, *, rater: str | None = None, before: int | None = None, most: int = 50,
        withdrawn: bool = False,
    ) -> list[Given]:  # fmt: skip
        """Ratings of a run that hold or were withdrawn, newest first.

        Args:
            run: Of which.
            rater: Name; None: of everybody.
            before: Those with smaller numbers alone.
            most: How many at most.
            withdrawn: Those that were withdrawn alone.
        """
        rows = self._database.rows(
            "SELECT e.id, e.clip_id, p.name, e.value, e.repeat, e.created_at, w.withdrawn, b.name"
            " FROM events e JOIN clips c ON c.id = e.clip_id JOIN raters p ON p.id = e.rater_id"
            " LEFT JOIN events w ON w.id = (SELECT MIN(l.id) FROM events l WHERE l.clip_id = e.clip_id"
            "  AND l.rater_id = e.rater_id AND l.repeat = e.repeat AND l.id > e.id)"
            " LEFT JOIN raters b ON b.id = w.by_id"
            " WHERE e.kind = 'rate' AND c.run = ?1 AND (?2 IS NULL OR p.name = ?2) AND e.id < ?3"
            " AND (w.withdrawn IS NOT NULL OR (w.id IS NULL AND NOT ?4)) ORDER BY e.id DESC LIMIT ?5",
            (run, rater, before if before is not None else 2**62, withdrawn, most),
        )
        return [Given._make((*row[:4], bool(row[4]), *row[5:])) for row in rows]

    def _event(
        self, clip_id: int, rater_id: int, kind: str, value: int | None, latency_ms: int, *,
        mark: tuple[int, int] | None = None, reason: str | None = None, repeat: bool = False,
    ) -> int:  # fmt: skip
        with self._database.transaction() as db:
            clip = db.execute(
                "SELECT c.snapshot, c.predicted, c.steps, (SELECT e.kind || (e.reason IS NOT NULL)"
                "  FROM events e WHERE e.clip_id = c.id AND e.rater_id = ?1 AND e.repeat = ?2"
                "  ORDER BY e.id DESC LIMIT 1)"
                " FROM clips c WHERE c.id = ?3",
                (rater_id, repeat, clip_id),
            ).fetchone()
            if clip is None:
                raise ValueError(f"no clip {clip_id}")
            snapshot, predicted, steps, last = clip
            holds = last is not None and not last.startswith("undo")
            if kind == "undo" and not holds:
                raise ValueError(f"clip {clip_id} has nothing to take back")
            if kind != "undo" and holds and not (reason is not None and last == "skip0"):
                raise AlreadyAnswered(f"clip {clip_id} is rated already by this rater")
            if mark is not None and not 0 <= mark[0] < mark[1] <= steps:
                raise ValueError(f"a mark is a stretch of the clip's {steps} steps, got {mark}")
            row = {
                "clip_id": clip_id, "rater_id": rater_id, "kind": kind, "value": value, "repeat": repeat,
                "mark_from": mark[0] if mark else None, "mark_to": mark[1] if mark else None,
                "reason": reason, "snapshot": snapshot, "predicted": predicted,
                "latency_ms": max(0, int(latency_ms)), "created_at": now(),
            }  # fmt: skip
            cursor = db.execute(
                f"INSERT INTO events ({', '.join(row)}) VALUES ({', '.join('?' * len(row))})",
                tuple(row.values()),
            )
            assert cursor.lastrowid is not None
            return cursor.lastrowid

    def leave_out(self, run: str, rater_id: int, *, by: int, left_out: bool = True) -> int:
        """Leaves a rater's ratings of a run out of training from now on, or takes them in again.

        Nothing is deleted. It is an event like a rating, so a snapshot's last event tells who was left out.

        Args:
            run: Of whose training.
            rater_id: Whose ratings.
            by: Who decides.
            left_out: False takes them in again.

        Returns:
            The event number.
        """
        with self._database.transaction() as db:
            cursor = db.execute(
                "INSERT INTO events (rater_id, kind, run, by_id, snapshot, latency_ms, created_at)"
                " VALUES (?, ?, ?, ?, 0, 0, ?)",
                (rater_id, "leave out" if left_out else "take in", run, by, now()),
            )
            assert cursor.lastrowid is not None
            return cursor.lastrowid

    def left_out(self, run: str) -> set[int]:
        """Raters whose ratings nothing in a run learns from at present."""
        rows = self._database.rows(
            "SELECT rater_id, kind FROM events WHERE clip_id IS NULL AND run = ? ORDER BY id", (run,)
        )
        return {rater for rater, kind in dict(rows).items() if kind == "leave out"}

    def holds(self, clip_id: int, rater_id: int, *, repeat: bool = False) -> bool:
        """Whether a rating or skip of a rater stands on a clip."""
        rows = self._database.rows(
            "SELECT kind FROM events WHERE clip_id = ? AND rater_id = ? AND repeat = ?"
            " ORDER BY id DESC LIMIT 1",
            (clip_id, rater_id, repeat),
        )
        return bool(rows) and rows[0][0] != "undo"

    def last_answer(self, run: str, rater_id: int) -> LastAnswer | None:
        """The rating or skip that a rater gave last in a run, of those that hold; None if there is none.

        Only among the rater's last 400 events, and only of clips that can be shown again: those of an import
        have no picture.
        """
        rows = self._database.rows(
            "SELECT e.clip_id, e.repeat, e.value, e.mark_from, e.mark_to FROM events e"
            " JOIN clips c ON c.id = e.clip_id"
            " WHERE e.rater_id = ?1 AND c.run = ?2 AND c.state = 'ready' AND e.kind IN ('rate', 'skip')"
            " AND e.id > COALESCE((SELECT id FROM events WHERE rater_id = ?1 ORDER BY id DESC LIMIT 1"
            f"  OFFSET {LOOKED_BACK}), 0) AND NOT EXISTS ("
            "  SELECT 1 FROM events l WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id"
            "  AND l.repeat = e.repeat AND l.id > e.id) ORDER BY e.id DESC LIMIT 1",
            (rater_id, run),
        )
        for clip, repeat, value, first, after in rows:
            return LastAnswer(clip, bool(repeat), value, _mark(first, after))
        return None

    def answered(self, run: str, most: int = 400, *, rater_id: int | None = None) -> list[Answered]:
        """The last word of each rater on each of the clips of a run that were answered last, newest first.

        Args:
            run: Of which.
            most: Events to look back.
            rater_id: Of this rater alone: then so many events of this one.
        """
        rows = self._database.rows(
            "SELECT e.clip_id, e.rater_id, e.kind, e.repeat FROM events e JOIN clips c ON c.id = e.clip_id"
            " WHERE c.run = ?1 AND (?2 IS NULL OR e.rater_id = ?2) ORDER BY e.id DESC LIMIT ?3",
            (run, rater_id, most),
        )
        last: dict[tuple, Answered] = {}
        for clip, rater, kind, repeat in rows:
            last.setdefault((clip, rater, repeat), Answered(clip, rater, kind, bool(repeat)))
        return list(last.values())

    def last_event(self) -> int:
        """Number of the newest event of all runs, 0 if there is none."""
        return self._database.rows("SELECT MAX(id) FROM events")[0][0] or 0

    def for_training(self, run: str, as_of: int | None = None) -> list[Rating]:
        """What was used for training as of event ``as_of`` (default: now): valid ratings of a run, in order.

        Not among them: second opinions, and ratings of raters who were left out.

        The same events give the same list, so a snapshot can be traced to its ratings and made again
        (``TrainingSet`` adds the segments).
        """
        limit = as_of if as_of is not None else 2**62
        rows = self._database.stream(
            "SELECT e.id, e.clip_id, c.demo_step, e.value, e.mark_from, e.mark_to"
            " FROM events e JOIN clips c ON c.id = e.clip_id"
            " WHERE c.run = ?1 AND e.kind = 'rate' AND e.repeat = 0 AND e.id <= ?2 AND NOT EXISTS ("
            "  SELECT 1 FROM events l WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id"
            "  AND l.repeat = 0 AND l.id > e.id AND l.id <= ?2) AND COALESCE(("
            "  SELECT o.kind FROM events o WHERE o.clip_id IS NULL AND o.run = ?1"
            "  AND o.rater_id = e.rater_id AND o.id <= ?2 ORDER BY o.id DESC LIMIT 1"
            " ), '') != 'leave out' ORDER BY e.id",
            (run, limit),
        )
        return [Rating(*row[:4], mark=_mark(*row[4:])) for row in rows]

    def by_class(self, run: str | None = None) -> list[int]:
        """How many ratings of 1, 2, 3, 4 and 5 hold, in one run or in all."""
        where, values = ("", ()) if run is None else ("WHERE run = ?", (run,))
        counts = dict(
            self._database.rows(f"SELECT value, SUM(ratings) FROM tallies {where} GROUP BY value", values)
        )
        return [counts.get(value, 0) for value in range(1, 6)]

    def count_for_training(self, run: str) -> int:
        """How many ratings of a run train the net: ``Counts.used``, without looking at every event."""
        left_out = self.left_out(run)
        rows = self._database.rows(
            "SELECT rater_id, SUM(ratings) FROM tallies WHERE run = ? GROUP BY rater_id", (run,)
        )
        return sum(ratings for rater, ratings in rows if rater not in left_out)

    def counts(self, run: str) -> dict[int, Counts]:
        """What each rater has given in a run, by number; ``sum(counts.values(), Counts())`` is all."""
        return self._counting.of(run, self.left_out(run))

    def tallies(self, run: str) -> dict[tuple[str, str], list[int]]:
        """Ratings of 1 to 5 that hold in a run, by (rater's name, stage), sorted by name, then time."""
        rows = self._database.rows(
            "SELECT name, stage, value, ratings FROM tallies JOIN raters ON raters.id = rater_id"
            " WHERE run = ? AND ratings > 0 ORDER BY name, stage = 'online', stage",
            (run,),
        )
        counts: dict[tuple[str, str], list[int]] = {}
        for name, stage, value, ratings in rows:
            counts.setdefault((name, stage), [0] * 5)[value - 1] = ratings
        return counts

    def stream(self, run: str | None = None, **only: str | int | Sequence[str] | None) -> Iterator[tuple]:
        """Rows of the view ``ratings`` in order of their number, streamed.

        Args:
            run: Of this run alone.
            only: Of these values of other columns alone, such as ``rater="Ann"`` or, of any of these,
                ``rater=["Ann", "Bob"]``; None: of any.
        """
        only = {"run": run, **only}
        unknown = set(only) - set(RATING_COLUMNS)
        if unknown:
            raise ValueError(f"ratings have no column {min(unknown)!r}")
        chosen = {
            name: [value] if isinstance(value, str | int) else list(value)
            for name, value in only.items()
            if value is not None
        }
        where = [f"{name} IN ({', '.join('?' * len(values))})" for name, values in chosen.items()]
        return self._database.stream(
            f"SELECT {', '.join(RATING_COLUMNS)} FROM ratings WHERE {' AND '.join(where) or '1'} ORDER BY id",
            tuple(value for values in chosen.values() for value in values),
        )

    def stream_skips(self, run: str | None = None) -> Iterator[tuple]:
        """The skips that hold, in order of their number, streamed: values of ``SKIP_COLUMNS``.

        A reason that was said afterwards takes the place of the skip; the time is that of the first press.
        """
        return self._database.stream(
            "SELECT e.id, e.clip_id, c.run, r.demo, p.name, e.reason, c.stage, c.iteration, e.created_at,"
            " MAX(e.latency_ms, CASE WHEN e.reason IS NULL THEN 0 ELSE COALESCE(("
            "  SELECT f.latency_ms FROM events f WHERE f.clip_id = e.clip_id AND f.rater_id = e.rater_id"
            "  AND f.repeat = e.repeat AND f.kind = 'skip' AND f.id < e.id ORDER BY f.id DESC LIMIT 1"
            " ), 0) END), c.demo_step, c.steps, e.repeat, e.snapshot, e.predicted"
            " FROM events e JOIN clips c ON c.id = e.clip_id JOIN runs r ON r.id = c.run"
            " JOIN raters p ON p.id = e.rater_id"
            " WHERE e.kind = 'skip' AND (?1 IS NULL OR c.run = ?1) AND NOT EXISTS ("
            "  SELECT 1 FROM events l WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id"
            "  AND l.repeat = e.repeat AND l.id > e.id) ORDER BY e.id",
            (run,),
        )

    def newest(self, run: str, most: int, columns: Sequence[str]) -> list[tuple]:
        """Columns of the view ``ratings``, or of events, of the newest ratings of a run, oldest first."""
        rows = self._database.rows(
            f"SELECT {', '.join(columns)} FROM ratings WHERE run = ? ORDER BY id DESC LIMIT ?", (run, most)
        )
        return rows[::-1]

    def stream_history(self, run: str | None = None) -> Iterator[tuple]:
        """What neither ``stream`` nor ``stream_skips`` gives: values of ``HISTORY_COLUMNS``, streamed.

        Undos and what they took back, skips whose reason came later, and who was left out of training.
        """
        return self._database.stream(
            "SELECT e.id, e.clip_id, NULL, COALESCE(e.run, c.run), p.name, e.kind, e.value, e.repeat,"
            " ROUND(e.mark_from * r.step_seconds, 6), ROUND(e.mark_to * r.step_seconds, 6), e.reason,"
            " e.snapshot, e.predicted, e.latency_ms, e.created_at, b.name, e.withdrawn"
            " FROM events e LEFT JOIN clips c ON c.id = e.clip_id"
            " JOIN runs r ON r.id = COALESCE(e.run, c.run) JOIN raters p ON p.id = e.rater_id"
            " LEFT JOIN raters b ON b.id = e.by_id"
            " WHERE (?1 IS NULL OR r.id = ?1) AND (e.kind NOT IN ('rate', 'skip') OR EXISTS ("
            "  SELECT 1 FROM events l WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id"
            "  AND l.repeat = e.repeat AND l.id > e.id)) ORDER BY e.id",
            (run,),
        )

    def restore(self, row: Mapping[str, Any]) -> None:
        """Stores an event of an export as it was: number, time and prediction.

        Args:
            row: Of the table ``events``, but "mark_start" and "mark_end" in seconds.
        """
        names = (
            "id", "clip_id", "rater_id", "kind", "value", "repeat", "reason", "snapshot", "predicted",
            "latency_ms", "run", "by_id", "created_at", "withdrawn",
        )  # fmt: skip
        with self._database.transaction() as db:
            db.execute(
                f"INSERT INTO events ({', '.join(names)}, mark_from, mark_to)"
                f" SELECT :{', :'.join(names)}, first, MIN(steps, MAX(first + 1, after))"
                " FROM (SELECT c.steps, MIN(c.steps - 1, ROUND(:mark_start / r.step_seconds)) AS first,"
                " ROUND(:mark_end / r.step_seconds) AS after"
                " FROM (SELECT 1) LEFT JOIN clips c ON c.id = :clip_id LEFT JOIN runs r ON r.id = c.run)",
                {name: row.get(name) for name in (*names, "mark_start", "mark_end")},
            )


def _mark(first: int | None, after: int | None) -> tuple[int, int] | None:
    return None if first is None or after is None else (first, after)
