"""What moves in a video that was sent, shown before it is kept: outlines that the page draws over it.

The search is done by a process of its own (``onedemo.vision.mask_child``); its file lies with the result, so
that it is kept, or discarded, with it.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from aiohttp import web

from onedemo.app.http.uploads import Uploads
from onedemo.app.network.refusals import read_json
from onedemo.errors import UserError
from onedemo.types import Demo
from onedemo.vision.mask_child import find_in_child, hints_of
from onedemo.vision.mask_file import FILE_NAME, read_masks
from onedemo.vision.mask_hints import check_hints
from onedemo.vision.masks import METHODS, SURE, Masks

_FINE = 0.7
"""Pixels of a mask that its outline may be off."""
_PARTS = 6
"""Of an outline, the largest."""


class MaskPreview:
    """Finds what moves in results that wait to be kept.

    Args:
        uploads: Where they wait.
    """

    def __init__(self, uploads: Uploads) -> None:
        self._uploads = uploads

    async def find(self, request: web.Request) -> web.Response:
        """Takes marks, as ``hints_of``, or none; answers with JSON, all pixels of the result.

        ``method`` and ``said``: how the mover was found; ``sure``: frames that are; ``doubt``: of each frame,
        percent; ``outlines``: of each frame its parts, each x and y in turn.
        """
        async with self._uploads.result_of(request) as result:
            told = await read_json(request)
            if not isinstance(told, dict) or not set(told) <= {"box", "clicks"}:
                raise ValueError("marks are a box and clicks")
            hints = hints_of(told)
            demo = _prepared(result)
            check_hints(hints, demo.frames, (demo.width, demo.height))
            await asyncio.to_thread(find_in_child, demo, hints, result / FILE_NAME)
            masks = await asyncio.to_thread(read_masks, result / FILE_NAME)
            if masks is None:
                raise UserError("what was found could not be stored: is the disk full?")
            about = await asyncio.to_thread(_drawn, masks, demo)
        return web.json_response(about)


def _prepared(result: Path) -> Demo:
    """What the demo would be."""
    about = json.loads((result / "demo.json").read_bytes())
    return Demo(
        name="", sha256=about["sha256"], path=result / "video.webm", fps=about["fps"],
        frames=about["frames"], width=about["width"], height=about["height"],
    )  # fmt: skip


def _drawn(masks: Masks, demo: Demo) -> dict[str, Any]:
    seen = bool(masks.masks.any())
    sure = int((masks.doubt < SURE).sum())
    return {
        "method": masks.method,
        "said": METHODS[masks.method] if seen else "",
        "sure": sure,
        "frames": len(masks.doubt),
        "fps": demo.fps,
        "width": demo.width,
        "height": demo.height,
        "doubt": [round(100 * float(doubt)) for doubt in masks.doubt],
        "outlines": outlines(masks.masks, demo.width / masks.masks.shape[2]),
    }


def outlines(masks: np.ndarray, by: float) -> list[list[list[int]]]:
    """The borders of masks, (F, H, W): of each picture its largest parts, each x and y in turn.

    Args:
        masks: What is the mover.
        by: Pixels of the picture a pixel of a mask.
    """
    found = []
    for mask in masks:
        parts, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        largest = sorted(parts, key=cv2.contourArea, reverse=True)[:_PARTS]
        simple = [cv2.approxPolyDP(part, _FINE, True)[:, 0] for part in largest if len(part) > 4]
        found.append([((part + 0.5) * by).round().astype(int).ravel().tolist() for part in simple])
    return found
