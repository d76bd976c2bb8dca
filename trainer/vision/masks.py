"""The mover's silhouette in each picture of a video, with scale, floor and the way of the camera.

Pictures of the robot's own studio are known by their sky, and there all is known. Else the camera stands, or
goes along, told by the corners of what lies still: what differs from the background shows the colours of the
mover, and these, the place in the picture before and the picture's edges show the mover. Where nothing lies
still that could be followed, the colours in the middle of the picture are taken. A box or clicks of somebody
who looks come before all of this.

Shapes: F pictures, H rows, W columns. Places are pixels from the upper left corner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from onedemo.render.mover import is_studio, solid_in_studio, way_in_studio
from onedemo.render.renderer import studio
from onedemo.render.stage import free_above
from onedemo.robots.camera import Camera
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.vision.mask_camera import STANDS, Motion, follow_background
from onedemo.vision.mask_cut import FOLLOWING, STILL, Colours, boxed, clicked, cut, seeds_of
from onedemo.vision.mask_evidence import before_moving, before_still
from onedemo.vision.mask_hints import Hints

LENGTH = 1.55
"""Metres of the robot at its longest, as a mask's diagonal: the hopper's, seen in one picture of twenty."""
SURE = 0.5
"""Doubt below which a mask is taken to be right."""
_LONGEST = 95
"""Percentile of the masks' diagonals that is the mover stretched out."""
_TOUCHES = 75
"""Percentile of the masks' lower edges that is the floor of a camera that goes: what shines shows more."""
_OWN = 1.0
"""Logarithm of the odds from which on a colour is the mover's own."""
_CHANGED = 0.15
"""Share of the picture that may differ from the median picture where the camera stands."""
_AROUND = 2
"""Pictures before and after with which a mask is compared."""


_Found = tuple[np.ndarray, np.ndarray, float]
"""Masks, how large what else might be the mover is beside each, and how far apart the colours are."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Masks:
    """What is known of the mover in a video."""

    masks: np.ndarray
    """What of each picture is the mover, (F, H, W), bool."""
    floor: np.ndarray
    """The row of the floor under it in each picture, (F,); nan where it is not known."""
    scale: float
    """Pixels a metre, where the mover is."""
    way: np.ndarray | None
    """Metres that the camera has gone to the right since the first picture, (F,); None: not known."""
    doubt: np.ndarray
    """How unsure each mask is, (F,): 0 is sure, 1 may be anything."""
    method: str
    """How the mover was found: a key of ``METHODS``."""

    @property
    def place(self) -> np.ndarray | None:
        """Metres that the middle of the mover has gone to the right, (F,); nan where it is not seen."""
        if self.way is None:
            return None
        columns = np.arange(self.masks.shape[2]) + 0.5
        area = self.masks.sum(axis=(1, 2))
        middle = (self.masks.sum(axis=1) @ columns) / np.where(area, area, np.nan)
        return self.way + (middle - self.masks.shape[2] / 2) / self.scale

    def of_length(self, length: float) -> Masks:
        """The same of a robot that is so long, in metres, stretched out as ``LENGTH`` is.

        In the robot's own studio the scale is known, and stays.
        """
        if self.method == "studio" or not (extent := longest(self.masks)):
            return self
        scale = extent / length
        way = None if self.way is None else self.way * (self.scale / scale)
        return replace(self, scale=scale, way=way)


METHODS = {
    "studio": "drawn by this program: colours, floor and camera are known",
    "still": "against a background that stands still",
    "following": "against a background that goes by",
    "colour": "by its colours in the middle of the picture",
    "chosen": "from what was marked in the picture",
}
"""How a mover can be found, in words."""


def find_masks(
    frames: np.ndarray, *, length: float = LENGTH, hints: Hints | None = None,
    check: Callable[[float], None] = lambda _: None, robot: str = DEFAULT,
) -> Masks:  # fmt: skip
    """Finds the mover.

    Args:
        frames: (F, H, W, 3), uint8 RGB; 160 to 320 columns are enough, and what this is tuned for.
        length: Metres of the robot at its longest, of which the scale is made.
        hints: What somebody says of where it is, in pixels of these pictures.
        check: Called every now and then with the share that is done; what it raises ends the search.
        robot: Whose studio it is, if it is this program's.
    """
    frames = np.ascontiguousarray(frames)
    if not hints and is_studio(frames):
        return _in_studio(frames, robot_named(robot).camera)
    greys = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames])
    motion = follow_background(greys)
    check(0.2)
    still = _stands(frames, motion)
    evidence: np.ndarray | None = None
    if still:
        evidence = before_still(frames)
    elif motion.known:
        evidence = before_moving(frames, motion)
    check(0.5)
    method = "still" if still else "following" if evidence is not None else "colour"
    found = None if evidence is None else _by_evidence(frames, evidence, follows=not still)
    if hints:
        method, found = "chosen", _marked(frames, evidence, STILL if still else FOLLOWING, hints, found)
    elif found is None:
        method, found = "colour", _by_colour(frames)
    if found is None:
        found = np.zeros(frames.shape[:3], bool), np.ones(len(frames)), 0.0
    masks, others, apart = found
    check(0.9)
    if not still:  # again, without the mover
        motion = follow_background(greys, masks)
    scale = longest(masks) / length
    floor, way = _ground(masks, None if still else motion)
    return Masks(
        masks=masks, floor=floor, scale=scale or 1.0, way=None if way is None else way / (scale or 1.0),
        doubt=_doubt(masks, others, apart, method), method=method,
    )  # fmt: skip


def longest(masks: np.ndarray) -> float:
    """Diagonal of the box around the mover where it is stretched out, pixels; 0.0 if it is never seen."""
    boxes = boxes_of(masks)
    diagonals = np.hypot(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1])
    seen = diagonals[~np.isnan(diagonals)]
    return float(np.percentile(seen, _LONGEST)) if len(seen) else 0.0


def boxes_of(masks: np.ndarray) -> np.ndarray:
    """Left, top, right, bottom of each mask, (F, 4), pixels; nan where it is empty."""
    boxes = np.full((len(masks), 4), np.nan)
    for box, mask in zip(boxes, masks, strict=True):
        if mask.any():
            x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
            box[:] = x, y, x + width, y + height
    return boxes


def _in_studio(frames: np.ndarray, camera: Camera) -> Masks:
    height, width = frames.shape[1:3]
    view = studio(width, height, camera)
    solids = np.stack([solid_in_studio(frame) for frame in frames])
    masks = solids.astype(bool)
    floor = np.full(len(frames), height + view.bottom * view.scale)
    top = height - (camera.height + free_above(camera) - 0.03 - view.bottom) * view.scale
    floor[boxes_of(masks)[:, 1] < top] = np.nan  # the camera rises with the robot
    return Masks(
        masks=masks, floor=floor, scale=view.scale, way=way_in_studio(frames, solids, camera),
        doubt=_doubt(masks, np.zeros(len(frames)), 1.0, "studio"), method="studio",
    )  # fmt: skip


def _stands(frames: np.ndarray, motion: Motion) -> bool:
    """Whether the camera does: nothing says that it goes, or little of the picture changes."""
    some = frames[np.linspace(0, len(frames) - 1, min(len(frames), 32)).astype(int)]
    background = np.median(some, axis=0).astype(np.uint8)
    changed = float(np.mean([(cv2.absdiff(frame, background).max(axis=2) > 30).mean() for frame in some]))
    if not motion.known:
        return changed < _CHANGED
    pace = motion.pace(frames.shape[1:3])  # corners of a mover before a plain wall pull some of it along
    return bool((np.median(pace) if changed < _CHANGED / 2 else pace.max()) < STANDS)


def _by_evidence(frames: np.ndarray, evidence: np.ndarray, *, follows: bool) -> _Found | None:
    inside, outside = seeds_of(evidence, follows=follows)
    if (inside.any(axis=(1, 2))).sum() < max(2, len(frames) // 20):
        return None
    share = _share(inside)
    colours = Colours(frames, inside, outside, share)
    own = np.stack([colours.odds(frame) > _OWN for frame in frames]) & inside
    if own.sum() > 0.3 * inside.sum():  # what else moved there, or seemed to, is left out
        inside, colours = own, Colours(frames, own, outside | (inside & ~own), share)
    start = _surest(frames, inside, colours)
    masks, others = cut(frames, evidence, colours, start, FOLLOWING if follows else STILL)
    return masks, others, colours.apart


def _surest(frames: np.ndarray, inside: np.ndarray, colours: Colours) -> int:
    """The picture in which most of what is taken for the mover has its colours, and least has not."""
    odds = [colours.odds(frame)[mask] for frame, mask in zip(frames, inside, strict=True)]
    return int(np.argmax([np.clip(each, -3, 3).sum() for each in odds]))


def _grown(masks: np.ndarray) -> np.ndarray:
    """Masks with what is close around them, (F, H, W), bool."""
    kernel = np.ones((7, 7), np.uint8)
    return np.stack([cv2.dilate(mask.astype(np.uint8), kernel) for mask in masks]).astype(bool)


def _share(inside: np.ndarray) -> np.ndarray | None:
    """How much each place counts as background, (H, W): less where the mover often is, as in the median."""
    often = inside.mean(axis=0) > 0.03
    if not often.any():
        return None
    hull = np.zeros(often.shape, np.uint8)
    points = cv2.findNonZero(often.astype(np.uint8))
    cv2.fillConvexPoly(hull, cv2.convexHull(points), 1)
    return np.where(hull > 0, np.float32(0.1), np.float32(1.0))


def _by_colour(frames: np.ndarray) -> _Found:
    """By the colours in the middle that are not those of the border, learned anew from what they show."""
    height, width = frames.shape[1:3]
    rows, columns = np.mgrid[:height, :width]
    away = np.hypot((columns + 0.5) / width - 0.5, ((rows + 0.5) / height - 0.5) * height / width)
    inside = np.broadcast_to(away < 0.16, frames.shape[:3])
    outside = np.broadcast_to(away > 0.36, frames.shape[:3])
    colours = Colours(frames, inside, outside)
    masks, others = cut(frames, None, colours, len(frames) // 2, FOLLOWING)
    for _ in range(2):
        if not masks.any():
            break
        colours = Colours(frames, masks, ~_grown(masks))
        masks, others = cut(frames, None, colours, len(frames) // 2, FOLLOWING)
    return masks, others, colours.apart


def _marked(
    frames: np.ndarray, evidence: np.ndarray | None, moves: float, hints: Hints, found: _Found | None
) -> _Found | None:
    """From the box, or what was found without it, and then with the places that are the mover or are not."""
    if hints.box is not None:
        index = hints.box.frame
        found = _from_seeds(frames, evidence, moves, {index: boxed(frames[index], hints.box, hints.clicks)})
    elif found is None:
        found = _by_colour(frames)
    marked = {click.frame for click in hints.clicks}
    if not marked or found is None:
        return found
    seeds = {index: clicked(frames[index], found[0][index], hints.clicks, index) for index in sorted(marked)}
    return _from_seeds(frames, evidence, moves, seeds)


def _from_seeds(
    frames: np.ndarray, evidence: np.ndarray | None, moves: float, seeds: dict[int, np.ndarray]
) -> _Found | None:
    seeds = {index: seed for index, seed in seeds.items() if seed.any()}
    if not seeds:
        return None
    inside = np.stack(list(seeds.values()))
    colours = Colours(frames[list(seeds)], inside, ~inside)
    start = max(seeds, key=lambda index: seeds[index].sum())
    return *cut(frames, evidence, colours, start, moves, seeds), colours.apart


def _ground(masks: np.ndarray, motion: Motion | None) -> tuple[np.ndarray, np.ndarray | None]:
    """The row of the floor, and the way of the camera in pixels at the mover; motion None: it stands."""
    boxes = boxes_of(masks)
    bottom = boxes[:, 3]
    count = len(masks)
    if np.isnan(bottom).all():
        return np.full(count, np.nan), None
    if motion is None:
        return np.full(count, np.nanpercentile(bottom, _LONGEST)), np.zeros(count)
    if not motion.known:
        return np.full(count, np.nan), None
    middle = _filled((boxes[:, 0] + boxes[:, 2]) / 2)
    first = np.nanpercentile(bottom, 80)
    floor, gone = _carried(motion, middle, first)
    for _ in range(8):  # where the floor is first, so that the mover reaches it and does not sink in
        first += float(np.nanpercentile(bottom - floor, _TOUCHES))
        floor, gone = _carried(motion, middle, first)
    return floor, -gone


def _carried(motion: Motion, columns: np.ndarray, row: float) -> tuple[np.ndarray, np.ndarray]:
    """The row of what lies still at a row of the first picture, (F,), and by how much it goes right, (F,)."""
    rows, gone = np.full(len(columns), row), np.zeros(len(columns))
    for index, move in enumerate(motion.maps):
        x, y = move @ (columns[index], rows[index], 1.0)
        rows[index + 1], gone[index + 1] = y, gone[index] + x - columns[index]
    return rows, gone


def _filled(track: np.ndarray) -> np.ndarray:
    """(F,), with gaps bridged by straight lines."""
    seen = np.flatnonzero(~np.isnan(track))
    return np.interp(np.arange(len(track)), seen, track[seen])


def _doubt(masks: np.ndarray, others: np.ndarray, apart: float, method: str) -> np.ndarray:
    """How unsure each mask is.

    Args:
        masks: (F, H, W), bool.
        others: How large what else might be the mover is beside it, (F,), share of its area.
        apart: Share of the mover's colours that are not those behind it.
        method: How it was found.
    """
    area = masks.sum(axis=(1, 2)).astype(float)
    doubts = [
        np.clip((_jump(area) - 0.2) / 0.5, 0, 1),
        np.clip((_changed(masks) - 0.25) / 0.4, 0, 1),
        np.where(_at_border(masks), 0.6, 0.0),
        np.clip(others - 0.1, 0, 0.8),
        np.full(len(masks), {"studio": 0.0, "colour": 0.35}.get(method, 0.05)),
        np.full(len(masks), np.clip(0.6 - apart, 0, 0.6)),
    ]
    unsure = 1 - np.prod([1 - doubt for doubt in doubts], axis=0)
    unsure[area == 0] = 1
    large = area > 0.45 * masks[0].size
    unsure[large] = np.maximum(unsure[large], 0.8)
    return unsure.astype(np.float32)


def _jump(area: np.ndarray) -> np.ndarray:
    """By which factor an area differs from those around it, as a logarithm, (F,)."""
    logs = np.log(np.maximum(area, 1))
    padded = np.pad(logs, 2 * _AROUND, mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, 4 * _AROUND + 1)
    return np.abs(logs - np.median(around, axis=1))


def _changed(masks: np.ndarray) -> np.ndarray:
    """Which share of a mask lies beside the one before, brought over it, (F,); limbs may turn a little."""
    changed = np.zeros(len(masks))
    reach = max(3, round(0.12 * longest(masks))) | 1
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    centres = [np.argwhere(mask).mean(axis=0) if mask.any() else None for mask in masks]
    for index in range(1, len(masks)):
        before, here = centres[index - 1], centres[index]
        if before is None or here is None:
            continue
        y, x = np.round(here - before).astype(int)
        moved = cv2.dilate(np.roll(masks[index - 1], (y, x), (0, 1)).astype(np.uint8), around)
        changed[index] = (masks[index] & (moved == 0)).sum() / masks[index].sum()
    return changed


def _at_border(masks: np.ndarray) -> np.ndarray:
    """Whether a mask reaches the picture's border, (F,)."""
    edges = masks[:, 0], masks[:, -1], masks[:, :, 0], masks[:, :, -1]
    return np.any([edge.any(axis=1) for edge in edges], axis=0)
