"""Directories: made as private as they should be, kept through a power cut, and worked in unseen."""

from __future__ import annotations

import fcntl
import glob
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def make_directory(path: Path, *, private: bool = False) -> None:
    """Makes a directory, and those above it that are missing.

    Args:
        path: May be there already; it then stays as it is.
        private: New ones are for their owner alone; else they are as open as the one that they lie in.

    Raises:
        OSError: If it cannot be made.
    """
    if path.is_dir():
        return
    make_directory(path.absolute().parent, private=private)
    others = 0 if private else path.absolute().parent.stat().st_mode & 0o077
    path.mkdir(mode=0o700 | others, exist_ok=True)


def sync_directory(path: Path) -> None:
    """Puts the names in a directory on disk: what was renamed into it survives a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """One process or thread at a time in a directory, which others wait for; where locks are, that is."""
    handle = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


class Workshop:
    """A hidden directory to prepare something in, which is gone afterwards unless it was renamed.

    "Afterwards" is the end of the ``with`` block or of this object. It is locked while this process lives;
    what others have left that were killed is removed first.

    Args:
        place: Where; on the file system that the result is renamed into.
        prefix: Of its name, which goes on at random.

    Raises:
        OSError: If it cannot be made.
    """

    def __init__(self, place: Path, prefix: str) -> None:
        clear_left_over(place, prefix)
        self.path, handle = _made_and_locked(place, prefix)
        self._end = weakref.finalize(self, _end, self.path, handle)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self._end()


def clear_left_over(place: Path, prefix: str) -> None:
    """Removes files and directories of that prefix which no living process holds with ``flock``."""
    for left in place.glob(f"{glob.escape(prefix)}*"):
        with suppress(OSError):
            handle = os.open(left, os.O_RDONLY | os.O_NOFOLLOW)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if left.is_dir():
                    shutil.rmtree(left, ignore_errors=True)
                else:
                    left.unlink()
            finally:
                os.close(handle)


def _made_and_locked(place: Path, prefix: str) -> tuple[Path, int]:
    while True:
        path = Path(tempfile.mkdtemp(dir=place, prefix=prefix))
        try:
            handle = os.open(path, os.O_RDONLY)
        except FileNotFoundError:  # somebody cleared it away before it was opened
            continue
        try:
            with suppress(OSError):  # a file system without locks: then nobody clears up there, either
                fcntl.flock(handle, fcntl.LOCK_EX)
            if path.exists():
                return path, handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # somebody cleared it away before it was locked


def _end(path: Path, handle: int) -> None:
    shutil.rmtree(path, ignore_errors=True)
    os.close(handle)
