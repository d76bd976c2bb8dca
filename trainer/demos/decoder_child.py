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
from itertools import islice
from typing import BinaryIO

import av.logging
import cv2
import numpy as np

from onedemo.demos.camera import Survey, View
from onedemo.demos.edits import Options
from onedemo.demos.frame_geometry import TURNS, turned
from onedemo.demos.import_checks import STORED_SIDE, SourceWatch, check_length, check_size
from onedemo.demos.resampling import arranged, resample
from onedemo.demos.sandboxed_decoder import LENGTH, LOOK, MAX_SENTENCE, SIZE
from onedemo.demos.source import Shown, Source
from onedemo.errors import UserError

_TINY = b"YUV4MPEG2 W16 H16 F10:1 It C420jpeg\n" + (b"FRAME\n" + bytes(16 * 16 * 3 // 2)) * 4
"""An interlaced video."""
_ROOM = 192 << 20
"""Bytes of frames that wait until their turn comes, where the last are the first or all come again."""


def shaped_frames(
    file: BinaryIO, name: str, options: Options, warn: Callable[[str], object] = lambda _: None
) -> Iterator[np.ndarray]:
    """The same frames, decoded in this process: for files that are trusted, and for the child.

    Args:
        file: Open for reading, and able to seek: what cannot be done in one go is gone through again.
        name: What sentences call it.
        options: The part that is wanted, and how.
        warn: Called at the end with each sentence about what is not as it should be, though usable.

    Raises:
        UserError: If the video is unusable; frames may have come before.
    """
    film = _Film(file, name, options)
    film.survey()
    if not options.reverse and options.loop == 1:
        count = 0
        for count, frame in enumerate(film.frames(), 1):  # noqa: B007
            yield frame
        film.check(count)
    else:
        yield from arranged(film.frames, film.check, reverse=options.reverse, room=_ROOM)
    for sentence in film.warnings:
        warn(sentence)


class _Film:
    """A video on its way in, gone through as often as what is done to it asks for."""

    def __init__(self, file: BinaryIO, name: str, options: Options) -> None:
        self._file, self._name, self._options = file, name, options
        self._view = View(box=options.crop)
        self._watch: SourceWatch | None = None
        self._size = (0, 0)
        self.warnings: list[str] = []
        """Sentences about what is not as it should be, though usable."""

    def survey(self) -> None:
        """Finds what is to be held still, or followed."""
        options, survey, before = self._options, None, None
        if not (options.track or options.stabilise):
            return
        for shown in self._shown():
            if shown is before:
                continue
            before = shown
            picture = shown[1]()
            survey = survey or Survey(
                self._name, (picture.shape[1], picture.shape[0]), crop=options.crop, track=options.track,
                stabilise=options.stabilise, speed=options.speed,
            )  # fmt: skip
            survey.see(shown[0], picture)
        if survey is not None:
            self._view = survey.view(self.warnings.append)

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[np.ndarray]:
        """The frames from one number up to another, in the order of the video."""
        before, frame = None, np.empty((0, 0, 3), np.uint8)
        for shown in islice(self._shown(), first, last):
            if shown is not before:  # one that stays is decoded once
                before = shown
                seconds, picture = shown
                frame = _shape(self._view.cut(seconds, picture()), mirror=self._options.mirror)
                self._size = frame.shape[1], frame.shape[0]
            yield frame

    def check(self, count: int) -> int:
        """Told how many frames there are, says how often they are wanted; raises UserError if it is amiss."""
        assert self._watch is not None
        times = self._options.times(count) if count else 1
        self._watch.check_whole(count, self._options.fps, times)
        self.warnings += self._watch.warnings(*self._size)
        return times

    def _shown(self) -> Iterator[tuple[float, Callable[[], np.ndarray]]]:
        """When the picture of each frame comes in the video, seconds, and what gives it, turned."""
        options, turn = self._options, TURNS[self._options.rotate]
        start, end = options.start or 0.0, options.end
        with Source(self._file, self._name) as source:
            size = (source.width, source.height) if turn[0] else (source.height, source.width)
            check_size(self._name, *size, options.crop)
            check_length(self._name, source.seconds, start=start, end=end, speed=options.speed)
            self._watch = SourceWatch(self._name, source, start=start, end=end, speed=options.speed)
            pictures = (
                (seconds, (seconds, lambda picture=picture: turned(picture(), turn)))
                for seconds, picture in self._watch.frames()
            )
            yield from resample(
                pictures, fps=options.fps, lasts=self._watch.last_stays, start=start,
                end=math.inf if end is None else end, speed=options.speed,
            )  # fmt: skip


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
        return source, _shape(shown.picture(), mirror=False)


def _shape(frame: np.ndarray, *, mirror: bool) -> np.ndarray:
    """Mirrors and scales one frame; sides come out even, as the codec wants them."""
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


def _rehearse(options: Options) -> None:
    """Surveys pictures of its own, with all that this loads: MuJoCo, too, if something is to be followed."""
    rows, columns = np.mgrid[:96, :128] // 8
    patches = np.repeat((rows * 101 + columns * 37)[..., None] % 200, 3, axis=2).astype(np.uint8)
    survey = Survey("", (128, 96), crop=None, track=options.track, stabilise=options.stabilise, speed=1.0)
    with suppress(UserError):
        for number in range(12):
            picture = np.roll(patches, number % 2, axis=1)
            picture[30:66, 8 * number + 8 : 8 * number + 24] = 255
            survey.see(number / 30, picture)
        survey.view(str).cut(0.1, patches)


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
    wanted = Options(**options, crop=tuple(crop) if crop else None)
    sum(1 for _ in shaped_frames(io.BytesIO(_TINY), "", Options()))  # what is loaded late is loaded now
    if (wanted.track or wanted.stabilise) and not look:
        _rehearse(wanted)
    _limit(memory, cpu_seconds)
    try:
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
