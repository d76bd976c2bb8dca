"""A video of unknown origin is decoded in a process of its own, with limits on what it may take.

Decoders are large, written in C, and fed by strangers. The process that serves the page never opens such
a file with them: a child does, and sends back plain pixels through a pipe, which are counted and measured
again here. The child (``onedemo.demos.decoder_child``) is given the open file, and once it has loaded its
libraries it can open no other. It is a limited process, not a sandbox: it still runs as the same user.

What comes through the pipe: ``S`` with width and height, then ``F`` with the pixels of one frame, any
number of times, then ``W`` with a warning, at most a few times, then ``D``; or at any time ``E`` and a
sentence. Before ``S`` comes ``L``, with what the file is, if a look was asked for; then there is one frame.

Shapes: H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import math
import os
import re
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from onedemo.demos.containers import CONVERT
from onedemo.demos.edits import Options
from onedemo.demos.import_checks import STORED_SIDE
from onedemo.errors import UserError

DECODING = 2
"""Counted up whenever the same file with the same options gives other frames than before."""
SIZE = struct.Struct("<HH")
LOOK = struct.Struct("<HHdd")
LENGTH = struct.Struct("<H")
_MOST_WARNINGS = 8
MAX_SENTENCE = 2000
"""Bytes of a complaint that are read."""
_LIBRARIES = ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "DYLD_FALLBACK_LIBRARY_PATH")
_FEW_THREADS = {"OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1", "MALLOC_ARENA_MAX": "2"}
"""Else each core of the machine brings threads, and each thread an arena of 64 MB."""
_NO_GRAPHICS = {"MUJOCO_GL": "disable"}
"""MuJoCo, which comes with what finds a mover, would look for a graphics driver."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """What decoding one video may take."""

    memory: int = 2 << 30
    """Bytes: of address space where the system limits it (Python and the libraries without a video take
    0.8 GB of it), else of memory. The decoder's threads are of a fixed number, so it is the same on any
    machine."""
    cpu_seconds: int = 300
    """Of all its threads together."""
    wall_seconds: float = 300
    """From its start to its last frame."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """What a video of unknown origin is, before anything of it is chosen."""

    width: int
    """Pixels, upright and square."""
    height: int
    """Pixels."""
    seconds: float
    """By the container's word; 0 where it does not say."""
    fps: float
    """Frames per second, by its word."""
    picture: np.ndarray
    """The frame at the moment that was asked for, (H, W, 3), uint8 RGB, at most 640 px long."""


def look(path: Path, *, at: float = 0.0, limits: Limits | None = None) -> Look:
    """Looks at one frame of a video, and at what its container says; as ``decode``.

    Args:
        path: The file; nothing about it is trusted.
        at: Moment of the frame, seconds; past the end it is the last one.
        limits: As ``decode``.

    Raises:
        UserError: As ``decode``.
    """
    said: list[Any] = []
    frames = list(_run_child(path, Options(start=at), limits, look=True, note=said.append))
    if len(frames) != 1 or not said or not isinstance(said[0], tuple):
        raise UserError(f"{path} cannot be decoded; a plain video may help: {CONVERT}")
    width, height, seconds, fps = said[0]
    seconds = seconds if math.isfinite(seconds) and 0 <= seconds < 1e7 else 0.0
    return Look(width=width, height=height, seconds=seconds, fps=fps, picture=frames[0])


def decode(
    path: Path, options: Options, limits: Limits | None = None, warn: Callable[[str], object] = lambda _: None
) -> Generator[np.ndarray, None, None]:
    """The frames of a video as they are to be stored, decoded by a child that is ended with the iterator.

    Args:
        path: The file; nothing about it is trusted.
        options: The part that is wanted.
        limits: What the child may take; the defaults if None.
        warn: Called with each sentence about what is not as it should be, though usable, before the end.

    Yields:
        Frames at the rate wanted, (H, W, 3), uint8 RGB, all of one even size, at most 640 px long.

    Raises:
        UserError: If it is no usable video, or takes more than it may; frames may have come before.
    """
    return _run_child(path, options, limits, note=lambda said: warn(said) if isinstance(said, str) else None)


def _run_child(
    path: Path, options: Options, limits: Limits | None, *, look: bool = False,
    note: Callable[[Any], object],
) -> Generator[np.ndarray, None, None]:  # fmt: skip
    """The frames that a child sends; what it says besides, a tuple or a sentence, is given to ``note``."""
    limits = limits or Limits()
    if importlib.util.find_spec("resource") is None:
        raise UserError(
            "this system cannot limit what decoding a video takes; add videos on Linux or macOS "
            "(on Windows: in WSL 2)"
        )
    root = str(Path(__file__).resolve().parents[2])
    told = json.dumps([str(path), asdict(options), limits.memory, limits.cpu_seconds, look])
    surroundings = {name: os.environ[name] for name in _LIBRARIES if name in os.environ}
    complaints, complaining = os.pipe()
    os.set_blocking(complaints, False)
    os.set_blocking(complaining, False)  # a child that complains without end does not wait for a reader
    try:
        with path.open("rb") as file:
            child = subprocess.Popen(
                [sys.executable, "-P", "-B", "-m", "onedemo.demos.decoder_child", told],
                stdin=file,
                stdout=subprocess.PIPE,
                stderr=complaining,
                cwd="/",
                # Nothing of this process's surroundings, least of all a secret in a variable, but for
                # where a Python without a fixed place finds its library.
                env=surroundings | {"PYTHONPATH": root} | _FEW_THREADS | _NO_GRAPHICS,
                start_new_session=True,
            )
    except BaseException as error:
        os.close(complaints)
        if isinstance(error, OSError):
            raise UserError(f"{path} cannot be read: {error.strerror}") from error
        raise
    finally:
        os.close(complaining)
    late = threading.Event()

    def stop() -> None:
        late.set()
        child.kill()

    timer = threading.Timer(limits.wall_seconds, stop)
    timer.daemon = True
    timer.start()
    assert child.stdout is not None
    try:
        whole = yield from _receive(child.stdout, options, note)
        if not whole:
            child.stdout.close()  # or it may wait for ever to be read
            with suppress(subprocess.TimeoutExpired):
                child.wait(timeout=2)
            raise _explain(path, child.poll(), late.is_set(), limits, _last_line(complaints))
    finally:
        timer.cancel()
        child.kill()
        child.stdout.close()
        child.wait()
        os.close(complaints)


def _receive(
    pipe: IO[bytes], options: Options, note: Callable[[Any], object]
) -> Generator[np.ndarray, None, bool]:
    """Yields what the child sends as long as it keeps to the agreement; returns whether it was whole."""
    size, warnings = None, 0
    for _ in range(options.most_frames + 3 + _MOST_WARNINGS):
        tag = pipe.read(1)
        if tag == b"L" and size is None:
            note(LOOK.unpack(pipe.read(LOOK.size).ljust(LOOK.size, b"\0")))
        elif tag == b"W" and size and warnings < _MOST_WARNINGS:
            warnings += 1
            (length,) = LENGTH.unpack(pipe.read(LENGTH.size).ljust(LENGTH.size, b"\0"))
            note(_printable(pipe.read(min(length, MAX_SENTENCE))))
        elif tag == b"S" and size is None:
            width, height = SIZE.unpack(pipe.read(SIZE.size).ljust(SIZE.size, b"\0"))
            if not (2 <= width <= STORED_SIDE and 2 <= height <= STORED_SIDE) or width % 2 or height % 2:
                return False
            size = (height, width, 3)
        elif tag == b"F" and size:
            pixels = pipe.read(math.prod(size))
            if len(pixels) != math.prod(size):
                return False
            yield np.frombuffer(pixels, np.uint8).reshape(size)
        elif tag == b"E":
            raise UserError(_printable(pipe.read(MAX_SENTENCE)))
        else:
            return tag == b"D" and size is not None
    return False


def _printable(sentence: bytes) -> str:
    return "".join(c if c.isprintable() else " " for c in sentence.decode("utf-8", "replace")).strip()


def _last_line(complaints: int) -> str:
    """The last that the child said on its way out, as one printable line."""
    try:
        said = os.read(complaints, 1 << 16).decode("utf-8", "replace")
    except BlockingIOError:
        return ""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    return "".join(c if c.isprintable() else " " for c in lines[-1])[:300] if lines else ""


def _explain(path: Path, code: int | None, late: bool, limits: Limits, last: str) -> UserError:
    """Why a child ended before it was done."""
    if late or code == -signal.SIGXCPU:
        allowed = limits.wall_seconds if late else limits.cpu_seconds
        return UserError(
            f"{path} takes longer than {allowed:g} s to decode; scale it down, or give a shorter part of it"
        )
    _log.warning("the process that decodes %s ended with status %s: %s", ascii(str(path)), code, last)
    if re.search("MemoryError|[Cc]annot allocate|Insufficient memory|bad_alloc|ENOMEM", last):
        return UserError(
            f"{path} cannot be decoded: it needs more memory than a video may "
            f"({limits.memory >> 20} MB); scale it down: ffmpeg -i x -vf scale=1280:-2 -c:v libx264 y.mp4"
        )
    if last:
        why = f"the process that decodes it ended with: {last}"
    else:
        name = signal.Signals(-code).name if code is not None and code < 0 else f"status {code}"
        why = f"the process that decodes it ended with {name}, as damaged videos make it"
    return UserError(f"{path} cannot be decoded: {why}; a plain video may help: {CONVERT}")
