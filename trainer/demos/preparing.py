"""A video becomes the two files of a demo, wherever they are wanted: normalised, checked, described.

What a demo is, is its pictures: ``sha256`` is of the frames as they were handed to the encoder, so that the
same video gives the same demo anywhere, and ``video_sha256`` is of the file. In demos of before 2026-11-29,
and in the built-in ones, ``sha256`` is of the file.

Shapes: n frames, H rows, W columns.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from onedemo.core.files import write_atomic
from onedemo.demos.edits import Options, in_words
from onedemo.demos.import_checks import StoredCheck
from onedemo.demos.sandboxed_decoder import DECODING, Limits, decode
from onedemo.demos.video import VideoReader, write_webm
from onedemo.types import Demo

VIDEO, ABOUT = "video.webm", "demo.json"
"""The two files of a demo of the library."""


def prepare_demo(
    path: Path,
    options: Options,
    place: Path,
    *,
    task: str = "",
    source: str,
    limits: Limits | None = None,
    warn: Callable[[str], object] = lambda _: None,
    stored: Callable[[np.ndarray], object] = lambda _: None,
) -> Demo:
    """Brings a video in as a demo that is not kept yet, nor named: its files are in ``place`` afterwards.

    Args:
        path: The video; ``check_file`` and ``check_options`` have found nothing wrong.
        options: Which part of it, and how.
        place: An empty directory on the file system of the library.
        task: The hand-coded reward that describes the move, if known.
        source: Where the video is from.
        limits: What decoding it may take; the defaults if None.
        warn: Called with each sentence about what is not as it should be, though usable.
        stored: Called with each frame as it was stored, (H, W, 3), in order.

    Returns:
        The demo, without a name.

    Raises:
        UserError: If the video is unusable.
    """
    video = place / VIDEO
    check, pictures = StoredCheck(), hashlib.sha256(f"{options.fps:g}".encode())
    with closing(decode(path, options, limits, warn)) as frames:
        count = write_webm(video, _noting(frames, check, pictures), fps=options.fps)
    check.check_pictures(str(path))
    with VideoReader(video) as reader:
        for frame in reader.frames():
            check.stored(frame)
            stored(frame)
    about = describe(
        place / ABOUT,
        video,
        name="",
        sha256=pictures.hexdigest(),
        video_sha256=sha256_of(video),
        fps=options.fps,
        frames=count,
        task=task,
        source=source,
        **origin_of(path, options),
    )
    return demo_of(about, video)


def origin_of(path: Path, options: Options) -> dict[str, Any]:
    """What a demo was made of, and how: of the same, the frames are the same and need not be decoded."""
    return {"source_sha256": sha256_of(path), "options": options.told(), "decoding": DECODING}


def describe(path: Path, video: Path, **about: Any) -> dict[str, Any]:
    """Writes the demo's JSON and returns it."""
    with VideoReader(video) as reader:
        about |= {"width": reader.width, "height": reader.height}
    write_atomic(path, json.dumps(about, indent=1).encode() + b"\n")
    video.chmod(path.stat().st_mode & 0o777)  # OpenCV lets everybody read it
    return about


def demo_of(about: dict[str, Any], video: Path) -> Demo:
    """The demo that a JSON tells of; raises KeyError, TypeError or ValueError if it does not."""
    return Demo(
        name=str(about["name"]),
        sha256=str(about["sha256"]),
        path=video,
        fps=float(about["fps"]),
        frames=int(about["frames"]),
        width=int(about["width"]),
        height=int(about["height"]),
        task=str(about.get("task", "")),
        robot=str(about.get("robot", "")),
        source=str(about.get("source", "")),
        edits=in_words(about.get("options") or {}),
    )


def sha256_of(path: Path) -> str:
    """Of a file, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _noting(
    frames: Iterable[np.ndarray], check: StoredCheck, pictures: hashlib._Hash
) -> Iterator[np.ndarray]:
    """The same frames; what they show is noted on the way."""
    for number, frame in enumerate(frames):
        if number == 0:
            pictures.update(str(frame.shape).encode())
        pictures.update(frame.data)
        yield check.given(frame)
