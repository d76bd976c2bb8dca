"""A data directory as one file, taken while the server runs."""

from __future__ import annotations

import hashlib
import json
import os
import re
import sqlite3
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import IO, NamedTuple

from onedemo.app.admin.archive import FORMAT, MANIFEST, is_saved
from onedemo.core.directories import Workshop, sync_directory
from onedemo.errors import UserError
from onedemo.storage.database import FILE_NAME, rescued_files
from onedemo.storage.schema import check_schema

_BLOCK = 1 << 20
_OURS = re.compile(
    rf"(.*/)?(lock|.*\.lock|address|\..*|.*\.damaged)|{re.escape(FILE_NAME)}(-(wal|shm|journal)|\.rescued-\d+)"
    r"|uploads/.*"
)
"""What onedemo writes into a data directory and nobody would miss in a backup."""
_SNAPSHOT = re.compile(r"runs/([^/]+)/snapshots/(\d+)\.pt")


class Saved(NamedTuple):
    """What a backup holds."""

    files: int
    bytes: int
    """Of the archive."""
    ratings: int
    left_out: list[str]
    """Files in the data directory that are none of onedemo's."""
    rescued: list[Path]
    """Databases that a server saved when it lost its own; not in the backup."""


def back_up(data_dir: Path, file: Path) -> Saved:
    """Writes all that onedemo keeps in a data directory into one archive; a server may run on it meanwhile.

    The database is copied in one read transaction by SQLite's backup, and is whole as of one moment.
    Checkpoints are opened before that moment: a run that goes on from them repeats an iteration or two
    and gives the same again. Whatever the database names was on disk before it was named, so the other
    files are read after; snapshots that it does not know yet are left out.

    Args:
        data_dir: What to save.
        file: The archive. It holds the secret behind people's links, so only its owner may read it.

    Raises:
        UserError: If there is no database in the directory, or it is damaged or changed by another program.
        OSError: If the archive cannot be written; nothing of it is then left.
    """
    if not (data_dir / FILE_NAME).exists():
        raise UserError(f"no {FILE_NAME} in {data_dir}; give the directory with --data-dir")
    with ExitStack() as stack:
        checkpoints = {
            path: stack.enter_context(path.open("rb")) for path in data_dir.glob("runs/*/checkpoint.pt")
        }
        place = stack.enter_context(Workshop(file.absolute().parent, f".{file.name}.onedemo-half-"))
        ratings, snapshots = _copy_database(data_dir / FILE_NAME, place / FILE_NAME)
        half, left_out = place / "archive", []
        with half.open("wb") as out, zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
            digests = {}
            with (place / FILE_NAME).open("rb") as source:
                digests[FILE_NAME] = _add(archive, FILE_NAME, source)
            for path in _files(data_dir):
                name = path.relative_to(data_dir).as_posix()
                if name == FILE_NAME:
                    continue
                if not is_saved(name):
                    if not _OURS.fullmatch(name):
                        left_out.append(name)
                    continue
                made = _SNAPSHOT.fullmatch(name)
                if made and int(made[2]) > snapshots.get(made[1], 0):
                    continue
                try:
                    with checkpoints.get(path) or path.open("rb") as source:
                        digests[name] = _add(archive, name, source)
                except FileNotFoundError:  # withdrawn meanwhile
                    continue
            manifest = {
                "format": FORMAT,
                "program": f"onedemo {version('onedemo')}",
                "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
                "files": digests,
            }
            archive.writestr(MANIFEST, json.dumps(manifest, indent=1))
        with half.open("rb") as whole:
            os.fchmod(whole.fileno(), 0o600)
            os.fsync(whole.fileno())
        os.replace(half, file)
        sync_directory(file.absolute().parent)
    return Saved(len(digests), file.stat().st_size, ratings, left_out, rescued_files(data_dir))


def _copy_database(source: Path, copy: Path) -> tuple[int, dict[str, int]]:
    """Copies the database as of now; how many ratings it has, and the newest snapshot of each run."""
    try:
        with (
            closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=ro", uri=True, timeout=60)) as live,
            closing(sqlite3.connect(copy, isolation_level=None)) as saved,
        ):
            check_schema(live)
            live.backup(saved)  # all pages in one step: a writer in between would make it start over
            saved.execute("PRAGMA journal_mode = DELETE")  # one file
            (said,) = saved.execute("PRAGMA integrity_check(1)").fetchone()
            if said != "ok":
                raise UserError(f"{source} is damaged ({said}); see what `onedemo doctor` says")
            newest = "SELECT run, MAX(number) FROM snapshots GROUP BY run"
            return (
                saved.execute("SELECT COUNT(*) FROM ratings").fetchone()[0],
                dict(saved.execute(newest)),
            )
    except ValueError as error:
        raise UserError(f"{source} was {error}") from None
    except sqlite3.DatabaseError as error:
        raise UserError(f"{source} cannot be read: {error}") from None


def _files(data_dir: Path) -> Iterator[Path]:
    for directory, folders, names in os.walk(data_dir):  # follows no links
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(directory) / name
            if path.is_file() and not path.is_symlink():
                yield path


def _add(archive: zipfile.ZipFile, name: str, source: IO[bytes]) -> str:
    """Copies a file into the archive; its SHA-256."""
    digest = hashlib.sha256()
    with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as out:
        while block := source.read(_BLOCK):
            digest.update(block)
            out.write(block)
    return digest.hexdigest()
