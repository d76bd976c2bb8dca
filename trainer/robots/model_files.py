"""The files of a MuJoCo model: found by reading its XML, never outside its folder; copied, and hashed.

A model may come from anybody. Whatever its XML names is looked for beside it, and nowhere else: MuJoCo itself
would read any file of the computer. What is not found here is not there where the copy is compiled.
"""

from __future__ import annotations

import hashlib
import posixpath
import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from onedemo.core.directories import make_directory
from onedemo.core.files import copy_synced
from onedemo.errors import UserError

MOST_BODIES = 256
_MOST_FILES, _MOST_BYTES, _MOST_XML_BYTES = 500, 256 << 20, 16 << 20
_MOST_ELEMENTS = 100_000
_PLAIN = re.compile(r"[^/\\\x00-\x1f]{1,200}")
"""One part of a file's path; none begins with a dot."""


@dataclass(slots=True)
class _Scan:
    """What the XML of a model names, as far as it was read."""

    folder: Path
    main: str
    bases: set[str] = field(default_factory=lambda: {""})
    """Directories that files may be relative to, below the folder."""
    named: list[tuple[str, str, int]] = field(default_factory=list)
    """(file as it is named, XML that names it, line)."""
    texts: dict[str, Path] = field(default_factory=dict)
    bodies: int = 0
    elements: int = 0


def files_of(model: Path, folder: Path | None = None) -> dict[str, Path]:
    """All files that a model needs, by their path below the folder; the model itself is the first.

    Args:
        model: Its MJCF file.
        folder: What holds it and all that it needs; the directory that it lies in if None.

    Raises:
        UserError: If one is missing or lies outside the folder, or if there is too much of something.
    """
    folder = (folder or model.parent).resolve()
    if not model.is_file():
        raise UserError(f"there is no model {model}")
    if not model.resolve().is_relative_to(folder):
        raise UserError(f"{model} is not in {folder}")
    scan = _Scan(folder, model.resolve().relative_to(folder).as_posix())
    scan.bases.add(posixpath.dirname(scan.main))
    _read(scan, scan.main)
    found = dict(scan.texts)
    for name, where, line in scan.named:
        for place in _places(scan, name, scan.bases, where, line):
            found[place] = _inside(folder, place, where, line)
    if len(found) > _MOST_FILES:
        raise UserError(f"{model} needs {len(found)} files, more than {_MOST_FILES}")
    size = sum(path.stat().st_size for path in found.values())
    if size > _MOST_BYTES:
        raise UserError(f"{model} and its files are {size / 1e6:,.0f} MB, more than {_MOST_BYTES / 1e6:,.0f}")
    return found


def copy_model(files: dict[str, Path], place: Path) -> str:
    """Copies the files of a model below a new directory, synced; the SHA-256 of them all, hex.

    It is of each file's path and content, so that the same model is the same wherever it comes from.
    """
    whole = hashlib.sha256()
    for name in sorted(files):
        digest = hashlib.sha256()
        target = place / name
        make_directory(target.parent)
        with files[name].open("rb") as source:
            copy_synced(source, target, digest.update)
        whole.update(f"{name}\0{digest.hexdigest()}\n".encode())
    return whole.hexdigest()


def hash_of(files: dict[str, Path]) -> str:
    """What ``copy_model`` would give."""
    whole = hashlib.sha256()
    for name in sorted(files):
        with files[name].open("rb") as source:
            whole.update(f"{name}\0{hashlib.file_digest(source, 'sha256').hexdigest()}\n".encode())
    return whole.hexdigest()


def _read(scan: _Scan, name: str) -> None:
    """Reads an XML file of the model, and those that it includes."""
    path = scan.texts[name] = _inside(scan.folder, name, name, 0)
    if path.stat().st_size > _MOST_XML_BYTES:
        raise UserError(f"{path} is larger than {_MOST_XML_BYTES / 1e6:.0f} MB")
    here = posixpath.dirname(name)
    scan.bases.add(here)
    parser = expat.ParserCreate()
    copies, included = [1], []  # how often what stands here is in the model

    def begin(tag: str, attributes: dict[str, str]) -> None:
        times = copies[-1] * (_count(attributes) if tag in ("replicate", "composite", "flexcomp") else 1)
        copies.append(times)
        scan.elements += times
        scan.bodies += times * (tag in ("body", "composite", "flexcomp"))
        if scan.bodies > MOST_BODIES:
            raise UserError(f"{path} has more than {MOST_BODIES} bodies; a robot here has at most so many")
        if scan.elements > _MOST_ELEMENTS:
            raise UserError(f"{path} has more than {_MOST_ELEMENTS:,} elements; a robot here has fewer")
        line = parser.CurrentLineNumber
        for key, value in attributes.items():
            if key.endswith("dir") and value:
                where = _checked(value, path, line)
                scan.bases |= {posixpath.normpath(posixpath.join(base, where)) for base in ("", here)}
            elif "file" in key.lower() and value:
                file = _checked(value, path, line)
                if tag == "include" or (tag == "model" and file.endswith(".xml")):
                    included.append((file, line))
                else:
                    scan.named.append((file, name, line))

    def end(_: str) -> None:
        copies.pop()

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    try:
        parser.Parse(path.read_bytes(), True)
    except expat.ExpatError as error:
        raise UserError(f"{path} is no XML: {error}") from None
    for file, line in included:
        top = posixpath.dirname(scan.main)
        for place in _places(scan, file, {top, here}, name, line):
            if place not in scan.texts:
                _inside(scan.folder, place, name, line)
                _read(scan, place)


def _places(scan: _Scan, name: str, bases: set[str], where: str, line: int) -> list[str]:
    """Where in the folder a file may be that is named so; nothing outside it is even looked for."""
    places = sorted({posixpath.normpath(posixpath.join(base, name)) for base in bases})
    inside = [place for place in places if place.split("/")[0] != ".."]
    there = [place for place in inside if (scan.folder / place).is_file()]
    if not there:
        if len(inside) < len(places):
            _inside(scan.folder, name if name.startswith("..") else places[0], where, line)
        raise UserError(f"{where} names {name[:80]} (line {line}), which is not in {scan.folder}")
    return there


def _count(attributes: dict[str, str]) -> int:
    """Copies that an element makes of what is in it."""
    numbers = [int(word) for word in attributes.get("count", "").split() if word.isdecimal()]
    product = 1
    for number in numbers:
        product *= max(1, min(number, _MOST_ELEMENTS + 1))
    return min(product, _MOST_ELEMENTS + 1)


def _checked(name: str, path: Path, line: int) -> str:
    """A file's name as it may stand in a model, with plain slashes."""
    name = name.replace("\\", "/")
    if name.startswith(("/", "~")) or ":" in name:
        raise UserError(
            f"{path} names {name[:80]} (line {line}), a place of one computer; put that file beside the "
            "model and name it from there"
        )
    return name


def _inside(folder: Path, name: str, where: str, line: int) -> Path:
    """The real place of a file of the model, which is in its folder."""
    name = posixpath.normpath(name)
    path = (folder / name).resolve()
    parts = name.split("/")
    if parts[0] == ".." or not path.is_relative_to(folder):
        raise UserError(
            f"{where} names {name[:80]} (line {line}), which is outside the model's folder {folder}; say "
            "which folder holds it all with --folder, or put the file beside the model"
        )
    if any(part.startswith(".") or not _PLAIN.fullmatch(part) for part in parts):
        raise UserError(f"{where} names {name[:80]!a} (line {line}); no file of a model begins with a dot")
    return path
