"""From pictures with time stamps to a fixed rate.

Each output shows what is on screen at its moment. Where the source has a rate of its own, its stamps may
jitter about that rate (phones by milliseconds, WebM by rounding): the moments are then laid where they are
furthest from any change of picture, so that none is doubled or lost. Without jitter this shows the same as
moments on the changes themselves.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import TypeVar

import numpy as np

_AROUND = 8
"""Pictures ahead that tell the source's rate; as large as they are, more would take memory."""
_BEFORE = 32
"""Of the pictures before the first that is wanted only the stamps are kept."""
_FEWEST = 6
"""Stamps that can show that they are regular."""
_SLACK = 0.6e-3
"""Seconds: WebM rounds its stamps to whole milliseconds."""

_T = TypeVar("_T")


def resample(
    stamped: Iterable[tuple[float, _T]], *, fps: float, lasts: Callable[[], float], start: float,
    end: float, speed: float = 1.0,
) -> Iterator[_T]:  # fmt: skip
    """Brings pictures with time stamps to a fixed rate.

    Args:
        stamped: (seconds, picture) in order; those before ``start`` too.
        fps: Rate wanted, pictures per second.
        lasts: Gives, when the others are through, how long the last picture stays on screen, seconds.
        start: First moment wanted, seconds.
        end: Last moment wanted, seconds (infinity: all there is).
        speed: Seconds of the source that one second shows.

    Yields:
        Pictures.
    """
    source = ((seconds / speed, picture) for seconds, picture in stamped)
    start, end, slack = start / speed, end / speed, _SLACK / speed
    before: deque[float] = deque(maxlen=_BEFORE)
    shown: list[tuple[float, _T]] = []
    ahead: deque[tuple[float, _T]] = deque()
    for seconds, picture in source:  # up to the last that is not later than the start
        if shown and seconds > start + slack:
            ahead.append((seconds, picture))
            break
        before.append(seconds)
        shown = [(seconds, picture)]
    if not shown:
        return
    ahead.extend(islice(source, _AROUND))
    grid = _grid([*before, *(seconds for seconds, _ in ahead)])
    base = start
    if grid is None:
        steps = np.diff([*before, *(seconds for seconds, _ in ahead)])
        offset = min(0.5 / fps, 0.25 * _usual(steps)) if len(steps) else 0.5 / fps
    else:
        first, step = grid
        base = first + math.floor((start - first) / step + 0.25) * step
        offset = step / 2 / _repeats(1 / (step * fps))
    wanted = math.ceil((end - start - slack) * fps) if end < math.inf else math.inf
    count, (last, picture) = 0, shown[0]
    while count < wanted:
        if not ahead:
            ahead.extend(islice(source, 1))
        if not ahead:
            break
        seconds, following = ahead.popleft()
        while count < wanted and base + count / fps + offset < seconds:
            yield picture
            count += 1
        last, picture = seconds, following
    else:
        return
    # The last picture stays for its own time; rounding keeps 240 pictures 240.
    stop = min(last + lasts() / speed - base, end - start)
    while (count + 0.5) / fps <= stop:
        yield picture
        count += 1


def _grid(stamps: Sequence[float]) -> tuple[float, float] | None:
    """The regular times that stamps jitter about: the first and the step, seconds; None if there are none."""
    if len(stamps) < _FEWEST:
        return None
    steps = np.diff(stamps)
    # Some pictures may be left out: screens are recorded when they change.
    number = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(steps / _usual(steps))))])
    apart = number - number.mean()
    step = float(apart @ stamps / (apart @ apart))  # least squares
    first = float(np.mean(stamps) - step * number.mean())
    if step <= 0 or np.abs(first + step * number - stamps).max() > step / 3:
        return None
    return first, step


def _usual(steps: np.ndarray) -> float:
    return float(np.sort(steps)[len(steps) // 2])


def _repeats(ratio: float) -> int:
    """After how many outputs they fall on the source's pictures as before: q for a ratio of about p / q."""
    return next((q for q in range(1, 8) if abs(ratio - round(ratio * q) / q) < 0.05 * ratio), 8)


def arranged(
    play: Callable[[int, int | None], Iterator[np.ndarray]], times: Callable[[int], int], *, reverse: bool,
    room: int,
) -> Iterator[np.ndarray]:  # fmt: skip
    """A sequence of pictures several times, or backwards, without all of it in memory.

    Args:
        play: Gives the pictures from one number up to another, or to the end, in order, as often as asked.
        times: Told how many there are, says how often they are wanted.
        reverse: Each time from the last to the first.
        room: Bytes of pictures that are kept; of what is longer, parts are played again.

    Yields:
        Pictures; one that follows itself is the same array.
    """
    kept: list[np.ndarray] = []
    count = size = largest = 0
    before = None
    for picture in play(0, None):
        count += 1
        if picture is not before:
            before, largest = picture, max(largest, picture.nbytes)
            size += picture.nbytes
        if size <= room:
            kept.append(picture)
        else:
            kept.clear()
    wanted = times(count)
    at_once = max(1, room // max(1, largest))
    for _ in range(wanted):
        if len(kept) == count:
            yield from reversed(kept) if reverse else kept
        elif not reverse:
            yield from play(0, None)
        else:
            for last in range(count, 0, -at_once):
                yield from reversed(list(play(max(0, last - at_once), last)))
