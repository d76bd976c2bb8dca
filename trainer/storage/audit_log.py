"""A log of sign-ins, downloads, and changes to what others see. Written to, never changed."""

from __future__ import annotations

from collections.abc import Iterator

from onedemo.storage.database import Database, now

AUDIT_COLUMNS = ("at", "who", "what", "detail")
_LONGEST = 500


class AuditLog:
    """The audit log in the database."""

    def __init__(self, database: Database) -> None:
        self._database = database

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

    def lines(self) -> Iterator[tuple[str, str, str, str]]:
        """All lines, oldest first: (at, who, what, detail), streamed."""
        yield from self._database.stream("SELECT at, who, what, detail FROM audit ORDER BY id", ())


def _line(text: str) -> str:
    # It is printed to a terminal: nothing in it may move the cursor or turn the direction of text.
    return "".join(c if c.isprintable() else "?" for c in text[:_LONGEST])
