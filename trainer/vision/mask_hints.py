"""What somebody says of where the mover is: a box around it, and places that are it or are not."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

LEAST_SIDE = 8
"""Pixels, of a box."""
MOST_CLICKS = 64


@dataclass(frozen=True, kw_only=True, slots=True)
class Box:
    """All of the mover is inside it in one picture; pixels from the upper left corner."""

    frame: int
    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Click:
    """A place in one picture that is on the mover, or is not; pixels from the upper left corner."""

    frame: int
    x: float
    y: float
    inside: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class Hints:
    """All that somebody has said."""

    box: Box | None = None
    clicks: tuple[Click, ...] = ()

    def __bool__(self) -> bool:
        return self.box is not None or bool(self.clicks)

    def scaled(self, by: float) -> Hints:
        """The same of pictures of another size, ``by`` times as large."""
        box = self.box and Box(
            frame=self.box.frame, x=self.box.x * by, y=self.box.y * by,
            width=self.box.width * by, height=self.box.height * by,
        )  # fmt: skip
        clicks = [Click(frame=c.frame, x=c.x * by, y=c.y * by, inside=c.inside) for c in self.clicks]
        return Hints(box=box, clicks=tuple(clicks))


def check_hints(hints: Hints, frames: int, size: Sequence[int]) -> None:
    """Raises ValueError, one sentence, if something lies outside the video.

    Args:
        hints: As somebody gave them.
        frames: Of the video.
        size: Its width and height, pixels.
    """
    width, height = size
    picture = f"the picture, which is {width} x {height} pixels"
    if (box := hints.box) is not None:
        text = f"the box {box.x:g},{box.y:g},{box.width:g},{box.height:g}"
        if min(box.width, box.height) < LEAST_SIDE:
            raise ValueError(f"{text} is too small: each side has at least {LEAST_SIDE} pixels")
        if box.x < 0 or box.y < 0 or box.x + box.width > width + 1 or box.y + box.height > height + 1:
            raise ValueError(f"{text} reaches outside {picture}")
        if box.width * box.height > 0.98 * width * height:
            raise ValueError(f"{text} is all of {picture}; draw it close around what moves")
        if not 0 <= box.frame < frames:
            raise ValueError(f"the box is at frame {box.frame}, and the video has {frames} frames")
    if len(hints.clicks) > MOST_CLICKS:
        raise ValueError(f"at most {MOST_CLICKS} places can be given, got {len(hints.clicks)}")
    for click in hints.clicks:
        if not (0 <= click.x <= width and 0 <= click.y <= height and 0 <= click.frame < frames):
            raise ValueError(
                f"the place {click.x:g},{click.y:g} in frame {click.frame} lies outside the video, "
                f"which has {frames} frames of {width} x {height} pixels"
            )


def read_box(text: str) -> tuple[tuple[float, float, float, float], float]:
    """What somebody has typed as a box: X,Y,W,H or X,Y,W,H@SECONDS; the four numbers, and the moment.

    Raises:
        ValueError: If it is neither.
    """
    number = r"\d+(?:\.\d+)?"
    box = ",".join([f"({number})"] * 4)
    found = re.fullmatch(rf"\s*{box}\s*(?:@\s*({number})\s*s?)?\s*", text)
    if not found:
        raise ValueError(f"must be X,Y,W,H or X,Y,W,H@SECONDS, such as 120,40,80,200@1.5, got {text!r}")
    x, y, width, height = (float(part) for part in found.groups()[:4])
    at = float(found[5] or 0.0)
    if not all(math.isfinite(value) and value < 1e6 for value in (x, y, width, height, at)):
        raise ValueError(f"the numbers of {text!r} are too large")
    if min(width, height) < 1:
        raise ValueError(f"a box has a width and a height, got {text!r}")
    return (x, y, width, height), at
