"""How a camera goes, told by what lies still: corners followed from picture to picture.

A camera that goes along level ground, or turns, or both, moves the pictures of what lies still by the same
amount along each row, and rows by an amount that grows evenly with their distance from the horizon: by an
affine map. So one map from each picture to the next says what the floor does at any row.

Shapes: F pictures, H rows, W columns; places are columns and rows, pixels from the upper left corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_CORNERS = 400
_FEWEST = 10
"""Corners that agree, for a move to be believed."""
_CELLS = (4, 6)
"""Rows and columns of a grid: what agrees is spread over it, unless it is the mover."""
_AGREES = 0.8
"""Pixels from where the map puts a corner."""
_ROUND_TRIP = 0.6
"""Pixels from where it began, of a corner that is followed there and back."""
STANDS = 0.12
"""Pixels a picture: what compression moves a camera that stands."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """What the background does from each picture to the next."""

    maps: np.ndarray
    """Where a place of one picture is in the next, (F - 1, 2, 3); the identity where that is not known."""
    told: np.ndarray
    """Which share of the picture, in cells of a grid, agrees with the map, (F - 1,); 0: not known."""

    @property
    def known(self) -> bool:
        """Whether enough of the background is seen, mostly, to say how the camera goes."""
        return len(self.told) > 0 and bool(np.mean(self.told > 0) > 0.7)

    def shifts(self, place: np.ndarray) -> np.ndarray:
        """By how much a place of each picture, (F, 2), moves to the next, (F - 1, 2), pixels."""
        at = np.concatenate([place[:-1], np.ones((len(self.maps), 1))], axis=1)
        return np.einsum("fij,fj->fi", self.maps, at) - place[:-1]

    def pace(self, size: tuple[int, int]) -> np.ndarray:
        """Pixels that some places of pictures of H rows and W columns usually move to the next, (5,)."""
        rows, columns = size
        moves = []
        even = np.ones((9, 1)) / 9  # grain shakes single moves, a camera that goes goes on
        for x, y in ((0.1, 0.5), (0.5, 0.9), (0.9, 0.5), (0.5, 0.1), (0.5, 0.5)):
            place = np.tile([x * columns, y * rows], (len(self.maps) + 1, 1))
            shifts = cv2.filter2D(self.shifts(place), -1, even, borderType=cv2.BORDER_REPLICATE)
            moves.append(np.median(np.abs(shifts[self.told > 0]), axis=0).max())
        return np.array(moves)


def follow_background(greys: np.ndarray, movers: np.ndarray | None = None) -> Motion:
    """Says how the camera goes.

    Args:
        greys: (F, H, W), uint8.
        movers: What moves by itself, and is not looked at, (F, H, W), bool; None: not known yet.
    """
    count, height, width = greys.shape
    maps = np.tile(np.eye(2, 3), (max(count - 1, 0), 1, 1))
    told = np.zeros(max(count - 1, 0))
    greys = np.stack([cv2.GaussianBlur(grey, (0, 0), 0.7) for grey in greys])  # grain has corners, too
    grow = np.ones((max(3, width // 24),) * 2, np.uint8)
    for index in range(count - 1):
        clear = None
        if movers is not None:
            clear = 255 - 255 * cv2.dilate(movers[index].astype(np.uint8), grow)
        likely = maps[index - 1] if index and told[index - 1] else np.eye(2, 3)
        move, share = _map(greys[index], greys[index + 1], clear, likely)
        if move is not None:
            maps[index], told[index] = move, share
    told[_odd(maps, told > 0, (height, width))] = 0
    return Motion(maps=_bridged(maps, told > 0), told=told)


def _odd(maps: np.ndarray, known: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which maps are far from those around them, (F - 1,): a pattern that repeats can be followed wrongly."""
    height, width = size
    places = np.array([[0.25, 0.6, 1], [0.75, 0.6, 1], [0.5, 0.95, 1], [0.5, 0.3, 1]]) * (width, height, 1)
    moves = (places @ maps.transpose(0, 2, 1) - places[:, :2]).reshape(len(maps), -1)
    odd = np.zeros(len(maps), bool)
    for index in np.flatnonzero(known):
        around = [k for k in range(max(0, index - 5), min(len(maps), index + 6)) if known[k]]
        middle = np.median(moves[around], axis=0)
        spread = np.median(np.abs(moves[around] - middle), axis=0)
        odd[index] = (np.abs(moves[index] - middle) > 5 * spread + 0.02 * width).any()
    return odd


def _map(
    here: np.ndarray, there: np.ndarray, clear: np.ndarray | None, likely: np.ndarray
) -> tuple[np.ndarray | None, float]:
    height, width = here.shape
    corners = cv2.goodFeaturesToTrack(here, _CORNERS, 0.01, max(4, width / 40), mask=clear, blockSize=5)
    if corners is None or len(corners) < _FEWEST:
        return None, 0.0
    window = {"winSize": (15, 15), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    guess = cv2.transform(corners, likely).astype(np.float32)
    after, seen, _ = cv2.calcOpticalFlowPyrLK(here, there, corners, guess, **window)  # type: ignore[call-overload]
    back, again, _ = cv2.calcOpticalFlowPyrLK(there, here, after, corners.copy(), **window)  # type: ignore[call-overload]
    sure = np.asarray(seen).ravel().astype(bool) & np.asarray(again).ravel().astype(bool)
    sure &= np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < _ROUND_TRIP
    before, after = corners.reshape(-1, 2)[sure], after.reshape(-1, 2)[sure]
    if len(before) < _FEWEST:
        return None, 0.0
    cv2.setRNGSeed(0)
    move, agreed = cv2.estimateAffine2D(before, after, method=cv2.RANSAC, ransacReprojThreshold=_AGREES)
    if move is None or agreed.sum() < max(_FEWEST, 0.3 * len(before)):
        return None, 0.0
    if np.abs(move[:, :2] - np.eye(2)).max() > 0.35:
        return None, 0.0
    places = before[agreed.ravel() > 0] / (width, height) * _CELLS[::-1]
    cells = {(int(row), int(column)) for column, row in places}
    share = len(cells) / (_CELLS[0] * _CELLS[1])
    return move, share if share > 0.15 else 0.0


def _bridged(maps: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Where a move is not known it is like those before and after."""
    if not known.any():
        return maps
    times = np.arange(len(maps))
    flat = maps.reshape(len(maps), 6).copy()
    for column in flat.T:
        column[:] = np.interp(times, times[known], column[known])
    return flat.reshape(-1, 2, 3)


def joined(maps: np.ndarray, start: int, end: int) -> np.ndarray:
    """The map from one picture to another, earlier or later, (2, 3).

    Args:
        maps: From each picture to the next, (F - 1, 2, 3).
        start: From this picture.
        end: To this one.
    """
    whole = np.eye(3)
    for index in range(min(start, end), max(start, end)):
        whole = np.vstack([maps[index], [0, 0, 1]]) @ whole
    return (whole if end >= start else np.linalg.inv(whole))[:2]
