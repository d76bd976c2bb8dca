"""How many ratings there are: one definition of each count, for every place that tells one."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from onedemo.storage.database import Database


@dataclass(frozen=True, kw_only=True, slots=True)
class Counts:
    """How many answers there are, of one rater or of all: the one definition, for every place that tells.

    Each rating that holds is in one of three parts: ``given == used + repeats + excluded``. What was taken
    back by its rater is in none, nor is what was withdrawn.
    """

    classes: tuple[int, ...] = (0, 0, 0, 0, 0)
    """Ratings of 1, 2, 3, 4 and 5 that are used for training."""
    repeats: int = 0
    """Second opinions of a rater on a clip: kept to see how steady raters are, never learned from."""
    excluded: int = 0
    """First opinions of raters who are excluded from training."""
    skipped: int = 0
    """Clips that were skipped."""
    withdrawn: int = 0
    """Ratings that a researcher withdrew."""

    @property
    def used(self) -> int:
        """Ratings that are used for training: what targets are about."""
        return sum(self.classes)

    @property
    def given(self) -> int:
        """All ratings that hold: the rows of a CSV."""
        return self.used + self.repeats + self.excluded

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            classes=tuple(map(sum, zip(self.classes, other.classes, strict=True))),
            repeats=self.repeats + other.repeats, excluded=self.excluded + other.excluded,
            skipped=self.skipped + other.skipped, withdrawn=self.withdrawn + other.withdrawn,
        )  # fmt: skip


class Counting:
    """Counts the answers in a database; the first time in a run costs more than later ones."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._others: dict[str, tuple[int, dict[int, tuple[int, ...]]]] = {}

    def of(self, run: str, excluded: Collection[int]) -> dict[int, Counts]:
        """What each rater has given in a run, by number.

        Args:
            run: Which.
            excluded: Raters whose ratings nothing learns from.
        """
        first: dict[int, list[int]] = {}
        for rater, value, ratings in self._database.rows(
            "SELECT rater_id, value, SUM(ratings) FROM tallies WHERE run = ? GROUP BY rater_id, value", (run,)
        ):
            first.setdefault(rater, [0] * 5)[value - 1] = ratings
        others = self._not_tallied(run)
        counts = {}
        for rater in sorted({*first, *others}):
            classes, out = first.get(rater, [0] * 5), rater in excluded
            repeats, skipped, withdrawn = others.get(rater, (0, 0, 0))
            counts[rater] = Counts(
                classes=(0,) * 5 if out else tuple(classes), excluded=sum(classes) if out else 0,
                repeats=repeats, skipped=skipped, withdrawn=withdrawn,
            )  # fmt: skip
        return counts

    def _not_tallied(self, run: str) -> dict[int, tuple[int, ...]]:
        """Repeats, skips and withdrawn ratings by rater. Events stay, so new ones are added to what was."""
        seen, found = self._others.get(run, (0, {}))
        newest = self._database.rows("SELECT MAX(id) FROM events")[0][0] or 0
        if newest > seen:
            # An event counts, and the one whose place it takes no longer does.
            rows = self._database.rows(
                "SELECT e.rater_id, SUM(e.repeat * ((e.kind = 'rate') - COALESCE(p.kind = 'rate', 0))),"
                " SUM((e.kind = 'skip') - COALESCE(p.kind = 'skip', 0)), COUNT(e.withdrawn)"
                " FROM events e JOIN clips c ON c.id = e.clip_id LEFT JOIN events p ON p.id = ("
                "  SELECT MAX(b.id) FROM events b WHERE b.clip_id = e.clip_id AND b.rater_id = e.rater_id"
                "  AND b.repeat = e.repeat AND b.id < e.id)"
                " WHERE e.id > ?2 AND e.id <= ?3 AND c.run = ?1 GROUP BY e.rater_id",
                (run, seen, newest),
            )
            found = dict(found)
            for rater, *more in rows:
                found[rater] = tuple(map(sum, zip(found.get(rater, (0, 0, 0)), more, strict=True)))
            self._others[run] = newest, found
        return found
