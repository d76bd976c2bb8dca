"""A log of sign-ins, downloads, and changes to what others see. Written to, never changed."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator

from onedemo.storage.database import Database, now

AUDIT_COLUMNS = ("at", "who", "what", "detail")
_LONGEST = 500
_WINDOW_S = 600.0
"""What is noted again within this time is counted."""
_MOST_DIFFERENT = 20
"""Details of what one person does, or addresses of strangers, that get a line of their own in that time."""


class AuditLog:
    """The audit log in the database.

    Args:
        database: Where it is.
        clock: Seconds that only go forward.
    """

    def __init__(self, database: Database, clock: Callable[[], float] = time.monotonic) -> None:
        self._database, self._clock = database, clock
        self._lock = threading.Lock()
        self._began: dict[tuple[str, str, str], float] = {}
        """When each line was written that is counted from then on, oldest first."""
        self._more: Counter[tuple[str, str, str]] = Counter()

    def add(self, who: str, what: str, detail: str = "") -> None:
        """Writes one line.

        Args:
            who: Name of a rater, "command line", or the address of a stranger.
            what: What was done, in the past tense.
            detail: To whom or what; one line, cut after 500 characters.
        """
        with self._database.transaction() as db:
            db.execute(
                "INSERT INTO audit (at, who, what, detail) VALUES (?, ?, ?, ?)",
                (now(), _line(who), what, _line(detail)),
            )

    def note(self, who: str, what: str, detail: str = "", *, stranger: bool = False) -> None:
        """Writes one line of something that may be repeated at will, such as a sign-in.

        The same again within ten minutes is counted, and one line tells how often. Whatever is beyond
        twenty different details of a person, or twenty strangers, shares a line.

        Args:
            who: As in ``add``.
            what: As in ``add``.
            detail: As in ``add``.
            stranger: Whether ``who`` is an address: of those there is no end.
        """
        with self._lock:
            self._finish(self._clock() - _WINDOW_S)
            line = (who, what, detail)
            if line not in self._began:
                alike = sum(w == what and (stranger or p == who) for p, w, _ in self._began)
                if alike >= _MOST_DIFFERENT:
                    line = ("other addresses" if stranger else who, what, "in other ways")
            if line in self._began:
                self._more[line] += 1
                return
            self._began[line] = self._clock()
        self.add(*line)

    def finish(self, *, everything: bool = False) -> None:
        """Writes how often was repeated what was counted for ten minutes, or whatever is counted now."""
        with self._lock:
            self._finish(float("inf") if everything else self._clock() - _WINDOW_S)

    def lines(self) -> Iterator[tuple[str, str, str, str]]:
        """All lines, oldest first: (at, who, what, detail), streamed."""
        yield from self._database.stream("SELECT at, who, what, detail FROM audit ORDER BY id", ())

    def _finish(self, until: float) -> None:
        while self._began and self._began[line := next(iter(self._began))] <= until:
            if more := self._more.get(line):
                who, what, detail = line
                self.add(who, what, f"{detail[: _LONGEST - 50]}{detail and ', '}{more} more in ten minutes")
            del self._began[line]
            self._more.pop(line, None)


def _line(text: str) -> str:
    # It is printed to a terminal: nothing in it may move the cursor or turn the direction of text.
    return "".join(c if c.isprintable() else "?" for c in text[:_LONGEST])
