"""What may be wrong with a video that is to become a demo, each in one sentence.

Each check comes as early as it can: options before the file is opened, size and length by the
container's word before hours of video are decoded, the rest while the frames go by.

Shapes: H rows, W columns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from onedemo.demos.video import VideoReader
from onedemo.errors import UserError

MAX_SECONDS = 60.0
MAX_FRAMES = 200_000
"""Of the video that comes in, also of the part that is not used: nearly two hours at 30 a second."""
MIN_SIDE, MAX_SIDE = 16, 4096
"""Pixels, of the video that comes in."""


class SourceWatch:
    """Watches the source's frames go by, to say afterwards what was wrong with them."""

    def __init__(self, path: Path, reader: VideoReader, *, start: float, end: float | None) -> None:
        self._path, self._reader, self._start, self._end = path, reader, start, end
        self._seen = self._used = 0
        self._seconds = 0.0

    def frames(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """The reader's frames; raises UserError once they prove too long."""
        for seconds, frame in self._reader.frames(self._start):
            self._seen += 1
            if self._seen > MAX_FRAMES:
                raise UserError(f"{self._path} has more than {MAX_FRAMES} frames; cut out the part to use")
            self._seconds = seconds + 1 / self._reader.info.fps
            stop = self._seconds if self._end is None else min(self._seconds, self._end)
            self._used += seconds >= self._start and (self._end is None or seconds < self._end)
            if stop - self._start > MAX_SECONDS + 2 / self._reader.info.fps:
                raise _too_long(self._path)
            yield seconds, frame

    def check_whole(self, count: int) -> None:
        """Raises UserError if the source broke off or too little of it is left."""
        info = self._reader.info
        if not self._seen:
            raise UserError(
                f"{self._path} cannot be decoded: it is damaged, or needs more memory than a video may; "
                "convert it to a plain mp4 and try again"
            )
        reached_end = self._end is None or self._seconds < self._end
        # Both must fall short: the frame count of some containers is only length times rate.
        if reached_end and self._seen < 0.9 * info.frames and self._seconds < 0.9 * info.seconds:
            raise UserError(
                f"{self._path} breaks off: only {self._seen} of {info.frames} frames can be read; "
                f"give a whole file, or --end {math.floor(self._seconds * 10) / 10:g} to use these"
            )
        if self._seen and self._start >= self._seconds:
            raise UserError(
                f"--start {self._start:g} is past the end of {self._path}, which lasts {self._seconds:.2f} s"
            )
        if self._used < 2 or count < 2:
            raise UserError(
                f"a demo needs at least 2 frames, and {self._path} gives {min(self._used, count)} "
                "between --start and --end"
            )


def check_options(
    *,
    start: float | None,
    end: float | None,
    crop: tuple[int, int, int, int] | None,
    fps: float,
) -> None:
    """Raises UserError for options that are wrong for any video."""
    if not 1 <= fps <= 120:
        raise UserError(f"--fps must be from 1 to 120 frames per second, got {fps:g}")
    if start is not None and not (math.isfinite(start) and start >= 0):
        raise UserError(f"--start must be 0 seconds or more, got {start:g}")
    if end is not None and not end > (start or 0.0):
        raise UserError(f"--end must be later than --start ({start or 0:g} s), got {end:g}")
    if crop is not None and (min(crop[:2]) < 0 or min(crop[2:]) < MIN_SIDE):
        raise UserError(
            "--crop is x,y,width,height in pixels, with x and y 0 or more and at least "
            f"{MIN_SIDE} x {MIN_SIDE} pixels, got {','.join(map(str, crop))}"
        )


def check_size(path: Path, width: int, height: int, crop: tuple[int, int, int, int] | None) -> None:
    """Raises UserError if the picture is too large or small, or the crop reaches outside it."""
    if max(width, height) > MAX_SIDE:
        raise UserError(
            f"{path} is {width} x {height} pixels; a side may have at most {MAX_SIDE}: scale it down first"
        )
    if crop is None and min(width, height) < MIN_SIDE:
        raise UserError(f"{path} is {width} x {height} pixels; at least {MIN_SIDE} x {MIN_SIDE} are needed")
    if crop is not None and (crop[0] + crop[2] > width or crop[1] + crop[3] > height):
        raise UserError(
            f"--crop {','.join(map(str, crop))} reaches outside the picture, "
            f"which is {width} x {height} pixels"
        )


def check_length(path: Path, seconds: float, *, start: float, end: float | None) -> None:
    """By the container's own word, before hours of video are decoded."""
    if not seconds:
        return
    if start >= seconds + 1:
        raise UserError(f"--start {start:g} is past the end of {path}, which lasts {seconds:.2f} s")
    # A second of slack: a container may count wrong, and each frame's own stamp is checked later.
    if min(seconds, math.inf if end is None else end) - start > MAX_SECONDS + 1:
        raise _too_long(path)


def _too_long(path: Path) -> UserError:
    return UserError(f"{path} is longer than {MAX_SECONDS:g} s; choose a part of it with --start and --end")


def read_crop(text: str) -> tuple[int, int, int, int]:
    """What somebody has typed as the part of a video to use: x, y, width, height in pixels.

    Raises:
        ValueError: If it is not four whole numbers.
    """
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"must be four whole numbers X,Y,W,H, got {text!r}") from None
    return x, y, width, height
