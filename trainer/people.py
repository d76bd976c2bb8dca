"""People in the database, and the links that let them in."""

from __future__ import annotations

from trainer.database import Database, now
from trainer.errors import UserError
from trainer.records import Rater


class People(Database):
    """Raters and their tokens."""

    def ensure_rater(self, name: str, role: str) -> Rater:
        """The rater of that name, made if there is none.

        Raises:
            UserError: If the name belongs to a rater of another role.
        """
        with self.transaction() as db:
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
        rows = self.rows("SELECT id, name, role FROM raters ORDER BY id")
        return [Rater(id=i, name=n, role=r) for i, n, r in rows]

    def add_token(self, token_hash: str, rater_id: int, kind: str) -> None:
        """Lets a token stand for a rater; a token that is known already stays as it is.

        Args:
            token_hash: SHA-256 of the token, hex.
            rater_id: Whose it is.
            kind: "link" or "session".
        """
        with self.transaction() as db:
            db.execute(
                "INSERT OR IGNORE INTO tokens (hash, rater_id, kind, created_at) VALUES (?, ?, ?, ?)",
                (token_hash, rater_id, kind, now()),
            )

    def rater_of(self, token_hash: str, kind: str) -> Rater | None:
        """Whose token that is, or None if it is unknown or revoked."""
        rows = self.rows(
            "SELECT p.id, p.name, p.role FROM tokens t JOIN raters p ON p.id = t.rater_id"
            " WHERE t.hash = ? AND t.kind = ? AND t.revoked_at IS NULL",
            (token_hash, kind),
        )
        return Rater(id=rows[0][0], name=rows[0][1], role=rows[0][2]) if rows else None

    def count_revoked_links(self, rater_id: int) -> int:
        """How many links of a rater were ended."""
        return self.rows(
            "SELECT COUNT(*) FROM tokens WHERE rater_id = ? AND kind = 'link' AND revoked_at IS NOT NULL",
            (rater_id,),
        )[0][0]

    def revoke_tokens(self, rater_id: int) -> int:
        """Ends every link and session of a rater; returns how many."""
        with self.transaction() as db:
            return db.execute(
                "UPDATE tokens SET revoked_at = ? WHERE rater_id = ? AND revoked_at IS NULL",
                (now(), rater_id),
            ).rowcount

    def has_practised(self, rater_id: int) -> bool:
        """Whether a rater has done the practice clips, or rated before there were any."""
        return bool(
            self.rows(
                "SELECT 1 FROM raters WHERE id = ?1 AND (practised_at IS NOT NULL"
                " OR EXISTS (SELECT 1 FROM events WHERE rater_id = ?1 AND clip_id IS NOT NULL))",
                (rater_id,),
            )
        )

    def set_practised(self, rater_id: int) -> None:
        """Notes that a rater has done the practice clips."""
        with self.transaction() as db:
            db.execute("UPDATE raters SET practised_at = ? WHERE id = ?", (now(), rater_id))
