"""Pictures of the demo for the Watch and Guide tabs: single frames, and examples of ratings.

Both are made once, on first use, and kept encoded (a few megabytes).
"""

from __future__ import annotations

import logging
import threading
import zlib
from collections.abc import Callable
from itertools import groupby
from operator import attrgetter

import cv2
import numpy as np

from onedemo.app.annotation.examples import Example, Examples, choose
from onedemo.demos.library import built_in, read_frames
from onedemo.errors import UserError
from onedemo.render.clip_image import compose_clip
from onedemo.render.framing import film_sides
from onedemo.render.mover import locate
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.robots.robot import Robot
from onedemo.storage.run_directory import CLIP_FORMAT
from onedemo.storage.store import Store
from onedemo.types import Demo
from onedemo.vision.pose_estimator import Track, shipped_track

_JPEG_QUALITY = 88
_MAX_WIDTH = 640
_CLIP_SECONDS = 0.3

_source = attrgetter("source")

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
        track: What its frames show of the robot, as soon as that is known; None: not yet, or nothing.
        robot: The robot; the hopper if None.
    """

    def __init__(
        self, demo: Demo, read: Callable[[Demo], np.ndarray] = read_frames,
        track: Callable[[], Track | None] = lambda: None, robot: Robot | None = None,
    ) -> None:  # fmt: skip
        self.demo = demo
        self._robot = robot or robot_named(DEFAULT)
        self._read = read
        self._track, self._choosing = track, threading.Lock()
        self._shown = shipped_track(demo)
        self._others = {
            d.name: d for d in built_in()
            if d.fps == demo.fps and d.path != demo.path and d.robot == self._robot.name
        }  # fmt: skip
        self._length = min(demo.frames, max(2, round(_CLIP_SECONDS * demo.fps)))
        self._chosen: Examples | None = None
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
        """Pictures of the examples that are chosen, and of those that were, by name.

        Raises:
            UserError: As ``frames``.
        """
        chosen = self.chosen()
        with self._lock:
            if self._frames is None or any(e.name not in self._examples for e in _all_of(chosen)):
                self._prepare()
            return self._examples

    def chosen(self) -> Examples:
        """Examples of ratings: few at first, all once it is known what the frames show."""
        with self._choosing:
            if self._chosen is None or (self._shown is None and self._track() is not None):
                self._shown = self._shown or self._track()
                tracks = {name: shipped_track(demo) for name, demo in self._others.items()}
                others = {name: track for name, track in tracks.items() if track is not None}
                self._chosen = choose(self._shown, self.demo.frames, self._length, others, self._robot)
            return self._chosen

    def _prepare(self) -> None:
        try:
            frames = self._read(self.demo)
        except UserError as error:
            if not self._told:  # pages ask for hundreds of pictures
                self._told = True
                _log.error("%s", error)
            raise
        length, examples = self._length, dict(self._examples)
        mover = locate(frames, self._robot)
        for source, wanted in groupby(sorted(_all_of(self._chosen), key=_source), key=_source):
            there = self._read(self._others[source]) if source else frames
            mover_there = locate(there, self._robot) if source else mover
            for example in wanted:
                left = np.arange(example.left, example.left + length)
                right = np.arange(example.right, example.right + length)
                movers = [mover and mover.at(left), mover_there and mover_there.at(right)]
                sides = film_sides([frames[left], there[right]], movers, self._robot.camera)
                examples[example.name] = compose_clip(*sides)
        self._examples = examples
        self._frames = self._frames or [_jpeg(frame) for frame in frames]


def _all_of(examples: Examples | None) -> tuple[Example, ...]:
    return (*examples.guide, *examples.practice) if examples is not None else ()


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
