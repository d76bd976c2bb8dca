"""A data directory made of an archive that somebody sent."""

from __future__ import annotations

import errno
import hashlib
import shutil
import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path

from onedemo.app.admin.archive import read_manifest
from onedemo.app.admin.inspection import check_contents, opened_as_it_is
from onedemo.core.directories import Workshop, make_directory, sync_directory
from onedemo.core.files import copy_synced
from onedemo.errors import UserError
from onedemo.storage.database import FILE_NAME

_MORE_ROOM = 64 << 20
"""Bytes that stay free on the disk."""


def restore(file: Path, data_dir: Path) -> dict[str, int]:
    """Makes a data directory of an archive: all of it, or nothing.

    The archive is not trusted. Names, kinds and sizes are checked before anything is written, every
    digest while it is, and the database before the directory is there: with no journal beside it, no
    query of its own run, and its schema compared with ours (``onedemo.app.admin.inspection``).

    Args:
        file: What ``back_up`` wrote.
        data_dir: A new or empty directory.

    Returns:
        Counts: {"files", "ratings"}.

    Raises:
        UserError: If the directory is in use, the archive is damaged, no backup or of a newer program,
            or there is no room.
    """
    if data_dir.exists() and (not data_dir.is_dir() or any(data_dir.iterdir())):
        raise UserError(f"{data_dir} is not empty; restore into a new directory")
    place = data_dir.absolute().parent
    try:
        if not file.exists():
            raise FileNotFoundError(errno.ENOENT, "No such file", str(file))
        if not file.is_file():
            raise UserError(f"{file} is damaged, or no backup: it is no file")
        with zipfile.ZipFile(file) as archive:
            digests = read_manifest(archive, file)
            _check_room(file, place)
            make_directory(place)
            with Workshop(place, f".{data_dir.name}.onedemo-half-") as half:
                return _restore(archive, file, digests, half, data_dir.absolute())
    except (zipfile.BadZipFile, EOFError, NotImplementedError) as error:
        raise UserError(f"{file} is damaged, or no backup: {error}") from None
    except OSError as error:
        raise UserError(f"cannot restore {file}: {error}") from None


def _restore(
    archive: zipfile.ZipFile, file: Path, digests: dict[str, str], half: Path, data_dir: Path
) -> dict[str, int]:
    for name, digest in digests.items():
        if _extract(archive, name, half) != digest:
            raise UserError(f"{file} is damaged: {name} is not what was saved")
    ratings = _check_database(half / FILE_NAME, file)
    for directory in (half, *(path for path in half.rglob("*") if path.is_dir())):
        sync_directory(directory)
    half.rename(data_dir)  # over an empty directory this is one step, too
    sync_directory(data_dir.parent)
    return {"files": len(digests), "ratings": ratings}


def _check_room(file: Path, place: Path) -> None:
    while not place.exists():
        place = place.parent
    needed, free = file.stat().st_size + _MORE_ROOM, shutil.disk_usage(place).free
    if needed > free:
        raise UserError(
            f"cannot restore {file}: {needed / 1e6:,.0f} MB are needed in {place}, "
            f"{free / 1e6:,.0f} MB are free"
        )


def _extract(archive: zipfile.ZipFile, name: str, directory: Path) -> str:
    """Writes one file of the archive below a directory; its SHA-256."""
    path = directory / name
    make_directory(path.parent)  # as private as the workshop
    with archive.open(name) as source:
        digest = hashlib.sha256()
        copy_synced(source, path, digest.update)
        return digest.hexdigest()


def _check_database(path: Path, file: Path) -> int:
    """How many ratings a restored database has; it is not migrated yet."""
    try:
        with closing(opened_as_it_is(path)) as db:
            return check_contents(db)
    except ValueError as error:
        raise UserError(f"the database in {file} was {error}") from None
    except (sqlite3.Error, UserError) as error:
        raise UserError(f"the database in {file} is damaged: {error}") from None
