"""The pictures of a run: drawn ahead or when somebody looks, once however many do, and deleted in time.

Whatever is drawn comes from positions that are kept, so each of these files can be drawn again. What draws
them may be another process (``onedemo.render.drawing_process``), so the jobs are functions of this module,
which imports nothing heavy, and take nothing but numbers and names.

Shapes: F frames of the demo, L steps of a rollout, k moments of a clip, q positions.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from onedemo.core.files import replacing, sealed, write_atomic
from onedemo.demos.frame_clock import frame_of_step
from onedemo.demos.library import stream_frames
from onedemo.demos.video import write_webm
from onedemo.render.clip_image import compose_clip, side_by_side
from onedemo.render.framing import clip_sides
from onedemo.render.mover import Mover, locate
from onedemo.render.render_thread import Drawing, Order
from onedemo.render.renderer import Renderer
from onedemo.robots.robot import Robot
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.types import Demo, Segment

_SHOWN = 6
"""Moments of a filmstrip."""
_WIDTH, _HEIGHT = 160, 120
_QUALITY = 82
_AT_ONCE = 6
"""Pictures of a film between two looks at what is more urgent."""
_RECENT_S = 60.0
"""A picture that somebody asked for stays so long, whatever room it takes."""

Job = Callable[[Renderer], Any]


class PictureFiles:
    """Files that are drawn, each once however often it is asked for. Safe to use from many threads.

    Args:
        drawing: Draws; not closed here.
        demo: What the robot is shown beside.
        robot: The robot.
    """

    def __init__(self, drawing: Drawing, demo: Demo, robot: Robot) -> None:
        self.demo, self.dt = demo, robot.dt
        self._drawing, self._robot = drawing, robot
        steps = int(demo.frames / demo.fps / robot.dt + 1e-6)
        self._frame = frame_of_step(np.arange(steps), robot.dt, demo.fps, demo.frames)
        self._lock = threading.Lock()
        self._coming: dict[Path, Future[Path]] = {}
        self._asked: dict[Path, float] = {}

    def draw(self, file: Path, job: Callable[[], Job], order: Order = Order.AWAITED) -> Future[Path]:
        """The future of a file that is there, with what its job left in it.

        Args:
            file: Which.
            job: Called if the file is neither there nor being drawn; gives what writes it.
            order: What it comes before, or after.

        Raises:
            Exception: Whatever ``job`` raises; what the drawing raises is in the future.
        """
        with self._lock:
            if order is not Order.AHEAD:
                self._asked[file] = time.monotonic()
            if (coming := self._coming.get(file)) is not None:
                return coming
            future: Future[Path] = Future()
            if file.is_file():
                future.set_result(file)
                return future
            drawn = self._drawing.submit(job(), order, self._robot)
            self._coming[file] = future

        def tell(drawn: Future[None]) -> None:
            with self._lock:
                del self._coming[file]
                if file in self._asked:  # a film may have taken minutes
                    self._asked[file] = time.monotonic()
            if drawn.cancelled():
                future.cancel()
                future.set_running_or_notify_cancel()
            elif (error := drawn.exception()) is not None:
                future.set_exception(error)
            else:
                future.set_result(file)

        drawn.add_done_callback(tell)
        return future

    def recent(self) -> set[Path]:
        """What somebody has asked for and had in the last minute, or has yet to have."""
        since = time.monotonic() - _RECENT_S
        with self._lock:
            self._asked = {f: at for f, at in self._asked.items() if at > since or f in self._coming}
            return set(self._asked)

    def clip(
        self, file: Path, demo_step: int, read: Callable[[], Sequence[Segment]],
        order: Order = Order.AWAITED,
    ) -> Future[Path]:  # fmt: skip
        """The picture of one segment or two beside the demo from a control step on; as ``draw``."""

        def job() -> Job:
            segments = read()
            steps = demo_step + np.arange(len(segments[0]))
            shown = self._frame[np.minimum(steps, len(self._frame) - 1)]
            frames, first = np.unique(shown, return_index=True)
            return partial(
                draw_clip, file=file, demo=self.demo, frames=frames,
                robots=[segment.qpos[first] for segment in segments],
            )  # fmt: skip

        return self.draw(file, job, order)


# What is done where the pictures are drawn


def draw_clip(
    renderer: Renderer, *, file: Path, demo: Demo, frames: np.ndarray, robots: Sequence[np.ndarray]
) -> None:
    """Writes frames of the demo, (k,), beside each robot's positions, (k, q), as one JPEG.

    It is not synced: after a power cut its checksum tells that it must be drawn again.
    """
    film, mover = _filmed(demo, renderer.robot)
    sides = clip_sides(renderer, film[frames], mover and mover.at(frames), robots)
    write_atomic(file, sealed(compose_clip(*sides)), sync=False)


def draw_strip(renderer: Renderer, *, file: Path, qpos: np.ndarray) -> None:
    """Writes six moments of a rollout, (L, q), side by side, as JPEG."""
    moments = np.round(np.linspace(0, len(qpos) - 1, _SHOWN)).astype(int)
    frames = [
        cv2.resize(frame, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
        for frame in renderer.render(qpos[moments])
    ]
    picture = cv2.cvtColor(np.concatenate(frames, axis=1), cv2.COLOR_RGB2BGR)
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a filmstrip")
    write_atomic(file, sealed(encoded.tobytes()), sync=False)


def draw_film(
    renderer: Renderer, *, file: Path, demo: Demo, qpos: np.ndarray, frames: np.ndarray, dt: float,
    title: str = "",
) -> None:  # fmt: skip
    """Writes a rollout beside the demo, in real time, as WebM; lets whatever is more urgent go first.

    Args:
        renderer: Draws.
        file: Where to.
        demo: Beside it.
        qpos: Positions, (L, q).
        frames: Which frame of the demo is beside each, (L,).
        dt: Seconds of a control step.
        title: Of what is at the right; with one, both sides are named in the picture.
    """
    shown = np.round(np.arange(0, len(qpos) * dt * demo.fps) / demo.fps / dt).astype(int)
    shown = shown[shown < len(qpos)]
    film, _ = _filmed(demo, renderer.robot)

    def pairs() -> Iterator[np.ndarray]:
        for some in np.array_split(shown, -(-len(shown) // _AT_ONCE)):
            renderer.between()
            for t, robot in zip(some, renderer.render(qpos[some]), strict=True):
                yield side_by_side(film[frames[t]], robot)

    with replacing(file, ".webm", sync=False) as half:
        write_webm(
            half, (captioned(p, "Demonstration", title) if title else p for p in pairs()), fps=demo.fps
        )


def captioned(picture: np.ndarray, left: str, right: str) -> np.ndarray:
    """A picture of two sides, (H, W, 3), uint8 RGB, with a word at the foot of each; ASCII alone."""
    named = picture.copy()
    height, width, _ = named.shape
    scale = height / 720
    for text, start in ((left, 0), (right, width // 2)):
        place = (start + round(24 * scale), height - round(22 * scale))
        for colour, thickness in (((255, 255, 255), 5), ((24, 32, 43), 1.6)):
            cv2.putText(
                named, text, place, cv2.FONT_HERSHEY_DUPLEX, scale, colour, max(1, round(thickness * scale)),
                cv2.LINE_AA,
            )  # fmt: skip
    return named


@lru_cache(1)
def _filmed(demo: Demo, robot: Robot) -> tuple[np.ndarray, Mover | None]:
    """The demo's pictures, (F, H, W, 3), uint8 RGB, and what moves in them: once, not for each clip."""
    frames = np.stack(list(stream_frames(demo)))
    return frames, locate(frames, robot)


# What is deleted


def spare(files: Collection[tuple[Path, int, float]], keep: Collection[Path], most: float) -> list[Path]:
    """Which pictures to delete, so that the rest takes no more than ``most``: the oldest.

    Args:
        files: Path, bytes and time of the last change of each.
        keep: Those that somebody will look at.
        most: Bytes.
    """
    total, gone = sum(size for _, size, _ in files), []
    for path, size, _ in sorted(files, key=lambda entry: entry[2]):
        if total <= most:
            break
        if path not in keep:
            gone.append(path)
            total -= size
    return gone


def pictures_of(files: RunDirectory) -> list[tuple[Path, int, float]]:
    """Path, bytes and time of the last change of every picture of a run."""
    found = []
    for pattern in ("clips/*.jpg", "pairs/*.jpg", "rollouts/*.jpg", "rollouts/*.webm"):
        for path in files.path.glob(pattern):
            if path.name.startswith("."):  # being written
                continue
            try:
                there = path.stat()
            except FileNotFoundError:  # being written, or deleted meanwhile
                continue
            found.append((path, there.st_size, there.st_mtime))
    return found


def awaited(store: Store, files: RunDirectory) -> set[Path]:
    """The pictures of clips and pairs that wait to be answered."""
    states = ("ready", "cut")
    clips = {files.clip(c.id) for state in states for c in store.clips.waiting(files.run, state)}
    pairs = {files.pair(p.id) for state in states for p in store.comparisons.waiting_pairs(files.run, state)}
    return clips | pairs


def tidy(store: Store, files: RunDirectory, most: float, keep: Collection[Path] = ()) -> int:
    """Deletes the pictures of a run that nobody waits for, oldest first, down to ``most`` bytes in all.

    A server may be running on it: what somebody looks at again is drawn again.

    Args:
        store: Knows what waits.
        files: Of the run.
        most: Bytes.
        keep: What stays as well.

    Returns:
        Bytes freed.
    """
    found = pictures_of(files)
    size = {path: bytes_ for path, bytes_, _ in found}
    gone = spare(found, awaited(store, files) | set(keep), most)
    for path in gone:
        path.unlink(missing_ok=True)
    return sum(size[path] for path in gone)
