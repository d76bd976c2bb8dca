"""What an archive of a data directory is: its names, its manifest, and how much it may hold.

A ZIP without compression (videos and pictures are compressed already) that ends with ``manifest.json``:
what wrote it, and the SHA-256 of every other file in it. Nothing in it is trusted.
"""

from __future__ import annotations

import json
import re
import stat
import zipfile
from pathlib import Path
from typing import Any

from onedemo.errors import UserError
from onedemo.storage.database import FILE_NAME

MANIFEST = "manifest.json"
FORMAT = 1

_RUN = r"runs/[A-Za-z0-9_-]{1,84}"
_FILE = r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,199}"
_PART = r"[^/\\\x00-\x1f.][^/\\\x00-\x1f]{0,199}"
"""Of the path of a model's file, which somebody else has named: what ``onedemo.robots.model_files`` takes."""
_NAMES = re.compile(
    "|".join(
        (
            re.escape(FILE_NAME),
            "link-secret",
            rf"demos/[0-9a-f]{{64}}/{_FILE}\.(webm|json|npz)",
            rf"robots/{_FILE}\.npz",
            r"robots/[0-9a-f]{64}/[A-Za-z0-9_-]{1,64}\.json",
            rf"robots/[0-9a-f]{{64}}/model(/{_PART}){{1,16}}",
            rf"{_RUN}/(config\.toml|log|start\.pt|checkpoint(-before)?\.pt)",
            rf"{_RUN}/snapshots/\d{{6,15}}\.pt",
            rf"{_RUN}/(clips|pairs)/\d{{6,15}}(\.\d{{1,3}})?\.jpg",
            rf"{_RUN}/rollouts/\d{{6,15}}\.(npz|jpg|webm)",
        )
    ),
    re.ASCII,
)
"""Every file of a data directory that a backup saves. What onedemo writes and is not here is not saved:
locks, what is half written or was damaged, and the journals of the database, which is copied whole."""
_LEFT_OVER = re.compile(rf"uploads/upload-{_FILE}|demos/\.import-{_FILE}/{_FILE}", re.ASCII)
"""What backups of onedemo 0.1 and 0.2 also saved, of processes that had been killed: it is not restored."""


def is_saved(name: str) -> bool:
    """Whether a file of that path in a data directory, with slashes, belongs into a backup."""
    return _NAMES.fullmatch(name) is not None


def read_manifest(archive: zipfile.ZipFile, file: Path) -> dict[str, str]:
    """Name to digest of every file to restore; all names, kinds and sizes of the archive are checked.

    Reads the table of contents and the manifest, nothing else; what it says is bounded by the archive's
    own size on disk.

    Raises:
        UserError: If there is anything in it that a backup does not write.
    """
    listed = archive.infolist()
    entries = {entry.filename: entry for entry in listed}
    if MANIFEST not in entries:
        raise UserError(f"{file} is no backup of onedemo: it has no {MANIFEST}")
    for name, entry in entries.items():
        if name != MANIFEST and not is_saved(name) and not _LEFT_OVER.fullmatch(name):
            raise UserError(
                f"{file} is no backup of onedemo: it holds {name[:80]!a}, which no backup writes; if you "
                "trust whoever made it, unpack it yourself: what is in it is a data directory"
            )
        if stat.S_IFMT(entry.external_attr >> 16) not in (0, stat.S_IFREG) or entry.is_dir():
            raise UserError(f"{file} is no backup of onedemo: {name!r} is no plain file")
        if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
            raise UserError(f"{file} is no backup of onedemo: {name!r} is compressed, no backup does that")
        if entry.flag_bits & 1:
            raise UserError(f"{file} is no backup of onedemo: {name!r} is encrypted")
    if len(listed) != len(entries):
        raise UserError(f"{file} is damaged: it holds two files of one name")
    # Stored parts that do not overlap are together no larger than the file that they are in.
    if sum(entry.file_size for entry in listed) > file.stat().st_size:
        raise UserError(f"{file} is damaged: its parts are larger than it is itself")
    if entries[MANIFEST].file_size > 10_000 + sum(len(name) + 200 for name in entries):
        raise UserError(f"{file} is no backup of onedemo: its {MANIFEST} is too long for what it holds")
    try:
        manifest: dict[str, Any] = json.loads(archive.read(MANIFEST))
        digests, form = dict(manifest["files"]), int(manifest["format"])
    except (KeyError, ValueError, TypeError, RecursionError, OverflowError):
        raise UserError(f"{file} is no backup of onedemo: its {MANIFEST} is not one") from None
    if form > FORMAT:
        raise UserError(f"{file} was saved by a newer onedemo (format {form}); update onedemo first")
    if {*digests, MANIFEST} != set(entries):
        raise UserError(f"{file} is damaged: its files are not those of its {MANIFEST}")
    if FILE_NAME not in digests:
        raise UserError(f"{file} is no backup of onedemo: it has no {FILE_NAME}")
    return {name: digest for name, digest in digests.items() if is_saved(name)}
