"""Whether results can be written, tried before the work that makes them."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from onedemo.errors import UserError


def check_outputs(*files: Path | None, directories: Mapping[str, Path | None] | None = None) -> None:
    """Writes beside every result that a command is going to leave, and takes that away again.

    Every command that works for long calls this first with all that it will write.

    Args:
        files: Results; their directories must be there. None: not asked for.
        directories: Directories of results by the option that names them; the last one is made if missing.

    Raises:
        UserError: If one could not be written.
    """
    for file in files:
        if file is not None:
            if os.path.isdir(file):  # unlike Path.is_dir, whatever the name
                raise UserError(f"{file} is a directory; give the name of a file in it")
            _try(file, file.absolute().parent, file.name)
    for option, directory in (directories or {}).items():
        if directory is not None:
            if os.path.exists(directory) and not os.path.isdir(directory):
                raise UserError(f"{option} {directory} is a file; give the name of a directory")
            there = directory.absolute()
            _try(directory, there if os.path.exists(there) else there.parent, there.name)


def check_prefix(prefix: Path, suffixes: tuple[str, ...]) -> None:
    """As ``check_outputs``, of files whose names begin alike."""
    check_outputs(*(prefix.with_name(prefix.name + suffix) for suffix in suffixes))


def check_data_dir(directory: Path) -> None:
    """As ``check_outputs``, of a directory that is made with all above it."""
    there = directory.absolute()
    while not os.path.exists(there):
        there = there.parent
    _try(directory, there, there.name)


def _try(path: Path, directory: Path, name: str) -> None:
    try:
        handle, temporary = tempfile.mkstemp(dir=directory, prefix=f".{name}.")
        try:
            os.write(handle, bytes(4096))  # a full disk takes a name, and no block
            os.fsync(handle)
        finally:
            os.close(handle)
            Path(temporary).unlink()
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EROFS):
            why = f"{directory} is not a directory that can be written to"
        raise UserError(f"cannot write {path}: {why}") from None
