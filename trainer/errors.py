"""The one error that is meant for the person at the keyboard, and the others in plain words."""

from __future__ import annotations

import errno
import sqlite3


class UserError(Exception):
    """What was wrong, where, and what would be right, in one sentence.

    The command line prints it alone (no traceback) and exits with code 2; the page shows it as text.
    """


class DatabaseLost(UserError, sqlite3.OperationalError):
    """The database's files were deleted or replaced while it was open: nothing can be written any more."""


_CAUSES = {
    errno.ENOSPC: "The disk is full: free some space.",
    errno.EDQUOT: "The disk quota is used up: free some space.",
    errno.EFBIG: "A file has grown as large as this process may write: raise the limit (ulimit -f).",
    errno.EROFS: "The data directory is read-only: make it writable.",
    errno.EACCES: "The data directory may not be written to: make it writable.",
    errno.EPERM: "The data directory may not be written to: make it writable.",
    errno.ENOMEM: "There is not enough memory: end other programs.",
    errno.EMFILE: "Too many files are open: raise the limit (ulimit -n).",
}
_NO_MEMORY = ("can't allocate memory", "Insufficient memory")
"""As torch and OpenCV say it."""
_LOCKED = "Another program holds the database: end it or wait for it."
_SAID = {
    "SQLITE_CANTOPEN": _CAUSES[errno.EACCES],
    "SQLITE_FULL": _CAUSES[errno.ENOSPC],
    "SQLITE_READONLY": _CAUSES[errno.EROFS],
    "SQLITE_BUSY": _LOCKED,
    "SQLITE_LOCKED": _LOCKED,
    "SQLITE_NOMEM": _CAUSES[errno.ENOMEM],
    # SQLite tells a broken disk and a file that may not grow (ulimit -f) by the same number.
    "SQLITE_IOERR": "The database cannot be written: check the disk, and the largest file (ulimit -f).",
}


def in_words(error: BaseException) -> str:
    """What went wrong and what would help, for people, with the error itself where that is not its text."""
    if isinstance(error, UserError):
        return str(error)
    words = ""
    if isinstance(error, OSError):
        words = _CAUSES.get(error.errno or 0, "")
    elif isinstance(error, MemoryError) or any(said in str(error) for said in _NO_MEMORY):
        words = _CAUSES[errno.ENOMEM]
    elif isinstance(error, sqlite3.Error):
        name = getattr(error, "sqlite_errorname", "") or ""
        words = _SAID.get("_".join(name.split("_")[:2]), "")
    technical = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"{words} ({technical})" if words else technical
