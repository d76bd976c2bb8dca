"""A video of unknown origin is decoded in a process of its own, with limits on what it may take.

Decoders are large, written in C, and fed by strangers. The process that serves the page never opens such
a file with them: a child does, and sends back plain pixels through a pipe, which are counted and measured
again here. The child is a limited process, not a sandbox: it still runs as the same user.

What comes through the pipe: ``S`` with width and height, then ``F`` with the pixels of one frame, any
number of times, then ``D``; or at any time ``E`` and a sentence.

Shapes: H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np

from onedemo.demos.import_checks import MAX_SECONDS, SourceWatch, check_length, check_size
from onedemo.demos.video import VideoReader, resample
from onedemo.errors import UserError

STORED_SIDE = 640
"""Pixels, of the longer side of what is stored: more than a clip ever shows."""
_FORMATS = (
    "mov,mp4,matroska,webm,avi,gif,mjpeg,mpegts,mpeg,mpegvideo,h264,hevc,flv,asf,ogg,jpeg_pipe,png_pipe"
)
"""What may be inside. Playlists are left out: they make the decoder open other files and addresses."""
_SIZE = struct.Struct("<HH")
_MAX_SENTENCE = 2000
"""Bytes of a complaint that are read."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """What decoding one video may take."""

    memory: int = 2 << 30
    """Bytes of address space; Python and OpenCV without a video take 0.6 GB of it."""
    cpu_seconds: int = 300
    """Of all its threads together."""
    wall_seconds: float = 300
    """From its start to its last frame."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Options:
    """Which part of a video is wanted, and how, as checked by ``onedemo.demos.import_checks``."""

    start: float | None = None
    """Seconds."""
    end: float | None = None
    """Seconds."""
    crop: tuple[int, int, int, int] | None = None
    """x, y, width, height, pixels of the upright source."""
    mirror: bool = False
    """Swap left and right."""
    fps: float = 30.0
    """Frames per second."""

    @property
    def most_frames(self) -> int:
        """More than a whole demo can have."""
        return math.ceil((MAX_SECONDS + 3) * self.fps) + 2


def decode(path: Path, options: Options, limits: Limits | None = None) -> Generator[np.ndarray, None, None]:
    """The frames of a video as they are to be stored, decoded by a child that is ended with the iterator.

    Args:
        path: The file; nothing about it is trusted.
        options: The part that is wanted.
        limits: What the child may take; the defaults if None.

    Yields:
        Frames at the rate wanted, (H, W, 3), uint8 RGB, all of one even size, at most 640 px long.

    Raises:
        UserError: If it is no usable video, or takes more than it may; frames may have come before.
    """
    limits = limits or Limits()
    root = str(Path(__file__).resolve().parents[2])
    told = json.dumps([str(path.resolve()), _plain(options), limits.memory, limits.cpu_seconds])
    child = subprocess.Popen(
        [sys.executable, "-P", "-B", "-m", "onedemo.demos.sandboxed_decoder", told],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd="/",
        # Nothing of this process's surroundings, least of all a secret in a variable.
        env={
            "PYTHONPATH": root,
            "OPENBLAS_NUM_THREADS": "1",
            "OPENCV_FFMPEG_LOGLEVEL": "-8",
            "OPENCV_FFMPEG_CAPTURE_OPTIONS": f"protocol_whitelist;file|format_whitelist;{_FORMATS}",
        },
        start_new_session=True,
    )
    late = threading.Event()

    def stop() -> None:
        late.set()
        child.kill()

    timer = threading.Timer(limits.wall_seconds, stop)
    timer.daemon = True
    timer.start()
    assert child.stdout is not None
    try:
        whole = yield from _receive(path, child.stdout, options)
        if not whole:
            child.stdout.close()  # or it may wait for ever to be read
            with suppress(subprocess.TimeoutExpired):
                child.wait(timeout=2)
            raise _explain(path, child.poll(), late.is_set(), limits)
    finally:
        timer.cancel()
        child.kill()
        child.stdout.close()
        child.wait()


def _receive(path: Path, pipe: IO[bytes], options: Options) -> Generator[np.ndarray, None, bool]:
    """Yields what the child sends as long as it keeps to the agreement; returns whether it was whole."""
    size = None
    for count in range(options.most_frames + 2):
        tag = pipe.read(1)
        if tag == b"S" and count == 0:
            width, height = _SIZE.unpack(pipe.read(_SIZE.size).ljust(_SIZE.size, b"\0"))
            if not (2 <= width <= STORED_SIDE and 2 <= height <= STORED_SIDE) or width % 2 or height % 2:
                return False
            size = (height, width, 3)
        elif tag == b"F" and size:
            pixels = pipe.read(math.prod(size))
            if len(pixels) != math.prod(size):
                return False
            yield np.frombuffer(pixels, np.uint8).reshape(size)
        elif tag == b"E":
            sentence = pipe.read(_MAX_SENTENCE).decode("utf-8", "replace")
            raise UserError("".join(c if c.isprintable() else " " for c in sentence).strip())
        else:
            return tag == b"D" and size is not None
    return False


def _explain(path: Path, code: int | None, late: bool, limits: Limits) -> UserError:
    """Why a child ended before it was done."""
    if late or code == -signal.SIGXCPU:
        allowed = limits.wall_seconds if late else limits.cpu_seconds
        return UserError(
            f"{path} takes longer than {allowed:g} s to decode; scale it down, or give a shorter part of it"
        )
    return UserError(
        f"{path} cannot be decoded: it is damaged, or needs more memory than a video may; "
        "convert it to a plain mp4 and try again"
    )


# --- in the child ---------------------------------------------------------------------------------


def shaped_frames(path: Path, options: Options) -> Iterator[np.ndarray]:
    """The same frames, decoded in this process: for files that are trusted, and for the child.

    Raises:
        UserError: If the video is unusable; frames may have come before.
    """
    start, end = options.start or 0.0, options.end
    with VideoReader(path) as reader:
        check_size(path, reader.info.width, reader.info.height, options.crop)
        check_length(path, reader.info.seconds, start=start, end=end)
        watch = SourceWatch(path, reader, start=start, end=end)
        count = 0
        for frame in resample(
            watch.frames(),
            fps=options.fps,
            period=1 / reader.info.fps,
            start=start,
            end=math.inf if end is None else end,
        ):
            yield _shape(frame, crop=options.crop, mirror=options.mirror)
            count += 1
        watch.check_whole(count)


def _shape(frame: np.ndarray, *, crop: tuple[int, int, int, int] | None, mirror: bool) -> np.ndarray:
    """Crops, mirrors and scales one frame; sides come out even, as the codec wants them."""
    if crop is not None:
        x, y, w, h = crop
        frame = frame[y : y + h, x : x + w]
    if mirror:
        frame = frame[:, ::-1]
    height, width = frame.shape[:2]
    scale = min(1.0, STORED_SIDE / max(height, width))
    size = (max(2, round(width * scale / 2) * 2), max(2, round(height * scale / 2) * 2))
    if size == (width, height):
        return np.ascontiguousarray(frame)
    return cv2.resize(np.ascontiguousarray(frame), size, interpolation=cv2.INTER_AREA)


def _plain(options: Options) -> dict[str, Any]:
    return {name: getattr(options, name) for name in ("start", "end", "crop", "mirror", "fps")}


def _limit(memory: int, cpu_seconds: int) -> None:
    """Takes from this process what decoding does not need, for good."""
    for what, most in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, cpu_seconds),
        (resource.RLIMIT_FSIZE, 0),  # it writes no file, only into the pipe
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, 32),
    ):
        hard = resource.getrlimit(what)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        # The soft limit of the processor time alone says which limit it was: the hard one is SIGKILL.
        resource.setrlimit(what, (most, most + 1 if what == resource.RLIMIT_CPU else most))


def _main(told: str) -> None:
    path, options, memory, cpu_seconds = json.loads(told)
    _limit(memory, cpu_seconds)
    crop = options.pop("crop")
    out = os.fdopen(os.dup(1), "wb", buffering=1 << 16)
    try:
        frames = shaped_frames(Path(path), Options(**options, crop=tuple(crop) if crop else None))
        for number, frame in enumerate(frames):
            if number == 0:
                out.write(b"S" + _SIZE.pack(frame.shape[1], frame.shape[0]))
            out.write(b"F")
            out.write(frame.data)
        out.write(b"D")
    except UserError as error:
        out.write(b"E" + str(error).encode("utf-8", "replace")[:_MAX_SENTENCE])
    except BrokenPipeError:
        pass  # nobody wants the rest
    try:
        out.flush()
    except BrokenPipeError:
        os._exit(0)


if __name__ == "__main__":
    _main(sys.argv[1])
