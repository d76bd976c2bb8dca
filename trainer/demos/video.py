"""Video files in and out: decoding with trustworthy time stamps, and writing WebM.

Written is VP8 in WebM: it decodes frame by frame as written and plays in every browser. VP9 through
OpenCV gives the same size and half a decibel more, in four times the time.

Shapes: n frames, H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from onedemo.errors import UserError

_ASSUMED_FPS = 30.0


@dataclass(frozen=True, kw_only=True, slots=True)
class VideoInfo:
    """What the container says about itself; the last two may be wrong."""

    width: int
    """Pixels, upright (a phone's rotation mark is obeyed)."""
    height: int
    """Pixels."""
    fps: float
    """Frames per second; 30 where the container names no sensible rate."""
    frames: int
    """How many frames, 0 where the container does not say."""

    @property
    def seconds(self) -> float:
        """Length by the container, 0.0 where it does not say."""
        return self.frames / self.fps


class VideoReader:
    """A video file, opened for reading from the beginning, once.

    Args:
        path: The file; any container and codec that OpenCV's FFmpeg decodes.

    Raises:
        UserError: If there is no such file or it is not a video.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise UserError(f"there is no video file at {path}")
        level = cv2.utils.logging.setLogLevel(0)
        try:
            self._capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
        width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if not self._capture.isOpened() or width < 1 or height < 1:
            self._capture.release()
            raise UserError(
                f"{path} is not a video that can be read, or it is cut off before its index; "
                "give a whole mp4, mov, webm, avi or gif file"
            )
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.info = VideoInfo(
            width=width,
            height=height,
            fps=fps if math.isfinite(fps) and 0.1 <= fps <= 1000 else _ASSUMED_FPS,
            frames=int(count) if math.isfinite(count) and 0 < count < 1e9 else 0,
        )

    def frames(self, start: float = 0.0) -> Iterator[tuple[float, np.ndarray | None]]:
        """Yields (seconds since the first frame, frame) in order.

        Time stamps are the container's; one that does not move on (all zero in some AVI and raw
        streams) is replaced by the one before plus a frame at the nominal rate.

        Args:
            start: Frames that have ended before this time come without their picture (None):
                skipping them is several times faster.
        """
        first = last = 0.0
        period = 1 / self.info.fps
        index = 0
        while self._capture.grab():
            stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if index == 0:
                first = stamp if math.isfinite(stamp) else 0.0
            seconds = stamp - first
            if index and not (math.isfinite(seconds) and seconds > last + 1e-4):
                seconds = last + period
            if seconds + 2 * period < start:
                yield seconds, None
            else:
                whole, picture = self._capture.retrieve()
                if not whole:
                    return
                yield seconds, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
            last = seconds
            index += 1

    def close(self) -> None:
        """Closes the file."""
        self._capture.release()

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def resample(
    stamped: Iterable[tuple[float, np.ndarray | None]],
    *,
    fps: float,
    period: float,
    start: float,
    end: float,
) -> Iterator[np.ndarray]:
    """Brings frames with time stamps to a fixed rate: each shows what was on screen at its time.

    Args:
        stamped: (seconds, frame) in order; frames before ``start`` may be None.
        fps: Rate wanted, frames per second.
        period: How long the last frame stays on screen, seconds.
        start: First moment wanted, seconds.
        end: Last moment wanted, seconds (infinity: all there is).

    Yields:
        Frames, (H, W, 3).
    """
    # Half a millisecond of slack: WebM rounds its stamps to whole milliseconds.
    slack = 0.6e-3
    shown: np.ndarray | None = None
    count, last = 0, -math.inf
    for seconds, frame in stamped:
        while shown is not None and start + count / fps < min(seconds - slack, end - slack):
            yield shown
            count += 1
        if seconds >= end - slack:
            return
        shown = frame if frame is not None else shown
        last = seconds
    # The last frame stays for its own time; rounding keeps 240 frames 240.
    stop = min(last + period, end)
    while shown is not None and start + (count + 0.5) / fps <= stop:
        yield shown
        count += 1


def write_webm(path: Path, frames: Iterable[np.ndarray], *, fps: float) -> int:
    """Writes frames to a WebM file (VP8) and checks that it decodes to as many.

    Args:
        path: Where; written in place, so give a temporary name.
        frames: (H, W, 3) uint8 RGB with even H and W, all of one size; may be a generator.
        fps: Frames per second.

    Returns:
        How many frames were written; with 0 there is no file.

    Raises:
        UserError: If the file cannot be written (no space, no permission).
    """
    # OpenCV prints a complaint for each .webm it opens but none for .mkv, the same container.
    matroska = path.with_suffix(".mkv")
    writer: cv2.VideoWriter | None = None
    written = 0
    try:
        for frame in frames:
            if writer is None:
                height, width = frame.shape[:2]
                code = cv2.VideoWriter.fourcc(*"VP80")
                size = (width, height)
                writer = cv2.VideoWriter(str(matroska), cv2.CAP_FFMPEG, code, fps, size)
                if not writer.isOpened():
                    raise UserError(f"cannot write a video at {path}: is the directory writable?")
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            written += 1
    except BaseException:
        if writer is not None:
            writer.release()
        matroska.unlink(missing_ok=True)
        raise
    if writer is None:
        return 0
    writer.release()
    _mark_as_webm(matroska)
    os.replace(matroska, path)
    if count_frames(path) != written:
        path.unlink()
        raise UserError(f"the video at {path} was not written whole: is the disk full?")
    return written


def count_frames(path: Path) -> int:
    """Decodes a video and counts its frames.

    Raises:
        UserError: If the file is not a video.
    """
    with VideoReader(path) as reader:
        return sum(1 for _ in reader.frames(start=math.inf))


def _mark_as_webm(path: Path) -> None:
    """Changes the document type from matroska to webm, zero-padded to keep every offset."""
    matroska, webm = b"\x42\x82\x88matroska", b"\x42\x82\x88webm\0\0\0\0"
    with path.open("r+b") as file:
        head = file.read(64)
        at = head.find(matroska)
        if at >= 0:
            file.seek(at)
            file.write(webm)
        file.flush()
        os.fsync(file.fileno())
