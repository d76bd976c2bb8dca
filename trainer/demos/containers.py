"""What a file is by its own bytes: no video at all, or one that was cut off before its end.

Nothing is decoded here: a few bytes are compared, and lengths are added up.
"""

from __future__ import annotations

import os
import re
import stat
import struct
from pathlib import Path
from typing import BinaryIO

from onedemo.errors import UserError

CONVERT = "ffmpeg -i x -c:v libx264 -pix_fmt yuv420p y.mp4"
"""What makes a plain video of nearly anything."""
_PICTURES = "make a video of them first: ffmpeg -framerate 30 -i %04d.png -pix_fmt yuv420p y.mp4"
_KINDS = (
    (rb"\s*(<!doctype\s+html|<html|<head|<body)", "a web page: download the video itself"),
    (rb"#EXTM3U|ffconcat|\[playlist\]|<\?xml[^>]*>\s*<(MPD|smil|playlist)|<MPD", "a list of other files"),
    (rb"version https://git-lfs", "a Git LFS pointer: fetch the file with git lfs pull"),
    (rb"PK\x03\x04|Rar!|7z\xbc\xaf|\x1f\x8b|BZh|\xfd7zXZ|ustar", "an archive: unpack it"),
    (rb"%PDF", "a PDF document"),
    (rb"....ftyp(heic|heix|mif1|avif)", "a single picture"),
    (rb"ID3|fLaC|RIFF....WAVE", "sound without a picture"),
    (rb"\x7fELF|MZ", "a program"),
    (rb"[\t\n\r\x20-\x7e]{64}", "a text file"),
)
"""How files begin that people give by mistake; a YUV4MPEG video begins with text, too."""


def check_file(path: Path) -> None:
    """Raises UserError, with what helps, if a path is not that of a file that may be a video."""
    text = str(path)
    if re.match(r"[a-z][a-z0-9+.-]+:/", text, re.IGNORECASE) and not path.exists():
        address = text.replace(":/", "://", 1)  # a path has lost the second one
        raise UserError(f"{address} is a web address: download the video and give the file")
    if re.fullmatch(r"\d+|/dev/video\d*", text) and not path.is_file():
        raise UserError(f"{text} is a camera: record a video with it and give the file")
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        if isinstance(error, PermissionError):
            raise UserError(f"{text} may not be read: change its owner or its permissions") from None
        if re.search(r"[*?]|%\d*d", path.name):
            raise UserError(f"{text} stands for several files; if they are pictures, {_PICTURES}") from None
        raise UserError(f"there is no video file at {text}") from None
    if stat.S_ISDIR(status.st_mode):
        raise UserError(f"{text} is a folder: give one video file; if it holds pictures, {_PICTURES}")
    if not stat.S_ISREG(status.st_mode):
        raise UserError(f"{text} is a device: record a video with it and give the file")
    if not status.st_size:
        raise UserError(f"{text} is empty (0 bytes): copy or download it again")
    try:
        with path.open("rb") as file:
            head = file.read(512)
    except OSError as error:
        raise UserError(f"{text} cannot be read: {error.strerror}") from None
    for pattern, kind in _KINDS:
        if re.match(pattern, head, re.DOTALL | re.IGNORECASE) and not head.startswith(b"YUV4MPEG2"):
            raise UserError(f"{text} is {kind}; a demo is made of one video file")


def missing_bytes(file: BinaryIO) -> int:
    """How many bytes a file lacks by the lengths that its container gives; 0 if it is whole or says nothing.

    Args:
        file: Open for reading; left anywhere.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    head = file.read(64)
    if head[:4] in (b"RIFF", b"RIFX"):
        said = struct.unpack("<I" if head[:4] == b"RIFF" else ">I", head[4:8])[0]
        whole = said + 8 if said else 0
    elif head[:4] == b"\x1aE\xdf\xa3":
        whole = _matroska(file)
    elif re.match(rb"....(ftyp|moov|mdat|wide|free|skip|pnot)", head, re.DOTALL):
        whole = _boxes(file, size)
    else:
        whole = 0
    return max(0, whole - size)


def _boxes(file: BinaryIO, size: int) -> int:
    """Where the last box of an mp4 ends."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        head = file.read(16)
        length = struct.unpack(">I", head[:4])[0]
        if length == 1 and len(head) == 16:
            length = struct.unpack(">Q", head[8:])[0]
        if length < 8:  # 0: to the end of the file, whatever it is
            return 0
        at += length
    return at


def _matroska(file: BinaryIO) -> int:
    """Where a Matroska or WebM file's one segment ends; 0 if it was recorded live and does not say."""
    file.seek(4)
    header = _length(file)
    if header is None:
        return 0
    file.seek(header, os.SEEK_CUR)
    if file.read(4) != b"\x18S\x80g":
        return 0
    segment = _length(file)
    return 0 if segment is None else file.tell() + segment


def _length(file: BinaryIO) -> int | None:
    """The length of a Matroska element; None where it is marked unknown."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    more = 8 - first[0].bit_length()
    value = (first[0] & (0x7F >> more)) << 8 * more | int.from_bytes(file.read(more), "big")
    return None if value == (1 << 7 * (more + 1)) - 1 else value
