"""The SQLite file: opening, transactions, reading.

One connection writes and another reads, each with a lock: every call is short, whatever the number of
ratings, and nobody who reads waits for somebody who writes, here or in another program. What reads all
ratings does so over a connection of its own. A write returns after ``COMMIT`` with
``synchronous=FULL``, so what it acknowledged survives the death of the process and of the machine.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from onedemo.core.directories import make_directory
from onedemo.core.files import private_opener
from onedemo.core.shared_disks import is_shared, refuse_if_elsewhere
from onedemo.errors import DatabaseLost, UserError
from onedemo.storage.schema import check_version, migrate

log = logging.getLogger("onedemo")

FILE_NAME = "onedemo.sqlite3"
_MAKING = threading.Lock()
_WAIT_S = 10.0
"""How long a write waits for another one to end."""
_LOOK_S = 0.5
"""How often a process that writes looks whether its files are still there."""


def rescued_files(data_dir: Path) -> list[Path]:
    """What servers saved that had their database taken away while they had it open, oldest first."""
    return sorted(data_dir.glob(f"{FILE_NAME}.rescued-*"), key=lambda file: file.stat().st_mtime)


class Database:
    """The database in ``data_dir``; made or migrated when opened.

    Safe to use from many threads. Close it when done.

    Raises:
        UserError: If the directory is not writable, the file is not a database, or it is newer than this
            program or older than the first release; or if it is missing and there are runs.
    """

    def __init__(self, data_dir: Path) -> None:
        self.path = Path(data_dir) / FILE_NAME
        self.fault = ""
        """Why nothing can be written any more, in a sentence; "" if it can."""
        self._lock, self._reading = threading.RLock(), threading.Lock()
        self._writing: int | None = None  # the thread inside a transaction
        self._closed, self._watch = threading.Event(), None
        try:
            make_directory(self.path.parent, private=True)
            if is_shared(self.path.parent):
                refuse_if_elsewhere(*self.path.parent.glob("runs/*/lock"))
            self._make()
            self._db = self._connect()
        except (OSError, sqlite3.Error) as error:
            raise UserError(
                f"the data directory {data_dir} is not writable ({error}); choose another with --data-dir"
            ) from None
        try:
            check_version(self._db)  # before anything is written
            _patiently(self._db, "PRAGMA journal_mode = WAL")
            self._db.execute("PRAGMA synchronous = FULL")
            self._db.execute("PRAGMA foreign_keys = ON")
            migrate(self._db)
            self._reader = self._connect()
            self._reader.execute("PRAGMA query_only = ON")
            _patiently(self._reader, "SELECT 1 FROM sqlite_master")
        except ValueError as error:
            self._db.close()
            raise UserError(f"{self.path} was {error}") from None
        except sqlite3.DatabaseError as error:
            self._db.close()
            raise UserError(
                f"{self.path} cannot be opened for writing ({error}); "
                "check its permissions or choose another --data-dir"
            ) from None
        self._files = self._there() or (None, None, None)

    def close(self) -> None:
        """Closes the connections; the store cannot be used afterwards."""
        self._closed.set()
        with self._lock, self._reading:
            self._reader.close()
            self._db.close()

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Everything inside is committed, or nothing if it raises; one inside another is part of it.

        Raises:
            DatabaseLost: If the database's files are not those that were opened: nothing more is written.
            sqlite3.OperationalError: If another program holds the database for too long, say.
        """
        with self._lock:
            if self._db.in_transaction:
                yield self._db
                return
            self._check()
            self._db.execute("BEGIN IMMEDIATE")
            self._writing = threading.get_ident()
            try:
                yield self._db
            except BaseException:
                if self._db.in_transaction:  # SQLite ends it by itself on a full disk, say
                    self._db.execute("ROLLBACK")
                raise
            finally:
                self._writing = None
            self._db.execute("COMMIT")
            self._check()  # what was written into a file that is gone is not acknowledged
            if self._watch is None:
                self._watch = threading.Thread(target=self._look, name="database-watch", daemon=True)
                self._watch.start()

    def rows(self, sql: str, values: Sequence | Mapping[str, object] = ()) -> list[tuple]:
        """All rows of a short query; inside a transaction of this thread, as it is so far."""
        if self._writing == threading.get_ident():
            return self._db.execute(sql, values).fetchall()
        with self._reading:
            return self._reader.execute(sql, values).fetchall()

    def stream(self, sql: str, values: Sequence) -> Iterator[tuple]:
        """Rows one by one, over a read-only connection of their own: no press waits for them.

        Raises:
            DatabaseLost: As ``transaction``.
        """
        if self.fault:
            raise DatabaseLost(self.fault)
        db = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro", uri=True, timeout=_WAIT_S)
        try:
            yield from db.execute(sql, values)
        finally:
            db.close()

    # The files

    def _connect(self) -> sqlite3.Connection:
        return sqlite3.connect(self.path, isolation_level=None, check_same_thread=False, timeout=_WAIT_S)

    def _make(self) -> None:
        """An empty file for its owner alone, which SQLite would let others read, if there is none."""
        # To close a file of a database lets go of all locks that this process has on it (POSIX): not while
        # another thread opens it.
        with _MAKING:
            if not self.path.exists():
                self._check_new()
                with suppress(FileExistsError):
                    open(self.path, "xb", opener=private_opener).close()

    def _check_new(self) -> None:
        lost = [path.parent for path in self.path.parent.glob("runs/*/config.toml")]
        if lost:
            saved = rescued_files(self.path.parent)
            raise UserError(
                f"{self.path} is missing, but {lost[0]} is there, a run that it knew: "
                + (f"mv {saved[-1]} {self.path}, which a server saved, or " if saved else "")
                + "restore a backup into another directory, or move the directory runs away to begin anew"
            )

    def _there(self) -> tuple[tuple[int, int] | None, ...] | None:
        """Which files lie where the database, its log and the index of that should be.

        None if that cannot be told, since the right to look is gone, say.
        """
        try:
            return tuple(_identity(f"{self.path}{suffix}") for suffix in ("", "-wal", "-shm"))
        except OSError:
            return None

    def _check(self) -> None:
        """Raises DatabaseLost from the moment on when one of the files is another, or none."""
        if not self.fault and (there := self._there()) != self._files and there is not None:
            names = [
                f"{FILE_NAME}{suffix}"
                for suffix, was, now_ in zip(("", "-wal", "-shm"), self._files, there, strict=True)
                if was != now_
            ]
            lost = f"{' and '.join(names)} in {self.path.parent} was deleted or replaced"
            self.fault = f"{lost}. Nothing more is saved. {self._rescue(there)}"
            log.error("%s", self.fault)
        if self.fault:
            raise DatabaseLost(self.fault)

    def _rescue(self, there: tuple[tuple[int, int] | None, ...]) -> str:
        """Saves what this process still has open; says where it is, and what to do."""
        place = next(
            path for n in range(1, 1000)
            if not (path := self.path.with_name(f"{FILE_NAME}.rescued-{n}")).exists()
        )  # fmt: skip
        try:
            open(place, "xb", opener=private_opener).close()
            with closing(sqlite3.connect(place, isolation_level=None)) as saved:
                self._db.backup(saved)
                saved.execute("PRAGMA journal_mode = DELETE")
                if saved.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",):
                    return (
                        f"What could be saved is in {place}, and is damaged: stop onedemo, restore a backup."
                    )
            if there[0] == self._files[0] and there[1] is None:  # nobody else has begun another log
                self._db.execute("PRAGMA wal_checkpoint")
        except (sqlite3.Error, OSError) as error:
            return f"It could not be saved to {place} ({error}): stop onedemo and restore a backup."
        return (
            f"Every rating until then is in {place}: stop onedemo, put that file in the place of "
            f"{FILE_NAME}, remove {FILE_NAME}-wal and {FILE_NAME}-shm, and start it again."
        )

    def _look(self) -> None:
        while not self.fault and not self._closed.wait(_LOOK_S):
            if self._there() not in (self._files, None):
                with self._lock:
                    try:
                        if not self._closed.is_set():
                            self._check()
                    except DatabaseLost:
                        return


def _patiently(db: sqlite3.Connection, sql: str) -> None:
    """Executes what SQLite does not wait for by itself while another process opens the same database."""
    until = time.monotonic() + _WAIT_S
    while True:
        try:
            db.execute(sql).fetchone()
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorname.split("_")[1] != "BUSY" or time.monotonic() > until:
                raise
            time.sleep(0.05)


def _identity(path: str) -> tuple[int, int] | None:
    """Device and number of a file; None if it is not there."""
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def now() -> str:
    """The time as the database keeps it: UTC, ISO 8601, milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
