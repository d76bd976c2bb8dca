"""Files that are either whole or not there."""

from __future__ import annotations

import fcntl
import io
import logging
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO

from onedemo.core.directories import make_directory, sync_directory
from onedemo.core.shared_disks import heartbeat, is_shared, refuse_if_elsewhere
from onedemo.errors import UserError

log = logging.getLogger("onedemo")

_BLOCK = 1 << 20
ON_SHARED = (
    "{} is on a network file system: only one computer at a time may use it, and a power cut may cost what "
    "was rated last; a disk of this computer is the place for a data directory"
)


def write_atomic(path: Path, data: bytes | Iterable[bytes], *, sync: bool = True) -> None:
    """Writes a file to a temporary name, syncs and renames it: a reader never sees half of it.

    It is as open to others as the directory that it lies in.

    Args:
        path: Where; missing directories are made.
        data: The whole content, in one piece or in several.
        sync: As ``replacing``.

    Raises:
        OSError: If the disk is full or the directory not writable; the old file is then untouched.
    """
    with replacing(path, sync=sync) as temporary, temporary.open("wb") as file:
        for block in (data,) if isinstance(data, bytes) else data:
            file.write(block)


@contextmanager
def replacing(path: Path, suffix: str = "", *, sync: bool = True) -> Iterator[Path]:
    """A temporary name for a file that is written by others: synced and renamed when the block ends well.

    Args:
        path: Where; missing directories are made.
        suffix: What the temporary name ends in, for writers that go by it.
        sync: Whether it must survive a power cut; False for what can be made again and has a checksum.

    Raises:
        OSError: As ``write_atomic``.
    """
    make_directory(path.parent)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb") as file:  # whoever wrote it may have put another file under that name
            os.fchmod(file.fileno(), _as_open_as(path.parent))
            if sync:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if sync:
        sync_directory(path.parent)


def _as_open_as(directory: Path) -> int:
    """The mode of a new file: readable, as far as the umask has it, by those who may enter its directory."""
    return 0o600 | (0o666 & ~umask() & 6 * (directory.stat().st_mode & 0o011))


def copy_synced(source: IO[bytes], path: Path, seen: Callable[[bytes], object] = lambda _: None) -> None:
    """Copies a stream into a new file that only its owner may read, block by block, and syncs it.

    Args:
        source: Read to its end.
        path: Must not be there.
        seen: Called with every block.

    Raises:
        OSError: If it cannot be written.
    """
    with open(path, "xb", opener=private_opener) as out:
        while block := source.read(_BLOCK):
            seen(block)
            out.write(block)
        out.flush()
        os.fsync(out.fileno())


def private_opener(path: str, flags: int) -> int:
    """For ``open``: a file that is made is for its owner alone."""
    return os.open(path, flags, 0o600)


def archive_fault(data: bytes) -> str:
    """What is wrong with a file of arrays (NPZ) or weights (torch); "" if nothing is.

    Both kinds are ZIP archives, which hold a checksum of each part.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            part = archive.testzip()
    except (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError, OSError) as error:
        return str(error) or "it ends too early"
    return f"the checksum of its part {part} is wrong" if part is not None else ""


def read_whole(path: Path, fault: Callable[[bytes], str] = archive_fault) -> bytes | None:
    """A file as it was written; None if there is none, or a damaged one, which is then set aside.

    Args:
        path: Which. A damaged one becomes ``NAME.damaged``, so that another can take its place.
        fault: Finds out what is wrong with its content; "" if nothing is.

    Raises:
        OSError: If it is there and cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    if found := fault(data):
        os.replace(path, path.with_name(f"{path.name}.damaged"))
        log.warning("%s is damaged (%s): set aside as %s.damaged", path, found, path.name)
        return None
    return data


def sealed(picture: bytes) -> bytes:
    """A JPEG with its checksum in a comment after its start, which others ignore (ITU-T T.81, B.2.4.5)."""
    note = _SEAL % zlib.crc32(picture)
    return picture[:2] + b"\xff\xfe" + (2 + len(note)).to_bytes(2, "big") + note + picture[2:]


def jpeg_fault(data: bytes) -> str:
    """What is wrong with a JPEG, "" if nothing is; unless ``sealed``, just whether it is empty or cut off."""
    if not data.startswith(b"\xff\xd8") or not data.endswith(b"\xff\xd9"):
        return "it is empty or cut off"
    end = 6 + len(_SEAL % 0)
    if not data[6:end].startswith(_SEAL.partition(b"%")[0]):
        return ""
    return "" if data == sealed(data[:2] + data[end:]) else "its checksum is wrong"


_SEAL = b"onedemo crc32 %08x"


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

    On a file system that other computers share, who holds it also says so in it (``shared_disks``).

    Args:
        path: The file; made if missing, and left there.
        wait: For another process to let go of it.

    Raises:
        UserError: If another process holds it, here or on another computer, and this one does not wait.
    """
    make_directory(path.parent)
    with open(path, "ab", opener=private_opener) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise UserError(
                f"another onedemo is working on {path.parent}; stop it, or choose another --run or --data-dir"
            ) from None
        if not is_shared(path):
            yield
            return
        if not wait:
            refuse_if_elsewhere(path)
            log.warning("%s", ON_SHARED.format(path.parent))
        with heartbeat(path):
            yield


@cache
def umask() -> int:
    """The permissions that new files of this process lack, as it was when first asked for."""
    try:
        line = next(line for line in Path("/proc/self/status").read_text().splitlines() if "Umask" in line)
        return int(line.split()[1], 8)
    except (OSError, StopIteration):  # elsewhere there is no way to ask without setting it for a moment
        mask = os.umask(0)
        os.umask(mask)
        return mask
