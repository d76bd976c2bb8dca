"""One clip as one picture: its frames in a grid, each the demo on the left and the agent on the right.

All sides share one file, so they cannot drift apart; the page plays it (``static/player.js``), at any speed
and frame by frame. What it must know of the grid, and what is known of the movers, is JSON in comments of
the file. JPEG at quality 82; sizes and times are in docs/decisions.md.

Shapes: k frames, H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

SIDE_WIDTH, SIDE_HEIGHT = 480, 360
"""Each side of a film, pixels."""
GAP = 12
"""White space between the sides, pixels."""
HOLD_SECONDS = 0.5
"""How long the last frame of a film stays before it starts over."""

_QUALITY = 82
_HIGHEST = 16_000
"""Of the picture, pixels: browsers draw none higher than 16,384."""
_NOTE = b"onedemo clip "
_LONGEST = 65_000
"""Bytes of a comment of a JPEG; longer ones are several."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Side:
    """One side of a clip."""

    pictures: np.ndarray
    """(k, H, W, 3), uint8 RGB."""
    known: Mapping[str, Any] = field(default_factory=dict)
    """What goes with them, as ``onedemo.render.framing`` has it."""


def compose_clip(*sides: Side | np.ndarray) -> bytes:
    """Lays the frames side by side, moment below moment, and encodes them as one JPEG.

    Args:
        sides: The demo and one agent or more at the same times, each of any size.

    Returns:
        The file's bytes, with what ``read_about`` reads.

    Raises:
        ValueError: If the sides differ in length, are empty or not RGB.
    """
    parts = [side if isinstance(side, Side) else Side(pictures=side) for side in sides]
    count = len(parts[0].pictures)
    for number, part in enumerate(parts):
        name, frames = "agent" if number else "demo", part.pictures
        if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8 or not frames.size:
            raise ValueError(
                f"{name} frames must be (k, H, W, 3) uint8 with k > 0, got {frames.shape} {frames.dtype}"
            )
        if len(frames) != count:
            raise ValueError(f"{count} demo frames, but {len(frames)} agent frames")
    height = max(part.pictures.shape[1] for part in parts)
    starts = np.cumsum([0, *(part.pictures.shape[2] + GAP for part in parts)]).tolist()
    width = starts[-1] - GAP
    columns = math.ceil(count / (_HIGHEST // height))
    rows = math.ceil(count / columns)
    picture = np.empty((rows * height, columns * width, 3), np.uint8)
    for frame in range(rows * columns):
        y, x = frame // columns * height, frame % columns * width
        if frame >= count:
            picture[y : y + height, x : x + width] = 255
            continue
        for start, part in zip(starts, parts, strict=False):
            tall, wide = part.pictures.shape[1:3]
            picture[y + tall : y + height, x + start : x + start + wide] = 255
            picture[y : y + height, x + start + wide : x + min(start + wide + GAP, width)] = 255
            cell = picture[y : y + tall, x + start : x + start + wide]
            cv2.cvtColor(part.pictures[frame], cv2.COLOR_RGB2BGR, dst=cell)
    about = {
        "frames": count, "columns": columns, "cell": [width, height],
        "sides": [
            {"at": start, "size": [part.pictures.shape[2], part.pictures.shape[1]], **part.known}
            for start, part in zip(starts, parts, strict=False)
        ],
    }  # fmt: skip
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a clip as JPEG")
    return _annotated(encoded.tobytes(), json.dumps(about, separators=(",", ":")).encode())


def _annotated(picture: bytes, note: bytes) -> bytes:
    """A JPEG with comments after its start, which others ignore (ITU-T T.81, B.2.4.5)."""
    comments = []
    for start in range(0, len(note), _LONGEST):
        text = _NOTE + note[start : start + _LONGEST]
        comments.append(b"\xff\xfe" + (2 + len(text)).to_bytes(2, "big") + text)
    return b"".join([picture[:2], *comments, picture[2:]])


def read_about(picture: bytes) -> dict[str, Any]:
    """What ``compose_clip`` noted in a clip: its grid, and of each side where it is and what is known.

    Raises:
        ValueError: If it notes nothing.
    """
    at, text = 2, b""
    while picture[at : at + 1] == b"\xff" and picture[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(picture[at + 2 : at + 4], "big")
        if picture[at + 1] == 0xFE and picture[at + 4 : end].startswith(_NOTE):
            text += picture[at + 4 + len(_NOTE) : end]
        at = end
    about: dict[str, Any] = json.loads(text)
    return about


def frame_durations(k: int, fps: float) -> np.ndarray:
    """How long each frame stays, (k,), int32 milliseconds; their sum does not drift from k / fps.

    Args:
        k: How many frames.
        fps: Frames per second as played.
    """
    durations = np.diff(np.round(np.arange(k + 1) * 1000 / fps)).astype(np.int32)
    durations[-1] = max(durations[-1], round(HOLD_SECONDS * 1000))
    return durations


def side_by_side(demo: np.ndarray, *agents: np.ndarray) -> np.ndarray:
    """One picture of all, (H, W, 3), each fitted into its side."""
    gap = np.full((SIDE_HEIGHT, GAP, 3), 255, np.uint8)
    return np.concatenate([fit(demo), *(part for agent in agents for part in (gap, fit(agent)))], axis=1)


def fit(frame: np.ndarray, width: int = SIDE_WIDTH, height: int = SIDE_HEIGHT) -> np.ndarray:
    """Scales a frame to fit into one side; what is left over shows the frame itself, faded.

    A portrait video stands on a wide, blurred and lightened copy of itself: calmer than black
    bars, and the edges of the picture stay visible.

    Args:
        frame: (H, W, 3), uint8 RGB.
        width: Of the side, pixels.
        height: Of the side, pixels.

    Returns:
        (height, width, 3), uint8 RGB.
    """
    if frame.shape[:2] == (height, width):
        return frame
    scale = min(width / frame.shape[1], height / frame.shape[0])
    w = min(width, max(1, round(frame.shape[1] * scale)))
    h = min(height, max(1, round(frame.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = cv2.resize(frame, (w, h), interpolation=method)
    if (h, w) == (height, width):
        return small
    side = _surround(small, width, height)
    y, x = (height - h) // 2, (width - w) // 2
    side[y : y + h, x : x + w] = small
    return side


def _surround(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    """A wash of the frame's own colours over the whole side, mixed with white."""
    tiny = cv2.resize(frame, (4, 3), interpolation=cv2.INTER_AREA)
    wash = cv2.resize(tiny, (width, height), interpolation=cv2.INTER_CUBIC)
    return cv2.addWeighted(wash, 0.3, np.full_like(wash, 243), 0.7, 0)
