"""Files that are either whole or not there."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from trainer.errors import UserError

_UMASK = os.umask(0)  # there is no way to ask without setting; once, before there are threads
os.umask(_UMASK)


def write_atomic(path: Path, data: bytes | Iterable[bytes]) -> None:
    """Writes a file to a temporary name, syncs and renames it: a reader never sees half of it.

    Args:
        path: Where; missing directories are made.
        data: The whole content, in one piece or in several.

    Raises:
        OSError: If the disk is full or the directory not writable; the old file is then untouched.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            os.fchmod(handle, 0o666 & ~_UMASK)  # mkstemp makes files that nobody else can read
            for block in (data,) if isinstance(data, bytes) else data:
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)  # the rename itself must survive a power cut
    finally:
        os.close(directory)


def check_writable(file: Path) -> None:
    """Raises UserError, before any work is done, if a file could not be written there."""
    if file.is_dir():
        raise UserError(f"{file} is a directory; give the name of a file in it")
    parent = file.absolute().parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"cannot write {file}: {parent} is not a directory that can be written to")


@contextmanager
def hold(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Holds a lock file: one process at a time, released when it ends, however it ends.

    Args:
        path: The file; made if missing, and left there.
        wait: For another process to let go of it.

    Raises:
        UserError: If another process holds it, and this one does not wait.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise UserError(
                f"another onedemo is working on {path.parent}; stop it, or choose another --run or --data-dir"
            ) from None
        yield
