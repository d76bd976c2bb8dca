"""The store: the database and the parts of it, one for each subject."""

from __future__ import annotations

import sqlite3
from contextlib import suppress
from pathlib import Path

from onedemo.storage.accounts import Accounts
from onedemo.storage.audit_log import AuditLog
from onedemo.storage.clips import Clips
from onedemo.storage.comparisons import Comparisons
from onedemo.storage.database import Database
from onedemo.storage.ratings import Ratings
from onedemo.storage.runs import Runs


class Store:
    """The database in ``data_dir`` and its parts, which share one connection and one lock.

    Calls of several parts inside ``with store.database.transaction():`` are one transaction.
    Arguments, errors and threads as ``onedemo.storage.database.Database``. Close it when done.
    """

    def __init__(self, data_dir: Path) -> None:
        self.database = Database(data_dir)
        self.path = self.database.path
        self.runs = Runs(self.database)
        self.clips = Clips(self.database)
        self.ratings = Ratings(self.database)
        self.comparisons = Comparisons(self.database)
        self.accounts = Accounts(self.database)
        self.audit = AuditLog(self.database)

    def close(self) -> None:
        """Closes the database; nothing of the store can be used afterwards."""
        with suppress(sqlite3.Error):  # it must be closed, whatever the disk is like
            self.audit.finish(everything=True)
        self.database.close()
