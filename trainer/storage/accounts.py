"""People in the database, and the links and sessions that let them in.

Only hashes of tokens are kept: who reads the database cannot come in with what it holds.
"""

from __future__ import annotations

import sqlite3
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal, NamedTuple

from onedemo.errors import UserError
from onedemo.storage.database import Database, now
from onedemo.types import Rater

SESSION_DAYS = 30
"""How long a cookie lets in."""
MOST_SESSIONS = 100
"""Of one link. A program that opens its link each time makes many; those longest unused end first."""
_ENDED_DAYS = 7
"""How long it is still known why a session ended."""
_MOST_USED = 10_000
"""Sessions of which it is remembered when they were used: those that were used last."""

# A time is compared as text: all are UTC in one form (onedemo.storage.database.now).
_STATE = (
    "CASE WHEN t.revoked_at IS NOT NULL THEN 'revoked' WHEN t.once AND t.last_used_at IS NOT NULL THEN 'used'"
    " WHEN t.expires_at <= :now THEN 'expired' ELSE 'open' END"
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Link:
    """A link that was given to somebody; the token in it is known to nobody but them."""

    id: int
    rater: Rater
    once: bool
    """It opens once."""
    state: Literal["open", "used", "expired", "revoked"]
    created_at: str
    expires_at: str | None
    last_used_at: str | None


class Presence(NamedTuple):
    """Whether somebody is about."""

    browsers: int
    """Sessions that hold."""
    last_seen: str | None
    """When a page of theirs was last open, or they last answered; None: never."""


_LINK = f"t.id, p.id, p.name, p.role, t.once, {_STATE}, t.created_at, t.expires_at, t.last_used_at"


class Accounts:
    """Raters, their tokens, and who has practised."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._used: dict[str, str] = {}
        """When each session was last seen in use, by its hash, in that order."""
        self._using = threading.Lock()

    def ensure(self, name: str, role: str) -> Rater:
        """The rater of that name, made if there is none.

        Raises:
            UserError: If the name belongs to a rater of another role.
        """
        with self._database.transaction() as db:
            db.execute(
                "INSERT OR IGNORE INTO raters (name, role, created_at) VALUES (?, ?, ?)",
                (name, role, now()),
            )
            row = db.execute("SELECT id, name, role FROM raters WHERE name = ?", (name,)).fetchone()
        rater = Rater(id=row[0], name=row[1], role=row[2])
        if rater.role != role:
            raise UserError(f"rater {name!r} exists already as {rater.role}; choose another name")
        return rater

    def raters(self) -> list[Rater]:
        """Everybody, in the order they were added."""
        rows = self._database.rows("SELECT id, name, role FROM raters ORDER BY id")
        return [Rater(id=i, name=n, role=r) for i, n, r in rows]

    # Links and sessions

    def add_token(
        self, token_hash: str, rater_id: int, kind: Literal["link", "session"], *,
        lasts: timedelta | None = None, once: bool = False, link_id: int | None = None,
    ) -> int:  # fmt: skip
        """Lets a token stand for a rater and returns its number; one that is known stays as it is.

        Args:
            token_hash: SHA-256 of the token, hex.
            rater_id: Whose it is.
            kind: What it is.
            lasts: Until it expires; None: it does not.
            once: Whether a link opens once.
            link_id: By which link a session came.
        """
        with self._database.transaction() as db:
            db.execute(
                "INSERT OR IGNORE INTO tokens (hash, rater_id, kind, link_id, once, created_at, expires_at)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                (token_hash, rater_id, kind, link_id, once, now(), _in(lasts)),
            )
            return db.execute("SELECT id FROM tokens WHERE hash = ?", (token_hash,)).fetchone()[0]

    def rater_of(self, token_hash: str, kind: Literal["link", "session"]) -> Rater | None:
        """Whose token that is, or None if it is unknown, revoked, expired or used up."""
        rows = self._database.rows(
            "SELECT p.id, p.name, p.role FROM tokens t JOIN raters p ON p.id = t.rater_id"
            f" WHERE t.hash = :hash AND t.kind = :kind AND {_STATE} = 'open'",
            {"hash": token_hash, "kind": kind, "now": now()},
        )
        return Rater(id=rows[0][0], name=rows[0][1], role=rows[0][2]) if rows else None

    def link(self, token_hash: str) -> Link | None:
        """The link of that token, whatever has become of it; None if there never was one."""
        return next(iter(self._links("t.hash = :hash", {"hash": token_hash})), None)

    def links(self) -> list[Link]:
        """All links there ever were, in the order they were made."""
        return self._links("TRUE", {})

    def open_link(
        self, token_hash: str, session_hash: str, wanted: Callable[[], bool] = lambda: True
    ) -> Link | None:
        """Trades a link for a session; None if it does not open (any more). Of two at once, one may win.

        A session that there is already lasts 30 days from now on.

        Args:
            token_hash: Of the link.
            session_hash: Of the session's token, which lasts 30 days.
            wanted: Asked at the very end, as the database may have been waited for: whether somebody will
                get the session. If not, the link stays as it was.

        Raises:
            TimeoutError: If it is not wanted any more.
        """
        with self._database.transaction() as db:
            link = self.link(token_hash)
            if link is None or link.state != "open":
                return None
            db.execute("UPDATE tokens SET last_used_at = ? WHERE id = ?", (now(), link.id))
            lasts = timedelta(days=SESSION_DAYS)
            session = self.add_token(session_hash, link.rater.id, "session", lasts=lasts, link_id=link.id)
            db.execute(
                "UPDATE tokens SET expires_at = ?, last_used_at = ? WHERE id = ?",
                (_in(lasts), now(), session),
            )
            self._purge(db, link)
            if not wanted():
                raise TimeoutError("nobody waits for the session any more")
        return link

    def _purge(self, db: sqlite3.Connection, link: Link) -> None:
        """Forgets sessions that ended long ago, and those of a link that are too many."""
        db.execute(
            "DELETE FROM tokens WHERE kind = 'session'"
            " AND MIN(expires_at, COALESCE(revoked_at, expires_at)) <= ?",
            (_in(-timedelta(days=_ENDED_DAYS)),),
        )
        rows = db.execute(
            "SELECT id, hash, last_used_at FROM tokens"
            " WHERE rater_id = ? AND kind = 'session' AND link_id = ? ORDER BY id",
            (link.rater.id, link.id),
        ).fetchall()
        if len(rows) > MOST_SESSIONS:
            rows.sort(key=lambda row: max(self._used.get(row[1], ""), row[2] or ""))
            db.executemany("DELETE FROM tokens WHERE id = ?", [row[:1] for row in rows[:-MOST_SESSIONS]])

    def session_state(self, session_hash: str) -> Literal["open", "expired", "revoked"] | None:
        """What has become of a session; None if it is not known, such as one that was signed out."""
        rows = self._database.rows(
            f"SELECT {_STATE} FROM tokens t WHERE t.hash = :hash AND t.kind = 'session'",
            {"hash": session_hash, "now": now()},
        )
        return rows[0][0] if rows else None

    def end_session(self, session_hash: str) -> None:
        """Forgets a session: its person signed out."""
        with self._database.transaction() as db:
            db.execute("DELETE FROM tokens WHERE hash = ? AND kind = 'session'", (session_hash,))

    def note_use(self, session_hashes: Iterable[str]) -> None:
        """Notes that these sessions are in use, so that others of their links end before them.

        That is kept in memory alone: pages come back within seconds of a restart.
        """
        at = now()
        with self._using:
            for session in session_hashes:
                self._used.pop(session, None)
                self._used[session] = at
            while len(self._used) > _MOST_USED:
                del self._used[next(iter(self._used))]

    def presence(self) -> dict[int, Presence]:
        """How many sessions each rater has, and when they were last seen, by the rater's number."""
        sessions = self._database.rows(
            f"SELECT t.rater_id, t.hash, t.last_used_at, {_STATE} = 'open' FROM tokens t"
            " WHERE t.kind = 'session'",
            {"now": now()},
        )
        answers = self._database.rows(
            "SELECT id, (SELECT created_at FROM events WHERE rater_id = raters.id ORDER BY id DESC LIMIT 1)"
            " FROM raters"
        )
        browsers, seen = Counter[int](), {rater: at or "" for rater, at in answers}
        for rater, session, used, holds in sessions:
            browsers[rater] += holds
            seen[rater] = max(seen[rater], used or "", self._used.get(session, ""))
        return {rater: Presence(browsers[rater], at or None) for rater, at in seen.items()}

    def link_of_session(self, session_hash: str) -> int | None:
        """The number of the link by which a session that holds came, if that is known."""
        rows = self._database.rows(
            f"SELECT t.link_id FROM tokens t WHERE t.hash = :hash AND {_STATE} = 'open'",
            {"hash": session_hash, "now": now()},
        )
        return rows[0][0] if rows else None

    def ended_sessions(self, session_hashes: set[str]) -> set[str]:
        """Which of these sessions do not hold any more."""
        hashes = sorted(session_hashes)
        open_ones: set[str] = set()
        for start in range(0, len(hashes), 500):  # SQLite takes a limited number of values
            some = {f"h{number}": value for number, value in enumerate(hashes[start : start + 500])}
            places = ", ".join(f":{name}" for name in some)
            query = (
                "SELECT t.hash FROM tokens t"
                f" WHERE t.hash IN ({places}) AND t.kind = 'session' AND {_STATE} = 'open'"
            )
            open_ones |= {row[0] for row in self._database.rows(query, some | {"now": now()})}
        return session_hashes - open_ones

    def count_revoked_links(self, rater_id: int) -> int:
        """How many standing links of a rater were revoked: those that neither expire nor open once."""
        return self._database.rows(
            "SELECT COUNT(*) FROM tokens WHERE rater_id = ? AND kind = 'link' AND revoked_at IS NOT NULL"
            " AND NOT once AND expires_at IS NULL",
            (rater_id,),
        )[0][0]

    def revoke_tokens(self, rater_id: int) -> int:
        """Ends every link and session of a rater; returns how many."""
        with self._database.transaction() as db:
            return db.execute(
                "UPDATE tokens SET revoked_at = ? WHERE rater_id = ? AND revoked_at IS NULL",
                (now(), rater_id),
            ).rowcount

    def revoke_link(self, link_id: int) -> Link:
        """Ends one link and the sessions that came by it, or by an unknown one of the same rater.

        Raises:
            UserError: If there is no such link.
        """
        with self._database.transaction() as db:
            link = next(iter(self._links("t.id = :id", {"id": link_id})), None)
            if link is None:
                raise UserError(f"there is no link {link_id}; see `onedemo rater links`")
            db.execute(
                "UPDATE tokens SET revoked_at = :now WHERE revoked_at IS NULL AND (id = :id OR link_id = :id"
                " OR (kind = 'session' AND link_id IS NULL AND rater_id = :rater))",
                {"now": now(), "id": link_id, "rater": link.rater.id},
            )
        return link

    def _links(self, where: str, values: dict) -> list[Link]:
        rows = self._database.rows(
            f"SELECT {_LINK} FROM tokens t JOIN raters p ON p.id = t.rater_id"
            f" WHERE t.kind = 'link' AND {where} ORDER BY t.id",
            values | {"now": now()},
        )
        return [
            Link(
                id=number, rater=Rater(id=rater, name=name, role=role), once=bool(once), state=state,
                created_at=created, expires_at=expires, last_used_at=used,
            )
            for number, rater, name, role, once, state, created, expires, used in rows
        ]  # fmt: skip

    # Practice

    def has_practised(self, rater_id: int) -> bool:
        """Whether a rater has done the practice clips, or rated before practice existed."""
        return bool(
            self._database.rows(
                "SELECT 1 FROM raters WHERE id = ?1 AND (practised_at IS NOT NULL"
                " OR EXISTS (SELECT 1 FROM events WHERE rater_id = ?1 AND clip_id IS NOT NULL))",
                (rater_id,),
            )
        )

    def set_practised(self, rater_id: int) -> None:
        """Notes that a rater has done the practice clips."""
        with self._database.transaction() as db:
            db.execute("UPDATE raters SET practised_at = ? WHERE id = ?", (now(), rater_id))


def _in(lasts: timedelta | None) -> str | None:
    if lasts is None:
        return None
    return (datetime.now(UTC) + lasts).isoformat(timespec="milliseconds").replace("+00:00", "Z")
