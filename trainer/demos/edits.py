"""What is done to a video on its way in, and in which order.

Of its time: the part between ``start`` and ``end``, seconds of the file, is played ``speed`` times faster,
backwards with ``reverse``, and ``loop`` times end to end.

Of each picture, once it is upright as its file says: it is turned (``rotate``), its background is held still
(``stabilise``), it is cropped (``crop``, or a crop that moves along: ``track``), mirrored, and scaled to what
is stored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from onedemo.demos.import_checks import MAX_SECONDS, MIN_SIDE
from onedemo.errors import UserError

USEFUL_SECONDS = 8.0
"""Of a demo: 1000 control steps of the hopper, as long as gymnasium's episodes and the built-in demos are."""
LEAST_SPEED, MOST_SPEED = 0.1, 20.0
QUARTERS = (0, 90, 180, 270)
_ALWAYS = ("start", "end", "crop", "mirror", "fps")
"""What a demo's JSON has always said; the others are there if they are not as usual."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Options:
    """Which part of a video is wanted, and how; ``check_options`` has found nothing wrong."""

    start: float | None = None
    """Seconds."""
    end: float | None = None
    """Seconds."""
    crop: tuple[int, int, int, int] | None = None
    """x, y, width, height, pixels of the upright, turned source; with ``track`` where it begins."""
    mirror: bool = False
    """Swap left and right."""
    fps: float = 30.0
    """Frames per second."""
    speed: float = 1.0
    """The video shows the move slowed so many times, so it is played as many times faster."""
    reverse: bool = False
    """Backwards."""
    loop: int = 1
    """How often, end to end; 0: as often as fits whole into ``USEFUL_SECONDS``, at least once."""
    rotate: int = 0
    """Degrees clockwise, of ``QUARTERS``."""
    track: bool = False
    """A crop of fixed size follows what moves: what moves in ``crop`` at first, or all that moves."""
    stabilise: bool = False
    """The background stands still."""

    @property
    def most_frames(self) -> int:
        """More than a whole demo can have."""
        return math.ceil((MAX_SECONDS + 3) * self.fps) + 2

    def times(self, frames: int) -> int:
        """How often so many frames are shown."""
        return self.loop or max(1, math.floor(USEFUL_SECONDS * self.fps / frames + 1e-9))

    def told(self) -> dict[str, Any]:
        """As a demo's JSON has them."""
        usual, mine = asdict(Options()), asdict(self)
        mine["crop"] = list(self.crop) if self.crop else None
        return {name: value for name, value in mine.items() if name in _ALWAYS or value != usual[name]}


def in_words(told: Mapping[str, Any]) -> str:
    """What was done to a demo's video, in a few words; "" where nothing was, or nothing is known.

    Args:
        told: The options of the demo's JSON, which may be old, or edited by somebody.
    """
    known = {name: told[name] for name in Options.__dataclass_fields__ if name in told}
    try:
        options = Options(**known)
        end = math.inf if options.end is None else options.end
        words = []
        if options.start or end < math.inf:
            until = f" to {end:g} s" if end < math.inf else " s on"
            words.append(f"from {options.start or 0:g}{until}")
        if options.rotate:
            words.append(f"turned by {options.rotate:d}°")
        if options.stabilise:
            words.append("background held still")
        if options.track:
            words.append("follows the mover")
        elif options.crop:
            words.append("cropped")
        if options.mirror:
            words.append("mirrored")
        if options.speed != 1:
            words.append(f"{options.speed:g} times as fast")
        if options.reverse:
            words.append("backwards")
        if options.loop != 1:
            often = f"{options.loop:d} times" if options.loop else f"to fill {USEFUL_SECONDS:g} s"
            words.append(f"repeated {often}")
    except (TypeError, ValueError):
        return ""
    return ", ".join(words)


def check_options(options: Options) -> None:
    """Raises UserError for options that are wrong for any video."""
    start, end, crop = options.start, options.end, options.crop
    if not 1 <= options.fps <= 120:
        raise UserError(f"--fps must be from 1 to 120 frames per second, got {options.fps:g}")
    if start is not None and not (math.isfinite(start) and start >= 0):
        raise UserError(f"--start must be 0 seconds or more, got {start:g}")
    if end is not None and not end > (start or 0.0):
        raise UserError(f"--end must be later than --start ({start or 0:g} s), got {end:g}")
    if crop is not None and (min(crop[:2]) < 0 or min(crop[2:]) < MIN_SIDE):
        raise UserError(
            "--crop is x,y,width,height in pixels, with x and y 0 or more and at least "
            f"{MIN_SIDE} x {MIN_SIDE} pixels, got {','.join(map(str, crop))}"
        )
    if not LEAST_SPEED <= options.speed <= MOST_SPEED:
        raise _no_speed(f"{options.speed:g}")
    if options.loop < 0:
        raise _no_loop(str(options.loop))
    if options.rotate not in QUARTERS:
        raise _no_rotation(str(options.rotate))


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


def read_speed(given: Any) -> float:
    """A speed that somebody has typed or sent; raises UserError if it is none."""
    try:
        speed = math.nan if isinstance(given, bool) else float(given)
    except (TypeError, ValueError, OverflowError):
        speed = math.nan
    if not LEAST_SPEED <= speed <= MOST_SPEED:
        raise _no_speed(given)
    return speed


def read_loop(given: Any) -> int:
    """How often, as somebody has typed or sent it: a number, or True for the most useful length.

    Raises:
        UserError: If it is neither.
    """
    if isinstance(given, bool):
        return 0 if given else 1
    try:
        times = int(given) if isinstance(given, int) else int(str(given))
    except ValueError:
        times = 0
    if times < 1:
        raise _no_loop(given)
    return times


def read_rotation(given: Any) -> int:
    """Degrees that somebody has typed or sent; raises UserError if they are no quarter turns."""
    try:
        degrees = -1 if isinstance(given, bool) else int(str(given))
    except ValueError:
        degrees = -1
    if degrees not in QUARTERS:
        raise _no_rotation(given)
    return degrees


def _no_speed(given: object) -> UserError:
    return UserError(
        f"--speed must be a number from {LEAST_SPEED:g} to {MOST_SPEED:g}, as many times as the video shows "
        f"the move slowed, got {_short(given)}"
    )


def _no_loop(given: object) -> UserError:
    return UserError(
        "--loop must be a whole number, 1 or more, or stand alone for as often as fits into "
        f"{USEFUL_SECONDS:g} s, got {_short(given)}"
    )


def _no_rotation(given: object) -> UserError:
    return UserError(f"--rotate must be 90, 180 or 270 degrees clockwise, got {_short(given)}")


def _short(given: object) -> str:
    """What was given, so that it fits into a sentence of one line."""
    return ascii(given)[:40].strip("'") if isinstance(given, str) else ascii(given)[:40]
