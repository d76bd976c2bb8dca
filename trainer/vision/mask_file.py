"""The mover of a demo: found once, kept beside the demo's video, and said in one line.

A kept file is ``masks.npz``: the masks as bits, and what was marked by whom brought the video in. It goes
where the demo goes, and is gone with it.

Shapes: F frames, H rows, W columns of the masks, which are smaller than the video's pictures.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

from onedemo.core.files import read_whole, write_atomic
from onedemo.demos.library import stream_frames
from onedemo.errors import UserError
from onedemo.robots.registry import DEFAULT
from onedemo.types import Demo
from onedemo.vision.mask_hints import Box, Hints, check_hints
from onedemo.vision.masks import LENGTH, METHODS, SURE, Masks, find_masks

FILE_NAME = "masks.npz"
_VERSION = 1
_PICTURE = 240 * 180
"""Pixels of a picture in which the mover is looked for."""
_ALL = 80_000_000
"""Pixels of all pictures together: a minute at 30 a second. Those of longer or faster videos are smaller."""


def looked_at(demo: Demo) -> np.ndarray:
    """The frames of a demo as the mover is looked for in them: all, but small, (F, H, W, 3), uint8 RGB.

    Raises:
        UserError: If the stored video is missing or damaged.
    """
    return shrunk(stream_frames(demo), demo.frames, (demo.width, demo.height))


def shrunk(frames: Iterable[np.ndarray], count: int, size: tuple[int, int]) -> np.ndarray:
    """Frames, (F, ., ., 3), so small that a minute of them fits into memory.

    Args:
        frames: One after another, uint8 RGB.
        count: F.
        size: Their width and height, pixels.
    """
    by = min(1.0, math.sqrt(min(_PICTURE, _ALL / max(1, count)) / (size[0] * size[1])))
    width, height = (max(16, round(side * by)) for side in size)
    small = np.empty((count, height, width, 3), np.uint8)
    for index, frame in enumerate(frames):
        small[index] = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
    return small


def find_mover(
    demo: Demo, hints: Hints | None = None, check: Callable[[float], None] = lambda _: None
) -> Masks:
    """Finds the mover of a demo, and keeps nothing.

    Args:
        demo: The demo.
        hints: What somebody has marked, in pixels of the demo.
        check: As of ``find_masks``.

    Raises:
        UserError: If the stored video is missing or damaged.
    """
    frames = looked_at(demo)
    return find_masks(
        frames, hints=hints and hints.scaled(frames.shape[2] / demo.width), length=LENGTH, check=check,
        robot=demo.robot or DEFAULT,
    )  # fmt: skip


def masks_of(demo: Demo, length: float = LENGTH) -> Masks:
    """The mover of a demo: as it was kept with it, else found now.

    Args:
        demo: The demo.
        length: Metres of the robot at its longest, of which the scale is made.

    Raises:
        UserError: If the stored video is missing or damaged.
    """
    return (kept_masks(demo) or find_mover(demo)).of_length(length)


def find_and_keep(demo: Demo, hints: Hints | None = None) -> Masks:
    """Finds the mover of a demo of the library and keeps it there; without hints, unless that was done.

    Raises:
        UserError: If the stored video is missing or damaged, the disk is full, or nothing is where somebody
            has marked it; what was kept before then stays.
    """
    if not hints and (kept := kept_masks(demo)) is not None:
        return kept
    masks = find_mover(demo, hints)
    if hints:
        check_found(masks)
    try:
        write_masks(mask_file(demo), masks, hints)
    except OSError as error:
        raise UserError(f"what moves could not be stored beside {demo.path}: {error.strerror}") from error
    return masks


def hints_of_box(demo: Demo, box: tuple[float, float, float, float], seconds: float) -> Hints:
    """A box that somebody has typed.

    Args:
        demo: The demo, in whose pixels it is.
        box: x, y, width, height.
        seconds: The moment in the demo.

    Raises:
        UserError: If it lies outside the demo.
    """
    if seconds >= demo.seconds:
        raise UserError(
            f"argument --box: {seconds:g} s is past the end of the demo, which lasts {demo.seconds:.2f} s"
        )
    x, y, width, height = box
    frame = min(demo.frames - 1, int(seconds * demo.fps + 1e-6))
    hints = Hints(box=Box(frame=frame, x=x, y=y, width=width, height=height))
    try:
        check_hints(hints, demo.frames, (demo.width, demo.height))
    except ValueError as error:
        raise UserError(f"argument --box: {error}") from None
    return hints


def kept_masks(demo: Demo) -> Masks | None:
    """What was kept with a demo; None if nothing was, or it is of another version or damaged."""
    return read_masks(mask_file(demo))


def mask_file(demo: Demo) -> Path:
    """Where the mover of a demo is kept."""
    name = FILE_NAME if demo.path.name == "video.webm" else f"{demo.path.stem}.{FILE_NAME}"
    return demo.path.with_name(name)


def read_masks(path: Path) -> Masks | None:
    """As ``write_masks`` wrote them; None if there are none, or of another version, or damaged ones."""
    if (data := read_whole(path)) is None:
        return None
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        about = json.loads(str(stored["about"]))
        if about["version"] != _VERSION or about["method"] not in METHODS:
            return None
        shape = tuple(about["shape"])
        bits = np.unpackbits(stored["bits"], count=math.prod(shape))
        return Masks(
            masks=bits.reshape(shape).astype(bool), floor=stored["floor"], scale=about["scale"],
            way=stored["way"] if about["way"] else None, doubt=stored["doubt"], method=about["method"],
        )  # fmt: skip


def write_masks(path: Path, masks: Masks, hints: Hints | None = None) -> None:
    """Keeps what was found, with what was marked; some kilobytes a second of video.

    Raises:
        OSError: If it cannot be written.
    """
    about = {
        "version": _VERSION, "method": masks.method, "scale": masks.scale, "shape": masks.masks.shape,
        "way": masks.way is not None, "hints": plain(hints or Hints()),
    }  # fmt: skip
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, allow_pickle=False, about=json.dumps(about), bits=np.packbits(masks.masks),
        floor=masks.floor.astype(np.float32), doubt=masks.doubt,
        way=np.zeros(0) if masks.way is None else masks.way.astype(np.float32),
    )  # fmt: skip
    write_atomic(path, buffer.getvalue())


def plain(hints: Hints) -> dict[str, list]:
    """Hints as lists of numbers, for JSON: box [x, y, width, height, frame], clicks [x, y, frame, inside]."""
    box = hints.box
    return {
        "box": [box.x, box.y, box.width, box.height, box.frame] if box else [],
        "clicks": [[click.x, click.y, click.frame, int(click.inside)] for click in hints.clicks],
    }


def in_words(masks: Masks) -> str:
    """How the mover was found, and how sure that is: one line."""
    count, sure = len(masks.doubt), int((masks.doubt < SURE).sum())
    if not masks.masks.any():
        return "nothing was found that moves: mark it with --box"
    said = f"found {METHODS[masks.method]}; sure in {sure} of {count} frames"
    return said if sure > 0.6 * count else f"{said}: mark it with --box"


def check_found(masks: Masks) -> None:
    """Raises UserError if somebody has marked a mover and there is none."""
    if not masks.masks.any():
        raise UserError(
            "nothing in the box stands out from what is around it; draw it around all of the mover, in a "
            "frame where it is seen whole"
        )
