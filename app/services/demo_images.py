"""Pictures of the demo for the Watch and Guide tabs: single frames, and examples of ratings.

Both are made once, on first use, and kept encoded (a few megabytes).
"""

from __future__ import annotations

import logging
import threading
import zlib
from collections.abc import Callable

import cv2
import numpy as np

from onedemo.demos.library import read_frames
from onedemo.errors import UserError
from onedemo.render.clip_image import compose_clip
from onedemo.render.framing import film_sides
from onedemo.render.mover import locate
from onedemo.storage.run_directory import CLIP_FORMAT
from onedemo.storage.store import Store
from onedemo.types import Demo

_JPEG_QUALITY = 88
_MAX_WIDTH = 640
_CLIP_SECONDS = 0.3

_log = logging.getLogger(__name__)


def version_of(store: Store, run: str) -> str:
    """What the addresses of a run's pictures end in, as ``?v=``.

    Browsers keep pictures for good, and clips of other data at the same address have the same numbers.
    """
    made = next(entry["created_at"] for entry in store.runs.all() if entry["id"] == run)
    return f"{zlib.crc32(f'{run} {made} {CLIP_FORMAT}'.encode()):08x}"


class Pictures:
    """Encoded pictures of one demo, safe to use from many threads.

    Args:
        demo: The demo.
        read: Reads its frames, (n, H, W, 3), uint8 RGB.
    """

    def __init__(self, demo: Demo, read: Callable[[Demo], np.ndarray] = read_frames) -> None:
        self.demo = demo
        self._read = read
        self._lock = threading.Lock()
        self._frames: list[bytes] | None = None
        self._examples: dict[str, bytes] = {}
        self._told = False

    def frames(self) -> list[bytes]:
        """Every frame of the demo as JPEG, in order.

        Raises:
            UserError: If the stored video is gone or damaged; this is logged once.
        """
        with self._lock:
            if self._frames is None:
                self._prepare()
            assert self._frames is not None
            return self._frames

    def examples(self) -> dict[str, bytes]:
        """Clips "same", "near", "other" and "far": the demo beside itself at growing distance.

        Raises:
            UserError: As ``frames``.
        """
        with self._lock:
            if self._frames is None:
                self._prepare()
            return self._examples

    def _prepare(self) -> None:
        try:
            frames = self._read(self.demo)
        except UserError as error:
            if not self._told:  # pages ask for hundreds of pictures
                self._told = True
                _log.error("%s", error)
            raise
        length = min(len(frames), max(2, round(_CLIP_SECONDS * self.demo.fps)))
        moments = example_moments(frames, length=length)
        mover = locate(frames)
        examples = {}
        for name, other in moments.items():
            shown = [np.arange(start, start + length) for start in (moments["same"], other)]
            movers = [mover and mover.at(some) for some in shown]
            examples[name] = compose_clip(*film_sides([frames[some] for some in shown], movers))
        self._examples = examples
        self._frames = [_jpeg(frame) for frame in frames]


def example_moments(frames: np.ndarray, *, length: int) -> dict[str, int]:
    """Where to begin the examples, chosen by how different the pictures are.

    The left side is the liveliest moment of the demo. The right side is the same moment ("same"), the
    moment that looks most different ("far"), and those a fifth ("near") and half ("other") as different.

    Args:
        frames: (n, H, W, 3), uint8.
        length: Frames in a clip, at least 2.

    Returns:
        First frames, each at most ``n - length``.
    """
    last = len(frames) - length
    small = np.stack([cv2.resize(frame, (40, 30), interpolation=cv2.INTER_AREA) for frame in frames])
    small = small.reshape(len(frames), -1).astype(np.float32)
    motion = np.abs(np.diff(small, axis=0)).mean(1)
    lively = [motion[start : start + length - 1].sum() for start in range(last + 1)]
    same = int(np.argmax(lively))
    window = small[same : same + length]
    distance = np.array([np.abs(small[s : s + length] - window).mean() for s in range(last + 1)])
    others = np.where(np.arange(last + 1) == same, np.inf, distance)
    most = distance.max()
    return {
        "same": same,
        "near": int(np.argmin(np.abs(others - most / 5))),
        "other": int(np.argmin(np.abs(others - most / 2))),
        "far": int(np.argmax(distance)),
    }


def _jpeg(frame: np.ndarray) -> bytes:
    height, width = frame.shape[:2]
    if width > _MAX_WIDTH:
        size = (_MAX_WIDTH, round(height * _MAX_WIDTH / width))
        frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(
        ".jpg", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
    if not done:
        raise RuntimeError("OpenCV could not encode a frame as JPEG")
    return data.tobytes()
