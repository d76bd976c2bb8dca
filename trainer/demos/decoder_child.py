"""The process that decodes a video of unknown origin: see ``onedemo.demos.sandboxed_decoder``.

It gets the file as its standard input, takes from itself whatever decoding does not need, and sends frames.
Only it imports the decoder.

Shapes: H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import io
import json
import math
import os
import resource
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import BinaryIO

import av.logging
import cv2
import numpy as np

from onedemo.demos.import_checks import STORED_SIDE, SourceWatch, check_length, check_size
from onedemo.demos.resampling import resample
from onedemo.demos.sandboxed_decoder import LENGTH, LOOK, MAX_SENTENCE, SIZE, Options
from onedemo.demos.source import Shown, Source
from onedemo.errors import UserError

_TINY = b"YUV4MPEG2 W16 H16 F10:1 It C420jpeg\n" + (b"FRAME\n" + bytes(16 * 16 * 3 // 2)) * 4
"""An interlaced video."""


def shaped_frames(
    file: BinaryIO, name: str, options: Options, warn: Callable[[str], object] = lambda _: None
) -> Iterator[np.ndarray]:
    """The same frames, decoded in this process: for files that are trusted, and for the child.

    Args:
        file: Open for reading.
        name: What sentences call it.
        options: The part that is wanted.
        warn: Called at the end with each sentence about what is not as it should be, though usable.

    Raises:
        UserError: If the video is unusable; frames may have come before.
    """
    start, end = options.start or 0.0, options.end
    with Source(file, name) as source:
        check_size(name, source.width, source.height, options.crop)
        check_length(name, source.seconds, start=start, end=end)
        watch = SourceWatch(name, source, start=start, end=end)
        count, before, shaped = 0, None, np.empty(0)
        for picture in resample(
            watch.frames(), fps=options.fps, lasts=watch.last_stays, start=start,
            end=math.inf if end is None else end,
        ):  # fmt: skip
            if picture is not before:  # one that stays is decoded once
                before, shaped = picture, _shape(picture(), crop=options.crop, mirror=options.mirror)
            yield shaped
            count += 1
        watch.check_whole(count, options.fps)
        for sentence in watch.warnings(*shaped.shape[1::-1]):
            warn(sentence)


def _look(file: BinaryIO, name: str, at: float) -> tuple[Source, np.ndarray]:
    """A video, and its frame at a moment, the last one if it has ended by then."""
    with Source(file, name) as source:
        check_size(name, source.width, source.height, (0, 0, source.width, source.height))
        shown: Shown | None = None
        for following in source.frames(at):
            if shown is not None and following.seconds > at + 1e-4:
                break
            shown = following
        if shown is None:
            raise UserError(f"{name} has no frame that can be decoded")
        return source, _shape(shown.picture(), crop=None, mirror=False)


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


def _resident() -> Callable[[], int]:
    """What says how many bytes of memory this process has taken; made while files can be opened."""
    if sys.platform != "linux":
        unit = 1 if sys.platform == "darwin" else 1024
        return lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    # Linux counts what its parent had taken as the most that a process ever took.
    pages, page = os.open("/proc/self/statm", os.O_RDONLY), resource.getpagesize()
    return lambda: int(os.pread(pages, 99, 0).split()[1]) * page


def _limit(memory: int, cpu_seconds: int) -> None:
    """Takes from this process what decoding does not need, for good."""
    taken = _resident()
    for what, most in (
        (resource.RLIMIT_CPU, cpu_seconds),
        (resource.RLIMIT_FSIZE, 0),  # it writes no file, only into the pipe
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, 0),  # what is open stays open; nothing else can be
    ):
        hard = resource.getrlimit(what)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        # The soft limit of the processor time alone says which limit it was: the hard one is SIGKILL.
        resource.setrlimit(what, (most, most + 1 if what == resource.RLIMIT_CPU else most))
    try:
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    except (ValueError, OSError):  # macOS has larger things mapped than any such limit
        threading.Thread(target=_watch_memory, args=(memory, taken), daemon=True).start()


def _watch_memory(memory: int, taken: Callable[[], int]) -> None:
    """Ends this process once it has taken more memory than it may."""
    while taken() < memory:
        time.sleep(0.02)
    os.write(2, b"MemoryError\n")
    os._exit(1)


def _main(told: str) -> None:
    path, options, memory, cpu_seconds, look = json.loads(told)
    crop = options.pop("crop")
    file, out = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb", buffering=1 << 16)
    cv2.setNumThreads(1)
    av.logging.set_level(None)
    sum(1 for _ in shaped_frames(io.BytesIO(_TINY), "", Options()))  # what is loaded late is loaded now
    _limit(memory, cpu_seconds)
    try:
        wanted = Options(**options, crop=tuple(crop) if crop else None)
        warnings: list[str] = []
        frames = shaped_frames(file, path, wanted, warnings.append)
        if look:
            source, picture = _look(file, path, wanted.start or 0.0)
            out.write(b"L" + LOOK.pack(source.width, source.height, source.seconds, source.fps))
            frames = iter((picture,))
        for number, frame in enumerate(frames):
            if number == 0:
                out.write(b"S" + SIZE.pack(frame.shape[1], frame.shape[0]))
            out.write(b"F")
            out.write(frame.data)
        for warning in (sentence.encode("utf-8", "replace")[:MAX_SENTENCE] for sentence in warnings):
            out.write(b"W" + LENGTH.pack(len(warning)) + warning)
        out.write(b"D")
    except UserError as error:
        out.write(b"E" + str(error).encode("utf-8", "replace")[:MAX_SENTENCE])
    except BrokenPipeError:
        pass  # nobody wants the rest
    with suppress(BrokenPipeError):
        out.flush()
    os._exit(0)  # what a decoder does while it is taken down is of no interest


if __name__ == "__main__":
    _main(sys.argv[1])
