"""The SQLite file: opening, transactions, reading.

One connection, one lock: every call is short, whatever the number of ratings; what reads all of them
does so over a connection of its own. A write returns after ``COMMIT`` with
``synchronous=FULL``, so what it acknowledged survives the death of the process and of the machine.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from onedemo.errors import UserError
from onedemo.storage.schema import check_version, migrate

FILE_NAME = "onedemo.sqlite3"


class Database:
    """The database in ``data_dir``; made or migrated when opened.

    Safe to use from many threads. Close it when done.

    Raises:
        UserError: If the directory is not writable, the file is not a database, or it is newer than this
            program or older than the first release.
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
            raise UserError(f"{self.path} was {error}") from None
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

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Everything inside is committed, or nothing if it raises; one inside another is part of it."""
        with self._lock:
            if self._db.in_transaction:
                yield self._db
                return
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
            except BaseException:
                if self._db.in_transaction:  # SQLite ends it by itself on a full disk, say
                    self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def rows(self, sql: str, values: Sequence | Mapping[str, object] = ()) -> list[tuple]:
        """All rows of a short query."""
        with self._lock:
            return self._db.execute(sql, values).fetchall()

    def stream(self, sql: str, values: Sequence) -> Iterator[tuple]:
        """Rows one by one, over a read-only connection of their own: no press waits for them."""
        db = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro", uri=True, timeout=10)
        try:
            yield from db.execute(sql, values)
        finally:
            db.close()


def now() -> str:
    """The time as the database keeps it: UTC, ISO 8601, milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
