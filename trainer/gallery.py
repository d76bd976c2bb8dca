"""What each iteration looked like: how parts of the demo are rated, and the best rollout to be seen again.

Only positions are kept (a few KB an iteration); pictures and videos are drawn when somebody asks.

Shapes: N lanes, T control steps, k frames, q = 6 positions.
"""

from __future__ import annotations

import io
import itertools
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from trainer.clips import side_by_side
from trainer.demos import read_frames
from trainer.files import write_atomic
from trainer.predictor import Snapshot
from trainer.records import Demo, Rollouts
from trainer.render import Renderer, RenderThread
from trainer.video import write_webm

PARTS = 40
"""Of the demo, each with a mean rating."""
_EVERY = 5
"""Control steps between those that are rated for this."""
_SHOWN = 6
_WIDTH, _HEIGHT = 160, 120
_QUALITY = 82


def summarise(
    snapshot: Snapshot, rollouts: Rollouts, frames_of: Callable[[np.ndarray], np.ndarray], demo_steps: int
) -> tuple[list[float | None], int, float]:
    """Of one iteration: where in the demo it is rated how, and which lane did best.

    Args:
        snapshot: Rates.
        rollouts: What was done, (N, T).
        frames_of: Demo frame at control steps.
        demo_steps: Control steps of the demo.

    Returns:
        Mean predicted rating in each of ``PARTS`` parts of the demo (None where nobody was), the lane with
        the highest mean, and that mean.
    """
    some = (slice(None), slice(None, None, _EVERY))
    clock = rollouts.clock[some]
    ratings = snapshot.ratings(frames_of(clock), rollouts.obs[some], rollouts.actions[some])
    part = np.minimum(clock * PARTS // demo_steps, PARTS - 1).ravel()
    counts = np.bincount(part, minlength=PARTS)
    sums = np.bincount(part, weights=ratings.ravel(), minlength=PARTS)
    means = [round(float(s / n), 3) if n else None for s, n in zip(sums, counts, strict=True)]
    of_lanes = ratings.mean(axis=1)
    best = int(of_lanes.argmax())
    return means, best, float(of_lanes[best])


def longest(ended: np.ndarray) -> slice:
    """The longest stretch of steps within one episode, where some steps end one: (T,) bool."""
    edges = [0, *(np.flatnonzero(ended) + 1).tolist(), len(ended)]
    start, stop = max(itertools.pairwise(edges), key=lambda edge: edge[1] - edge[0])
    return slice(start, stop)


class Gallery:
    """The best rollouts of one run.

    Args:
        directory: Where they are kept.
        demo: What they are shown beside.
        dt: Seconds of a control step.
        renderer: Draws; not closed here.
    """

    def __init__(self, directory: Path, demo: Demo, dt: float, renderer: RenderThread) -> None:
        self._directory, self._demo, self._dt, self._renderer = directory, demo, dt, renderer

    def keep(self, iteration: int, qpos: np.ndarray, frames: np.ndarray) -> None:
        """Keeps the best rollout of an iteration: positions (T, q), and the demo frame beside each (T,)."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, qpos=qpos.astype(np.float32), frames=frames.astype(np.int32))
        write_atomic(self._file(iteration, "npz"), buffer.getvalue())

    def file(self, iteration: int, suffix: str) -> Path:
        """The best rollout of an iteration as a filmstrip ("jpg") or a video ("webm"), drawn when asked for.

        Any thread may ask; it waits for the render thread.

        Raises:
            FileNotFoundError: If none was kept.
        """
        file = self._file(iteration, suffix)
        if file.exists():
            return file
        with np.load(self._file(iteration, "npz"), allow_pickle=False) as data:
            qpos, frames = data["qpos"].astype(np.float64), data["frames"]
        if suffix == "jpg":
            write_atomic(file, self._renderer.submit(lambda renderer: filmstrip(renderer, qpos)).result())
        else:
            beside = read_frames(self._demo)[frames]
            self._renderer.submit(
                lambda renderer: write_video(file, renderer, qpos, beside, dt=self._dt, fps=self._demo.fps)
            ).result()
        return file

    def _file(self, iteration: int, suffix: str) -> Path:
        return self._directory / f"{iteration:06d}.{suffix}"


def filmstrip(renderer: Renderer, qpos: np.ndarray) -> bytes:
    """Six moments of a rollout side by side, as JPEG.

    Args:
        renderer: Draws.
        qpos: Positions, (T, q).
    """
    moments = np.round(np.linspace(0, len(qpos) - 1, _SHOWN)).astype(int)
    frames = [
        cv2.resize(frame, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
        for frame in renderer.render(qpos[moments])
    ]
    picture = cv2.cvtColor(np.concatenate(frames, axis=1), cv2.COLOR_RGB2BGR)
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a filmstrip")
    return encoded.tobytes()


def write_video(
    file: Path, renderer: Renderer, qpos: np.ndarray, demo_frames: np.ndarray, *, dt: float, fps: float
) -> None:
    """A rollout beside the demo, in real time, as WebM.

    Args:
        file: Where to.
        renderer: Draws.
        qpos: Positions, (T, q).
        demo_frames: The demo's frame beside each of them, (T, H, W, 3), uint8.
        dt: Seconds of a control step.
        fps: Frames per second of the video.
    """
    shown = np.round(np.arange(0, len(qpos) * dt * fps) / fps / dt).astype(int)
    shown = shown[shown < len(qpos)]
    robot = renderer.render(qpos[shown])
    half = file.with_name(f".half-{os.getpid()}-{file.name}")
    try:
        pairs = (side_by_side(demo_frames[t], picture) for t, picture in zip(shown, robot, strict=True))
        write_webm(half, pairs, fps=fps)
        half.replace(file)
    finally:
        half.unlink(missing_ok=True)
