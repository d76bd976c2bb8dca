"""What may be wrong with a video that is to become a demo, each in one sentence.

Each check comes as early as it can: size and length by the container's word before hours of video are
decoded, the rest while the pictures go by, and at last whether what was stored shows what it should. Options
that are wrong for any video are told by ``edits``.

Shapes: H rows, W columns; pictures are uint8 RGB.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import cv2
import numpy as np

from onedemo.demos.containers import CONVERT
from onedemo.errors import UserError

if TYPE_CHECKING:
    from onedemo.demos.source import Source

MAX_SECONDS = 60.0
MIN_SECONDS = 0.3
"""Of a demo: a clip is as long."""
MAX_FRAMES = 200_000
"""Of the video that comes in, as far as it has to be decoded: nearly two hours at 30 a second."""
MIN_SIDE, MAX_SIDE = 16, 4096
"""Pixels, of the video that comes in."""
STORED_SIDE = 640
"""Pixels, of the longer side of what is stored: more than a clip ever shows."""
_FEW_A_SECOND = 19.5
_SMALL_SIDE = 120
"""Pixels, of the shorter side of what is stored."""
_BROKEN = 0.1
"""Share of pictures that cannot be decoded from which on a video is refused."""
_LITTLE_REST = 0.5
"""Seconds: sound usually ends a little after the picture; only a longer rest is a still end."""
_CELL = 12
"""Pixels, of which one is made of a thumbnail: so many that compression does not show."""
_STILL = 6
"""Largest difference of two thumbnails, of 255, that compression makes of the same picture."""
_OTHER = 20
"""Mean difference of two thumbnails, of 255, that no compression makes."""


class SourceWatch:
    """Watches the source's pictures go by, to say afterwards what was wrong with them."""

    def __init__(
        self, name: str, source: Source, *, start: float, end: float | None, speed: float = 1.0
    ) -> None:
        self._name, self._source, self._start, self._end, self._speed = name, source, start, end, speed
        self._seen = self._used = 0
        self._first = self._last = self._seconds = 0.0

    def frames(self) -> Iterator[tuple[float, Callable[[], np.ndarray]]]:
        """When each picture comes, and what gives it; raises UserError once they prove too long."""
        for shown in self._source.frames(self._start):
            self._seen += 1
            if self._seen > MAX_FRAMES:
                raise UserError(f"{self._name} has more than {MAX_FRAMES} frames; cut out the part to use")
            self._last = shown.seconds
            self._seconds = shown.seconds + (shown.lasts or self._period(shown.seconds))
            self._used += self._seconds > self._start and (self._end is None or shown.seconds < self._end)
            self._check_length(shown.seconds)
            yield shown.seconds, shown.picture

    def last_stays(self) -> float:
        """How long the last picture stays on screen, seconds."""
        stays = self._source.stays()
        if stays > self._seconds + _LITTLE_REST:
            self._seconds = stays
        self._check_length(self._seconds)
        return self._seconds - self._last

    def check_whole(self, count: int, fps: float, times: int = 1) -> None:
        """Raises UserError if the source broke off, or too little of it is left, or too much is made of it.

        Args:
            count: Pictures that were taken.
            fps: Of them, a second.
            times: How often they are shown.
        """
        source = self._source
        reached_end = self._end is None or self._seconds < self._end
        # A file may lack a few bytes of an index and no picture.
        if reached_end and source.missing and self._seconds < 0.9 * source.whole / source.fps:
            raise UserError(
                f"{self._name} breaks off: only {self._seen} of {source.whole} frames can be read; "
                f"give a whole file, or --end {math.floor(self._seconds * 10) / 10:g} to use these"
            )
        if source.broken > _BROKEN * (self._seen + source.broken):
            raise UserError(
                f"{self._name} is damaged: {source.broken} of {self._seen + source.broken} frames cannot be "
                f"decoded; choose a whole part with --start and --end, or convert it: {CONVERT}"
            )
        if self._start >= self._seconds:
            raise UserError(
                f"--start {self._start:g} is past the end of {self._name}, which lasts {self._seconds:.2f} s"
            )
        if self._used < 2 or count < 2:
            raise UserError(
                f"a demo needs at least 2 frames, and {self._name} gives {min(self._used, count)} "
                f"between --start and --end{_at(self._speed)}"
            )
        seconds = count * times / fps
        if seconds < MIN_SECONDS - 0.5 / fps:
            raise UserError(
                f"a demo lasts at least {MIN_SECONDS:g} s, as long as a clip, and {self._name} gives "
                f"{seconds:.2f} s between --start and --end{_at(self._speed)}"
            )
        if times > 1 and seconds > MAX_SECONDS + 0.5 / fps:
            raise UserError(
                f"--loop {times} of {count / fps:.2f} s is {seconds:.0f} s, and a demo lasts at most "
                f"{MAX_SECONDS:g} s: --loop {max(1, math.floor(MAX_SECONDS * fps / count))} is the most here"
            )

    def warnings(self, width: int, height: int) -> list[str]:
        """What a person should know of a video that can be used, in sentences.

        Args:
            width: Of what is stored, pixels.
            height: Of it.
        """
        source, found = self._source, []
        if source.broken:
            found.append(f"{source.broken} of {self._seen + source.broken} frames cannot be decoded; the one "
                         "before each is shown in its place")  # fmt: skip
        if source.missing:
            found.append("the file is cut off before its end; what can be read is used")
        rate = self._speed * self._used / max(1e-9, min(self._seconds, self._end or math.inf) - self._start)
        if rate < _FEW_A_SECOND:
            found.append(
                f"it has {rate:.0f} frames a second{_at(self._speed)}; fast moves can be seen better with "
                "24 or more"
            )
        if min(width, height) < _SMALL_SIDE:
            found.append(f"the picture is only {width} x {height} pixels; details will be hard to see")
        return found

    def _period(self, seconds: float) -> float:
        """How long a picture stays of which the container does not say it: as long as those before."""
        if self._seen == 1:
            self._first = seconds
            return 1 / self._source.fps
        return max(1 / self._source.fps, (seconds - self._first) / (self._seen - 1))

    def _check_length(self, seconds: float) -> None:
        stop = seconds if self._end is None else min(seconds, self._end)
        if stop - self._start > MAX_SECONDS * self._speed + 1 / self._source.fps:
            raise _too_long(self._name, self._speed)


class StoredCheck:
    """Whether the pictures that were stored show what they should: those that came in, in order."""

    def __init__(self) -> None:
        self._given: list[np.ndarray] = []
        self._stored = 0

    def given(self, picture: np.ndarray) -> np.ndarray:
        """Notes the next picture that is to be stored, and returns it."""
        self._given.append(_thumb(picture))
        return picture

    def stored(self, picture: np.ndarray) -> None:
        """Compares the next picture that was stored.

        Raises:
            UserError: If it shows something else.
        """
        at, thumb = self._stored, _thumb(picture)
        self._stored += 1
        if at >= len(self._given) or cv2.absdiff(thumb, self._given[at]).mean() > _OTHER:
            raise UserError(f"frame {at} was not stored as it came in: is the disk full, or OpenCV damaged?")

    def check_pictures(self, name: str) -> None:
        """Raises UserError if nothing is to be seen, or nothing moves."""
        if max(np.ptp(thumb, axis=(0, 1)).max() for thumb in self._given) < 3:
            raise UserError(f"{name} shows one colour and nothing else; choose another part with --start and "
                            f"--end, or convert it: {CONVERT}")  # fmt: skip
        if max(cv2.absdiff(thumb, self._given[0]).max() for thumb in self._given) <= _STILL:
            raise UserError(f"{name} shows a still picture: nothing moves; choose another part with --start "
                            "and --end")  # fmt: skip


def _thumb(picture: np.ndarray) -> np.ndarray:
    size = [max(2, side // _CELL) for side in picture.shape[1::-1]]
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def check_size(name: str, width: int, height: int, crop: tuple[int, int, int, int] | None) -> None:
    """Raises UserError if the picture is too large, small or long, or the crop reaches outside it."""
    if max(width, height) > MAX_SIDE:
        raise UserError(
            f"{name} is {width} x {height} pixels; a side may have at most {MAX_SIDE}: scale it down first"
        )
    if crop is None and min(width, height) < MIN_SIDE:
        raise UserError(f"{name} is {width} x {height} pixels; at least {MIN_SIDE} x {MIN_SIDE} are needed")
    if crop is not None and (crop[0] + crop[2] > width or crop[1] + crop[3] > height):
        raise UserError(
            f"--crop {','.join(map(str, crop))} reaches outside the picture, "
            f"which is {width} x {height} pixels"
        )
    wide, high = crop[2:] if crop else (width, height)
    if min(wide, high) * STORED_SIDE < MIN_SIDE * max(wide, high):
        raise UserError(
            f"a picture of {wide} x {high} pixels is too narrow: one side may be at most "
            f"{STORED_SIDE // MIN_SIDE} times the other; keep a part of it with --crop"
        )


def check_length(name: str, seconds: float, *, start: float, end: float | None, speed: float = 1.0) -> None:
    """By the container's own word, before hours of video are decoded."""
    if not seconds:
        return
    if start >= seconds + 1:
        raise UserError(f"--start {start:g} is past the end of {name}, which lasts {seconds:.2f} s")
    # A second of slack: a container may count wrong, and each frame's own stamp is checked later.
    if min(seconds, math.inf if end is None else end) - start > MAX_SECONDS * speed + 1:
        raise _too_long(name, speed)


def _too_long(name: str, speed: float) -> UserError:
    return UserError(
        f"{name} is longer than {MAX_SECONDS:g} s{_at(speed)}; choose a part of it with --start and --end"
    )


def _at(speed: float) -> str:
    return "" if speed == 1 else f" at --speed {speed:g}"
