"""Archives that somebody made who means harm: each a good backup with one thing changed.

Used by tests/unit/admin/test_restore.py and, as a table, by tests/load/hostile_archives.py.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
import stat
import struct
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from onedemo.app.admin.archive import MANIFEST
from onedemo.app.admin.backup import back_up
from onedemo.storage.clips import NewClip
from onedemo.storage.database import FILE_NAME
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.types import Segment

Entries = dict[str, bytes]


class Hostile(NamedTuple):
    """One archive."""

    what: str
    change: Callable[[Entries, dict[str, Any], Path], None]
    """Of the files, the manifest, given the victim: a file elsewhere that must survive."""
    refused: str
    """What is said, as a regular expression."""
    pack: Callable[[Path, Entries, dict[str, Any]], None]


def small_study(data_dir: Path, segment: Segment) -> None:
    """A data directory with a run, a rated clip, a picture, a secret: all that an archive needs."""
    with closing(Store(data_dir)) as store:
        store.runs.add(run="r", demo="d", demo_sha256="0" * 64, seed=0, config="", version="0")
        (clip,) = store.clips.add("r", [NewClip(demo_step=0, segment=segment, stage="online", iteration=1)])
        store.ratings.rate(clip.id, store.accounts.ensure("Ann", "annotator").id, 4, latency_ms=900)
        store.runs.add_snapshot("r", 1, last_event=1, ratings=1, stats={})
    picture = RunDirectory(data_dir, "r").clip(1)
    picture.parent.mkdir(parents=True)
    picture.write_bytes(b"\xff\xd8 a picture \xff\xd9")
    (data_dir / "link-secret").write_bytes(b"s" * 32)
    (data_dir / "link-secret").chmod(0o600)


def make(hostile: Hostile, good: Path, file: Path, victim: Path) -> None:
    """Writes the archive that ``hostile`` is into ``file``, from the good backup."""
    with zipfile.ZipFile(good) as archive:
        entries = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    manifest = json.loads(entries.pop(MANIFEST))
    hostile.change(entries, manifest, victim)
    hostile.pack(file, entries, manifest)


def good_backup(directory: Path, segment: Segment) -> Path:
    """A backup of a small study, in a directory of its own."""
    small_study(directory / "data", segment)
    back_up(directory / "data", directory / "good.zip")
    return directory / "good.zip"


def hot_journal(victim: Path, pages: int) -> bytes:
    """A journal of a transaction over several databases that was broken off: SQLite plays it back when it
    opens the database beside it, and then deletes the "super-journal" that it names: the victim."""
    magic = bytes.fromhex("d9d505f920a163d7")
    name = str(victim).encode()
    header = magic + struct.pack(">5I", 0, 0, pages, 512, 4096)
    lock_page = (1 << 30) // 4096 + 1
    ending = struct.pack(">I", lock_page) + name + struct.pack(">2I", len(name), sum(name)) + magic
    return header.ljust(512, b"\0") + ending


# Packing


def stored(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
    """As a backup is."""
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
        archive.writestr(MANIFEST, json.dumps(manifest))


def _of_kind(kind: int, of: str) -> Callable:
    def pack(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
        with zipfile.ZipFile(file, "w") as archive:
            for name, content in entries.items():
                entry = zipfile.ZipInfo(name)
                entry.external_attr = ((kind if name == of else stat.S_IFREG) | 0o644) << 16
                archive.writestr(entry, content)
            archive.writestr(MANIFEST, json.dumps(manifest))

    return pack


def _huge_manifest(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), content)
        with archive.open(MANIFEST, "w") as out:
            out.write(json.dumps(manifest).encode())
            for _ in range(64):
                out.write(b" " * (1 << 20))


def _long_manifest(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
    stored(file, entries, manifest | {"more": "x" * (1 << 20)})


def _deep_manifest(file: Path, entries: Entries, _: dict[str, Any]) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
        archive.writestr(MANIFEST, "[" * 5000)


def _overlapping(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
    """Three thousand names for one megabyte, which is there once."""
    block = bytes(1 << 20)
    names = [f"runs/r/clips/{number:06d}.jpg" for number in range(10, 3010)]
    manifest["files"] |= dict.fromkeys(names, hashlib.sha256(block).hexdigest())
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
        archive.writestr(names[0], block)
        first = archive.filelist[-1]
        for name in names[1:]:
            again = zipfile.ZipInfo(name)
            for part in ("header_offset", "CRC", "compress_size", "file_size"):
                setattr(again, part, getattr(first, part))
            archive.filelist.append(again)
            archive.NameToInfo[name] = again
        archive.writestr(MANIFEST, json.dumps(manifest))


def _bomb(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
    block = bytes(64 << 20)
    manifest["files"]["runs/r/log"] = hashlib.sha256(block).hexdigest()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
        archive.writestr("runs/r/log", block, zipfile.ZIP_DEFLATED)
        archive.writestr(MANIFEST, json.dumps(manifest))


def _twice(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
    stored(file, entries, manifest)
    with zipfile.ZipFile(file, "a") as archive:
        copy = zipfile.ZipInfo("link-secret")
        archive.NameToInfo.pop("link-secret")
        archive.writestr(copy, b"t" * 32)


def _cut_off(file: Path, entries: Entries, manifest: dict[str, Any]) -> None:
    stored(file, entries, manifest)
    file.write_bytes(file.read_bytes()[:-300])


# Changing


def _nothing(entries: Entries, manifest: dict[str, Any], victim: Path) -> None:
    pass


def _added(name: str, content: bytes = b"x") -> Callable:
    def change(entries: Entries, manifest: dict[str, Any], victim: Path) -> None:
        entries[name] = content
        manifest["files"][name] = hashlib.sha256(content).hexdigest()

    return change


def _journal(entries: Entries, manifest: dict[str, Any], victim: Path) -> None:
    journal = hot_journal(victim, len(entries[FILE_NAME]) // 4096)
    _added(f"{FILE_NAME}-journal", journal)(entries, manifest, victim)


def _sql(*statements: str) -> Callable:
    """The database after these statements, with everything allowed that somebody with an editor could do."""

    def change(entries: Entries, manifest: dict[str, Any], victim: Path) -> None:
        with closing(sqlite3.connect(":memory:", isolation_level=None)) as db:
            db.deserialize(entries[FILE_NAME])
            for statement in statements:
                db.execute(statement)
            content = db.serialize()
        _added(FILE_NAME, content)(entries, manifest, victim)

    return change


def _other_bytes(entries: Entries, manifest: dict[str, Any], victim: Path) -> None:
    entries["link-secret"] = b"t" * 32


def _turned(entries: Entries, manifest: dict[str, Any], victim: Path) -> None:
    content = bytearray(entries[FILE_NAME])
    for page in range(2, len(content) // 4096, 2):
        content[page * 4096 : page * 4096 + 256] = bytes(range(256))
    _added(FILE_NAME, bytes(content))(entries, manifest, victim)


_ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
    " SELECT i AS id, i AS run FROM n WHERE i < 0"
)  # never has a row, and never ends
_RENAMED = [
    f"UPDATE {table} SET {column} = '../../../home/x/.cargo'"
    for table, column in (("runs", "id"), ("clips", "run"), ("snapshots", "run"), ("tallies", "run"))
]
_WHICH = "no backup of onedemo: it holds .* which no backup writes"
_CHANGED = "the database in .* was changed by another program"

HOSTILE = (
    Hostile("a hot journal that names the victim", _journal, _WHICH, stored),
    Hostile("a write-ahead log", _added(f"{FILE_NAME}-wal"), _WHICH, stored),
    Hostile("../outside", _added("../outside"), _WHICH, stored),
    Hostile("/tmp/outside", _added("/tmp/outside"), _WHICH, stored),
    Hostile("demos/../../outside", _added("demos/../../outside"), _WHICH, stored),
    Hostile("a backslash", _added("runs\\r\\log"), _WHICH, stored),
    Hostile("a hidden file", _added("runs/r/clips/.bashrc"), _WHICH, stored),
    Hostile("a run called ../x", _added("runs/../x/log"), _WHICH, stored),
    Hostile("a backup in the backup", _added("study.zip"), _WHICH, stored),
    Hostile("a symbolic link", _added("runs/r/log", b"/etc/passwd"), "is no plain file",
            _of_kind(stat.S_IFLNK, "runs/r/log")),
    Hostile("a pipe", _added("runs/r/log", b""), "is no plain file", _of_kind(stat.S_IFIFO, "runs/r/log")),
    Hostile("a manifest of 64 MB in 70 KB", _nothing, "is compressed, no backup does that", _huge_manifest),
    Hostile("a manifest too long", _nothing, "its manifest.json is too long", _long_manifest),
    Hostile("a manifest 5,000 brackets deep", _nothing, "its manifest.json is not one", _deep_manifest),
    Hostile("3 GB in 1 MB, overlapping", _nothing, "its parts are larger than it is itself", _overlapping),
    Hostile("64 MB of nothing, compressed", _nothing, "is compressed, no backup does that", _bomb),
    Hostile("two files of one name", _nothing, "two files of one name", _twice),
    Hostile("cut off", _nothing, "is damaged, or no backup", _cut_off),
    Hostile("other bytes than were saved", _other_bytes, "link-secret is not what was saved", stored),
    Hostile("a file left out", lambda entries, *_: entries.pop("link-secret"), "its files are not those of",
            stored),
    Hostile("a manifest without files", lambda _, manifest, __: manifest.pop("files"), "manifest.json is not",
            stored),
    Hostile("a newer format", lambda _, manifest, __: manifest.update(format=2), "newer onedemo .format 2.",
            stored),
    Hostile("a view that never ends", _sql("DROP VIEW ratings", f"CREATE VIEW ratings AS {_ENDLESS}"),
            f"{_CHANGED}: view 'ratings' was changed", stored),
    Hostile("a view removed", _sql("DROP VIEW ratings"), f"{_CHANGED}: view 'ratings' was removed", stored),
    Hostile("a trigger that takes back what is rated",
            _sql("CREATE TRIGGER t AFTER INSERT ON tallies BEGIN DELETE FROM tallies; END"),
            f"{_CHANGED}: trigger 't' was added", stored),
    Hostile("a computed column", _sql("ALTER TABLE raters ADD COLUMN c AS (zeroblob(1000000000))"),
            f"{_CHANGED}: table 'raters' was changed", stored),
    Hostile("a run called ../../../home/x/.cargo", _sql("PRAGMA foreign_keys = OFF", *_RENAMED),
            "the database in .* is damaged: a name is 1 to 84 letters", stored),
    Hostile("a snapshot called ../x", _sql("UPDATE snapshots SET number = '../x'"),
            "its table snapshots holds text in the place of a number", stored),
    Hostile("rows that belong to nothing", _sql("DELETE FROM raters"),
            "rows of .* belong to nothing", stored),
    Hostile("a database with other bytes", _turned, "the database in .* (is damaged|was changed)", stored),
    Hostile("a database of a newer onedemo", _sql("PRAGMA user_version = 999"),
            "written by a newer onedemo .*version 999", stored),
    Hostile("a database of before 0.1.0", _sql("PRAGMA user_version = 4"),
            "the database in .* was written before onedemo 0.1.0", stored),
    Hostile("an empty database", _added(FILE_NAME, b""),
            "the database in .* was not written by onedemo", stored),
)  # fmt: skip
