"""A data directory as one file, taken while the server runs, and back.

The archive is a ZIP without compression (videos and pictures are compressed already) that ends with
``manifest.json``: what wrote it, and the SHA-256 of every other file in it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sqlite3
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import IO, Any

from onedemo.errors import UserError
from onedemo.storage.database import FILE_NAME
from onedemo.storage.schema import check_version

MANIFEST = "manifest.json"
FORMAT = 1
_BLOCK = 1 << 20
_LEFT_OUT = re.compile(rf"(.+\.)?lock|\..*|{re.escape(FILE_NAME)}.*|.*\.damaged")
"""Names of files that belong to a process, are half written, or are copied in another way."""
_SNAPSHOT = re.compile(r"runs/([^/]+)/snapshots/(\d+)\.pt")


def back_up(data_dir: Path, file: Path) -> dict[str, int]:
    """Writes everything in a data directory into one archive; a server may run on it meanwhile.

    The database is copied in one read transaction by SQLite's backup, and is whole as of one moment.
    Checkpoints are opened before that moment: a run that goes on from them repeats an iteration or two
    and gives the same again. Whatever the database names was on disk before it was named, so the other
    files are read after; snapshots that it does not know yet are left out.

    Args:
        data_dir: What to save.
        file: The archive. It holds the secret behind people's links, so only its owner may read it.

    Returns:
        Counts: {"files", "bytes", "ratings"}.

    Raises:
        UserError: If there is no database in the directory, or it is damaged.
        OSError: If the archive cannot be written; nothing of it is then left.
    """
    if not (data_dir / FILE_NAME).exists():
        raise UserError(f"no {FILE_NAME} in {data_dir}; give the directory with --data-dir")
    with ExitStack() as stack:
        checkpoints = {
            path: stack.enter_context(path.open("rb")) for path in data_dir.glob("runs/*/checkpoint.pt")
        }
        copy = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=file.absolute().parent))) / FILE_NAME
        ratings, snapshots = _copy_database(data_dir / FILE_NAME, copy)
        archive = stack.enter_context(_whole_zip(file))
        digests = {FILE_NAME: _add(archive, FILE_NAME, stack.enter_context(copy.open("rb")))}
        for path in _files(data_dir):
            name = path.relative_to(data_dir).as_posix()
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
    return {"files": len(digests), "bytes": file.stat().st_size, "ratings": ratings}


def restore(file: Path, data_dir: Path) -> dict[str, int]:
    """Makes a data directory of an archive: all of it, or nothing.

    Args:
        file: What ``back_up`` wrote. It is not trusted: names that lead elsewhere and whatever is no
            plain file are refused, and every digest is checked before the directory is there.
        data_dir: A new or empty directory.

    Returns:
        Counts: {"files", "ratings"}.

    Raises:
        UserError: If the directory is in use, the archive is damaged or of a newer program, or there is
            no room.
    """
    if data_dir.exists() and (not data_dir.is_dir() or any(data_dir.iterdir())):
        raise UserError(f"{data_dir} is not empty; restore into a new directory")
    data_dir.absolute().parent.mkdir(parents=True, exist_ok=True)
    half = Path(tempfile.mkdtemp(dir=data_dir.absolute().parent, prefix=f".{data_dir.name}."))
    try:
        try:
            with zipfile.ZipFile(file) as archive:
                digests = _manifest(archive, file)
                for name, digest in digests.items():
                    if _extract(archive, name, half) != digest:
                        raise UserError(f"{file} is damaged: {name} is not what was saved")
        except (zipfile.BadZipFile, EOFError, NotImplementedError) as error:
            raise UserError(f"{file} is damaged, or no backup: {error}") from None
        except OSError as error:
            raise UserError(f"cannot restore {file}: {error}") from None
        ratings = _check_database(half / FILE_NAME, file)
        half.chmod(0o755)
        half.rename(data_dir.absolute())  # over an empty directory this is one step, too
    except BaseException:
        shutil.rmtree(half, ignore_errors=True)
        raise
    return {"files": len(digests), "ratings": ratings}


def _copy_database(source: Path, copy: Path) -> tuple[int, dict[str, int]]:
    """Copies the database as of now; how many ratings it has, and the newest snapshot of each run."""
    try:
        with (
            closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=ro", uri=True, timeout=60)) as live,
            closing(sqlite3.connect(copy, isolation_level=None)) as saved,
        ):
            check_version(live)
            live.backup(saved)  # all pages in one step: a writer in between would make it start over
            saved.execute("PRAGMA journal_mode = DELETE")  # one file
            (said,) = saved.execute("PRAGMA integrity_check(1)").fetchone()
            if said != "ok":
                raise UserError(f"{source} is damaged ({said}); see what `onedemo doctor` says")
            tables = {name for (name,) in saved.execute("SELECT name FROM sqlite_master")}
            newest = "SELECT run, MAX(number) FROM snapshots GROUP BY run"
            return (
                saved.execute("SELECT COUNT(*) FROM ratings").fetchone()[0],
                dict(saved.execute(newest)) if "snapshots" in tables else {},
            )
    except (sqlite3.DatabaseError, ValueError) as error:
        raise UserError(f"{source} cannot be read: {error}") from None


def _check_database(path: Path, file: Path) -> int:
    """How many ratings a restored database has; it is not migrated yet."""
    try:
        with closing(sqlite3.connect(path)) as db:
            check_version(db)
            (said,) = db.execute("PRAGMA integrity_check(1)").fetchone()
            (ratings,) = db.execute("SELECT COUNT(*) FROM ratings").fetchone()
    except ValueError as error:
        raise UserError(f"the database in {file} was {error}") from None
    except sqlite3.DatabaseError as error:
        said, ratings = str(error), 0
    if said != "ok":
        raise UserError(f"the database in {file} is damaged: {said}")
    return ratings


def _files(data_dir: Path) -> Iterator[Path]:
    for directory, _, names in os.walk(data_dir):  # follows no links
        for name in sorted(names):
            path = Path(directory) / name
            if not _LEFT_OUT.fullmatch(name) and path.is_file() and not path.is_symlink():
                yield path


@contextmanager
def _whole_zip(file: Path) -> Iterator[zipfile.ZipFile]:
    """An archive that is there once it is whole and on disk, and not before."""
    handle, half = tempfile.mkstemp(dir=file.absolute().parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "wb") as out:
            with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
                yield archive
            out.flush()
            os.fsync(out.fileno())
        os.replace(half, file)
    except BaseException:
        os.unlink(half)
        raise


def _add(archive: zipfile.ZipFile, name: str, source: IO[bytes]) -> str:
    """Copies a file into the archive; its SHA-256."""
    digest = hashlib.sha256()
    with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as out:
        while block := source.read(_BLOCK):
            digest.update(block)
            out.write(block)
    return digest.hexdigest()


def _manifest(archive: zipfile.ZipFile, file: Path) -> dict[str, str]:
    """Name to digest of every file, each name and kind checked."""
    entries = {entry.filename: entry for entry in archive.infolist()}
    try:
        manifest: dict[str, Any] = json.loads(archive.read(MANIFEST))
        digests, form = dict(manifest["files"]), int(manifest["format"])
    except (KeyError, ValueError, TypeError):
        raise UserError(f"{file} is no backup of onedemo: it has no {MANIFEST}") from None
    if form > FORMAT:
        raise UserError(f"{file} was saved by a newer onedemo (format {form}); update onedemo first")
    if {*digests, MANIFEST} != set(entries) or len(archive.infolist()) != len(entries):
        raise UserError(f"{file} is damaged: its files are not those of its {MANIFEST}")
    if FILE_NAME not in digests:
        raise UserError(f"{file} is no backup of onedemo: it has no {FILE_NAME}")
    for name, entry in entries.items():
        kind = stat.S_IFMT(entry.external_attr >> 16)
        parts: Sequence[str] = PurePosixPath(name).parts
        plain = kind in (0, stat.S_IFREG) and not entry.is_dir()
        if not plain or name.startswith("/") or "\\" in name or {".", ".."} & set(parts):
            raise UserError(f"{file} is no backup of onedemo: {name[:80]!r} is not the name of a plain file")
    return digests


def _extract(archive: zipfile.ZipFile, name: str, directory: Path) -> str:
    """Writes one file of the archive below a directory; its SHA-256."""
    path = directory / name
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    with archive.open(name) as source, path.open("wb") as out:
        if "/" not in name and name != FILE_NAME:
            path.chmod(0o600)  # the secret behind links
        while block := source.read(_BLOCK):
            digest.update(block)
            out.write(block)
        out.flush()
        os.fsync(out.fileno())
    return digest.hexdigest()
