"""File systems that several computers share, and who works on a directory of one.

Locks of one computer are often unseen by another there, and SQLite's write-ahead log works on one computer
alone. So whoever holds a lock file on such a file system writes into it who it is, and a number that goes
up: what another computer sees going up belongs to somebody who is alive.
"""

from __future__ import annotations

import itertools
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeGuard

from onedemo.errors import UserError

BEAT_S = 5.0
"""Between two heartbeats."""
WATCH_S = 30.0
"""Until somebody on another computer whose number stays the same is taken for dead. A network file system
may show a file as it was up to 20 s ago."""
_NETWORK = (
    "9p", "afs", "beegfs", "ceph", "cifs", "davfs", "gpfs", "glusterfs", "lustre", "ncpfs", "nfs", "nfs4",
    "smb3", "smbfs", "fuse.ceph", "fuse.davfs", "fuse.gcsfuse", "fuse.glusterfs", "fuse.rclone", "fuse.s3fs",
    "fuse.sshfs", "fuse.vmhgfs-fuse", "prl_fs", "vboxsf", "virtiofs",
)  # fmt: skip


def file_system(path: Path, mounts: str | None = None) -> str:
    """The kind of file system that a path is on, as Linux calls it; "" where that cannot be told.

    Args:
        path: Need not be there.
        mounts: What to read instead of ``/proc/self/mountinfo``.
    """
    if mounts is None:
        try:
            mounts = Path("/proc/self/mountinfo").read_text(errors="replace")
        except OSError:
            return ""
    real, best, found = os.path.realpath(path), "", ""
    for line in mounts.splitlines():
        before, _, after = line.partition(" - ")
        place, kind = before.split(" ")[4].encode().decode("unicode_escape"), after.split(" ")[0]
        inside = real == place or real.startswith(place.rstrip("/") + "/")
        if inside and len(place) >= len(best):  # of two at one place the later one is seen
            best, found = place, kind
    return found


def is_shared(path: Path) -> bool:
    """Whether other computers may be working on the same files."""
    return file_system(path) in _NETWORK


def refuse_if_elsewhere(*locks: Path, watch_s: float | None = None) -> None:
    """Waits until nobody on another computer can be at work with these lock files: once for all of them.

    Returns at once if nobody has written into them, or somebody on this computer did. What somebody left
    who has died is taken out, so that it is waited for once.

    Args:
        locks: Of one directory.
        watch_s: Seconds; ``WATCH_S`` if not given.

    Raises:
        UserError: If somebody is at work.
    """
    watch_s = WATCH_S if watch_s is None else watch_s
    left = {lock: found for lock in locks if _is_elsewhere(found := _read(lock))}
    until = time.monotonic() + watch_s
    while left and time.monotonic() < until:
        time.sleep(min(1.0, watch_s / 10))
        for lock, before in left.items():
            if (now := _read(lock)) != before and _is_elsewhere(now):
                raise UserError(
                    f"a onedemo on the computer {str(now.get('host'))[:80]!a} (process {now.get('process')}) "
                    f"works on {lock.parent}, and two on one network directory destroy the database; "
                    "stop that one first"
                )
    for lock, before in left.items():
        if _read(lock) == before:
            with suppress(OSError):
                os.truncate(lock, 0)


def _is_elsewhere(found: dict | None) -> TypeGuard[dict]:
    """Whether a lock file tells of another computer, or of one before it was started again."""
    return bool(found) and found.get("kernel") != _kernel()


@contextmanager
def heartbeat(lock: Path, *, every_s: float = BEAT_S) -> Iterator[None]:
    """Says in a lock file that this process is alive, for as long as the block lasts."""
    done = threading.Event()
    _write(lock, 0)

    def beat() -> None:
        for number in itertools.count(1):
            if done.wait(every_s):
                return
            with suppress(OSError):  # the disk may be full for a while
                _write(lock, number)

    thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(timeout=every_s)
        with suppress(OSError):
            os.truncate(lock, 0)


def _write(lock: Path, number: int) -> None:
    about = {"host": socket.gethostname(), "kernel": _kernel(), "process": os.getpid(), "beat": number}
    handle = os.open(lock, os.O_WRONLY)
    try:
        os.pwrite(handle, json.dumps(about).encode().ljust(300), 0)
        os.fsync(handle)
    finally:
        os.close(handle)


def _read(lock: Path) -> dict | None:
    try:
        found = json.loads(lock.read_bytes()[:1000] or b"null")
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _kernel() -> str:
    """Of this start of this computer; all its containers share it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return socket.gethostname()
