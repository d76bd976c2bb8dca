"""The mover cut out of each picture: evidence of motion, its colours, and the edges of the picture together.

Shapes: F pictures, H rows, W columns; evidence is uint8, from 0, background, to 255.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress

import cv2
import numpy as np

from onedemo.vision.mask_hints import Box, Click

_BINS = 16
"""Of each colour, in the table of the mover's colours."""
STILL, FOLLOWING = 5.0, 1.5
"""How much motion counts beside colour: before a background that goes by, much else differs."""
_CAUTION = 1.0
"""Odds that it takes more before a background that goes by."""
_SURE, _SOME = 190, 120
"""Evidence that is the mover, and that may be."""
_LEAST = 0.0012
"""Share of a picture that a mover covers at least."""
_LARGE = 0.45
"""Share of a picture that it covers at most."""
_ROUND = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))


class Colours:
    """How much likelier a colour is of the mover than of what is behind it.

    Args:
        frames: (F, H, W, 3), uint8 RGB.
        inside: What is of the mover, (F, H, W), bool.
        outside: What is not.
        share: How much each place counts of what is not, (H, W), 0..1; None: all the same.
    """

    def __init__(
        self, frames: np.ndarray, inside: np.ndarray, outside: np.ndarray, share: np.ndarray | None = None
    ) -> None:
        tables = []
        for where, weight in ((inside, None), (outside, share)):
            table = np.zeros(_BINS**3)
            for frame, here in zip(frames, where, strict=True):
                if here.any():
                    weights = None if weight is None else weight[here]
                    table += np.bincount(_cells(frame)[here], weights, _BINS**3)
            table = table.reshape((_BINS,) * 3)
            for axis in range(3):  # neighbours in colour are alike
                padded = np.concatenate([table.take([0], axis), table, table.take([-1], axis)], axis)
                sides = padded.take(range(_BINS), axis) + padded.take(range(2, _BINS + 2), axis)
                table = 0.6 * table + 0.2 * sides
            tables.append((table / max(table.sum(), 1e-9)).ravel())
        floor = 0.0015  # a colour seen in a few places says little
        self._ratio = np.log((tables[0] + floor) / (tables[1] + floor)).astype(np.float32)
        self.apart = float(0.5 * np.abs(tables[0] - tables[1]).sum())
        """Share of the mover's colours that are not those of what is behind it, 0..1."""

    def odds(self, frame: np.ndarray) -> np.ndarray:
        """Logarithm of the odds that a pixel is of the mover by its colour, (H, W)."""
        return self._ratio[_cells(frame)]


def _cells(frame: np.ndarray) -> np.ndarray:
    lab = cv2.cvtColor(frame, cv2.COLOR_RGB2LAB).astype(np.int32)
    light = lab[..., 0] * _BINS // 256
    # Colours crowd around grey: twice as fine there.
    a, b = (np.clip((lab[..., k] - 128) * _BINS // 128 + _BINS // 2, 0, _BINS - 1) for k in (1, 2))
    return (light * _BINS + a) * _BINS + b


def seeds_of(evidence: np.ndarray, *, follows: bool) -> tuple[np.ndarray, np.ndarray]:
    """What is surely of the mover, and what surely is not, by the evidence alone, (F, H, W) each, bool.

    Args:
        evidence: (F, H, W).
        follows: Whether the camera does, and so keeps the mover in about one place.
    """
    inside = np.zeros(evidence.shape, bool)
    outside = np.zeros(evidence.shape, bool)
    middle = _middle(evidence.shape[1:]) if follows else None
    for index, shown in enumerate(evidence):
        solid = cv2.morphologyEx((shown > _SURE).astype(np.uint8), cv2.MORPH_OPEN, _ROUND)
        inside[index] = largest(solid, middle)
        near = cv2.dilate((shown > _SOME).astype(np.uint8), np.ones((5, 5), np.uint8))
        outside[index] = near == 0
    sizes = inside.mean(axis=(1, 2))
    usual = np.median(sizes[sizes > 0]) if (sizes > 0).any() else 0.0
    inside[(sizes > 3 * usual) | (sizes < 0.3 * usual)] = False
    if follows:
        centres = np.array(
            [np.argwhere(each).mean(axis=0) if each.any() else (np.nan,) * 2 for each in inside]
        )
        away = np.abs(centres - np.nanmedian(centres, axis=0)) if inside.any() else centres
        inside[(away > 0.2 * evidence.shape[2]).any(axis=1)] = False
    return inside, outside


def _middle(size: tuple[int, ...]) -> np.ndarray:
    """How much a place counts that a camera follows, (H, W): most in the middle."""
    height, width = size
    across, down = (np.exp(-((np.linspace(-1, 1, side) / 0.45) ** 2)) for side in (width, height))
    return np.outer(down, across).astype(np.float32)


def largest(solid: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """The largest part of (H, W) uint8, with others that are nearly joined to it; bool.

    Args:
        solid: 0 or 1.
        weight: How much each place counts, (H, W); None: all the same.
    """
    joined = cv2.dilate(solid, _ROUND, iterations=2)
    count, labels = cv2.connectedComponents(joined)
    if count < 2:
        return np.zeros(solid.shape, bool)
    weights = None if weight is None else weight[solid > 0]
    sizes = np.bincount(labels[solid > 0], weights, minlength=count).astype(float)
    sizes[0] = 0
    return (labels == sizes.argmax()) & (solid > 0)


def cut(
    frames: np.ndarray, evidence: np.ndarray | None, colours: Colours, start: int,
    moves: float = STILL, seeds: Mapping[int, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Cuts the mover out, from one picture on to both ends.

    Args:
        frames: (F, H, W, 3), uint8 RGB.
        evidence: Of motion, (F, H, W); None where there is none.
        colours: Of the mover.
        start: The picture that is surest.
        moves: How much the evidence counts.
        seeds: The mover in some pictures, (H, W), bool, as somebody has marked it.

    Returns:
        The mover, (F, H, W), bool, and how large what else moves is beside it, (F,), share of its area.
    """
    seeds = seeds or {}
    masks = np.zeros(frames.shape[:3], bool)
    others = np.zeros(len(frames))
    for order in (range(start, len(frames)), range(start - 1, -1, -1)):
        near = masks[start] if masks[start].any() else None
        for index in order:
            shown = None if evidence is None else evidence[index]
            if index in seeds:
                masks[index] = seeds[index]
            else:
                masks[index], others[index] = _cut_one(frames[index], shown, colours, near, moves)
            if masks[index].any():
                near = masks[index]
    return masks, others


def _cut_one(
    frame: np.ndarray, shown: np.ndarray | None, colours: Colours, near: np.ndarray | None, moves: float
) -> tuple[np.ndarray, float]:
    height, width = frame.shape[:2]
    odds = 0.7 * np.clip(colours.odds(frame), -5, 5)
    if shown is not None:
        odds = odds + moves * (shown / np.float32(255) - 0.45)
    if near is not None:
        reach = max(3, round(0.35 * np.sqrt(near.sum())))
        away = cv2.distanceTransform((~near).astype(np.uint8), cv2.DIST_L2, 3)
        odds = odds + np.clip(0.5 - away / reach, -4, 0.5)
    odds = cv2.GaussianBlur(odds.astype(np.float32), (0, 0), 0.8)
    if moves < STILL:
        odds -= _CAUTION
    solid = cv2.medianBlur((odds > 0).astype(np.uint8), 3)
    mover = largest(solid, None if near is None else 1 + 3 * near.astype(np.float32))
    area = int(mover.sum())
    if not _LEAST * height * width <= area:
        return np.zeros((height, width), bool), 1.0
    rest = solid.astype(bool) & ~mover
    other = largest(rest.astype(np.uint8)).sum() if rest.any() else 0
    # Edges of a background that goes by are no help; where it stands still they are known to be its own.
    return _sharpened(frame, mover, odds) if moves == STILL else mover, float(other / area)


def _sharpened(frame: np.ndarray, mover: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """Moves the border to where the picture has an edge: GrabCut, close around it."""
    rows, columns = np.flatnonzero(mover.any(axis=1)), np.flatnonzero(mover.any(axis=0))
    edge = max(6, round(0.15 * max(np.ptp(rows), np.ptp(columns))))
    top, bottom = max(0, rows[0] - edge), rows[-1] + edge + 1
    left, right = max(0, columns[0] - edge), columns[-1] + edge + 1
    part, inside, sure = (
        frame[top:bottom, left:right],
        mover[top:bottom, left:right],
        odds[top:bottom, left:right],
    )
    states = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    states[inside & (sure > 3)] = cv2.GC_FGD
    states[~inside & (sure < -1.5)] = cv2.GC_BGD
    if not (states & 1).any() or (states & 1).all():
        return mover
    _grab(part, states, 1)
    found = np.zeros_like(mover)
    found[top:bottom, left:right] = (states & 1).astype(bool)
    return found if found.sum() > 0.4 * mover.sum() else mover


def boxed(frame: np.ndarray, box: Box, clicks: Iterable[Click] = ()) -> np.ndarray:
    """What somebody means with a box around it, (H, W), bool: GrabCut from there.

    Args:
        frame: The picture with the box, (H, W, 3), uint8 RGB.
        box: All of the mover is inside.
        clicks: Places; those of other pictures are left out.
    """
    states = np.full(frame.shape[:2], cv2.GC_BGD, np.uint8)
    left, top = max(0, round(box.x)), max(0, round(box.y))
    states[top : round(box.y + box.height), left : round(box.x + box.width)] = cv2.GC_PR_FGD
    _mark(states, clicks, box.frame)
    _grab(frame, states, 5)
    return (states & 1).astype(bool)


def clicked(frame: np.ndarray, mask: np.ndarray, clicks: Iterable[Click], index: int) -> np.ndarray:
    """What somebody means with places that are the mover or are not, (H, W), bool.

    Args:
        frame: (H, W, 3), uint8 RGB.
        mask: What is taken to be the mover, (H, W), bool.
        clicks: Places; those of other pictures are left out.
        index: The number of this picture.
    """
    states = np.where(mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    _mark(states, clicks, index)
    near = states & 1
    reach = 0.35 * np.sqrt(max(mask.sum(), 400))
    away = cv2.distanceTransform(1 - near, cv2.DIST_L2, 3)
    states[away > reach] = cv2.GC_BGD
    _mark(states, clicks, index)
    _grab(frame, states, 3)
    return (states & 1).astype(bool)


def _mark(states: np.ndarray, clicks: Iterable[Click], index: int) -> None:
    radius = max(2, round(states.shape[1] / 80))
    for click in clicks:
        if click.frame == index:
            state = cv2.GC_FGD if click.inside else cv2.GC_BGD
            cv2.circle(states, (round(click.x), round(click.y)), radius, int(state), -1)


def _grab(frame: np.ndarray, states: np.ndarray, rounds: int) -> None:
    """GrabCut, in place; the same for the same picture."""
    if not (states & 1).any() or (states & 1).all():
        return
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    with suppress(cv2.error):  # too few pixels of one kind: they stay as they are
        whole = (0, 0, 0, 0)  # not used: the states say where to begin
        picture = np.ascontiguousarray(frame)
        cv2.grabCut(picture, states, whole, *models, rounds, cv2.GC_INIT_WITH_MASK)
