"""Where a picture differs from what lies behind the mover.

The background of a camera that stands is the median of all pictures; of one that goes, the median of
neighbours in time, each brought to where its floor lies in the picture looked at.

Shapes: F pictures, H rows, W columns; evidence is uint8, from 0, background, to 255.
"""

from __future__ import annotations

import cv2
import numpy as np

from onedemo.vision.mask_camera import Motion, joined

_LOOKED_AT = 64
"""Pictures of which the median is taken."""
_NEIGHBOURS = 10
_REACH = 30
"""Pictures before and after from which neighbours are taken, at most."""
_NEAR = 0.85
"""Share of the height at which the floor goes by the mover, about."""
_FAR = 0.4
"""Share of the width by which the background has gone by between neighbours, at most."""
_BESIDE = 0.03
"""Share of the width by which the background must have gone by, to show what is behind the mover."""
_OFF = 2
"""Pixels by which a background that was brought to its place may lie beside it."""
_BUSY = 50
"""Difference of colours within that distance from which on nothing can be seen before it."""
UNKNOWN = 115
"""Evidence that says nothing."""
_LOW, _HIGH = 9.0, 34.0
"""Differences of a colour that are surely noise, or surely not, of 255, where the noise is unknown."""


def before_still(frames: np.ndarray) -> np.ndarray:
    """Evidence of a mover before a background that stands still.

    Args:
        frames: (F, H, W, 3), uint8 RGB.

    Returns:
        (F, H, W), uint8.
    """
    some = frames[np.linspace(0, len(frames) - 1, min(len(frames), _LOOKED_AT)).astype(int)]
    background = np.median(some, axis=0).astype(np.uint8)
    noise = np.median([cv2.absdiff(frame, background).max(axis=2) for frame in some], axis=0)
    noise = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 3)
    return np.stack([_difference(frame, background, noise) for frame in frames])


def before_moving(frames: np.ndarray, motion: Motion) -> np.ndarray:
    """Evidence of a mover that a camera follows; as ``before_still``.

    Args:
        frames: (F, H, W, 3), uint8 RGB.
        motion: Of the camera.
    """
    height, width = frames.shape[1:3]
    place = np.tile([width / 2, _NEAR * height], (len(frames), 1))
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(motion.shifts(place), axis=1))])
    evidence = np.empty(frames.shape[:3], np.uint8)
    rows = np.stack([np.full(height, width / 2), np.arange(height), np.ones(height)], axis=1)
    for index, frame in enumerate(frames):
        stack, aside = [], []
        for other in _neighbours(index, gone, _FAR * width):
            move = joined(motion.maps, other, index)
            aside.append(np.linalg.norm(rows @ move.T - rows[:, :2], axis=1))
            stack.append(cv2.warpAffine(
                frames[other], move, (width, height), flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            ))  # fmt: skip
        if not stack:
            evidence[index] = UNKNOWN
            continue
        background = _middle(np.stack(stack))
        shown, busy = _beyond(frame, background)
        shown[busy] = np.maximum(shown[busy], UNKNOWN)
        still = np.clip(2 - np.median(aside, axis=0) / (_BESIDE * width), 0, 1) * UNKNOWN
        evidence[index] = np.maximum(shown, still.astype(np.uint8)[:, None])
    return evidence


def _middle(stack: np.ndarray) -> np.ndarray:
    """The median of some pictures, (n, ...), uint8."""
    middle = len(stack) // 2
    return np.partition(stack, middle, axis=0)[middle]


def _beyond(frame: np.ndarray, background: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evidence of one picture before a background that may be a little off its place.

    Returns:
        The evidence, (H, W), and where the background's texture is so fine that it says nothing, (H, W).
    """
    around = np.ones((2 * _OFF + 1,) * 2, np.uint8)
    low, high = cv2.erode(background, around), cv2.dilate(background, around)
    other = cv2.max(cv2.subtract(frame, high), cv2.subtract(low, frame)).max(axis=2).astype(np.float32)
    shown = (255 * np.clip((other - _LOW) / (_HIGH - _LOW), 0, 1)).astype(np.uint8)
    return shown, cv2.subtract(high, low).max(axis=2) > _BUSY


def _neighbours(index: int, gone: np.ndarray, far: float) -> list[int]:
    """Pictures before and after one, spread evenly over what the background has gone by meanwhile."""
    found = []
    for others in (
        range(index + 1, min(len(gone), index + _REACH + 1)),
        range(index - 1, max(-1, index - _REACH - 1), -1),
    ):
        inside = [other for other in others if abs(gone[other] - gone[index]) <= far]
        if inside:
            picked = np.linspace(0, len(inside) - 1, min(len(inside), _NEIGHBOURS // 2)).round().astype(int)
            found += [inside[k] for k in picked]
    return found


def _difference(frame: np.ndarray, background: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Evidence of one picture, given what noise does to the background, (H, W)."""
    other = cv2.GaussianBlur(cv2.absdiff(frame, background), (0, 0), 0.8).max(axis=2).astype(np.float32)
    low = _LOW + 2 * noise
    return (255 * np.clip((other - low) / (_HIGH - _LOW + noise), 0, 1)).astype(np.uint8)
