"""The videos that are kept: written as WebM, and read. What comes in is ``onedemo.demos.source``.

Written is VP8 in WebM: it decodes frame by frame as written and plays in every browser. VP9 through
OpenCV gives the same size and half a decibel more, in four times the time.

Shapes: n frames, H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from onedemo.errors import UserError


class VideoReader:
    """A video that ``write_webm`` wrote, opened for reading from the beginning, once.

    Args:
        path: The file.

    Raises:
        UserError: If there is no such file or it is not a video.
    """

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    fps: float
    """Frames per second."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise UserError(f"there is no video file at {path}")
        level = cv2.utils.logging.setLogLevel(0)
        try:
            self._capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self.fps = self._capture.get(cv2.CAP_PROP_FPS)
        if not self._capture.isOpened() or self.width < 1 or self.height < 1:
            self._capture.release()
            raise UserError(f"{path} is not a video that can be read")

    def frames(self) -> Iterator[np.ndarray]:
        """The frames in order, (H, W, 3)."""
        while True:
            whole, picture = self._capture.read()
            if not whole:
                return
            yield cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)

    def count(self) -> int:
        """How many frames are left."""
        left = 0
        while self._capture.grab():
            left += 1
        return left

    def close(self) -> None:
        """Closes the file."""
        self._capture.release()

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


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


def jpeg(picture: np.ndarray, width: int | None = None) -> bytes:
    """A picture, (H, W, 3) uint8 RGB, as JPEG: as it is, or scaled to a width in pixels."""
    if width is not None:
        size = (width, max(1, round(picture.shape[0] * width / picture.shape[1])))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def count_frames(path: Path) -> int:
    """Decodes a video and counts its frames.

    Raises:
        UserError: If the file is not a video.
    """
    with VideoReader(path) as reader:
        return reader.count()


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
