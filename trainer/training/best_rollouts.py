"""What each iteration looked like: how parts of the demo are rated, and the best rollout to be seen again.

An episode lasts longer than an iteration, so lanes are followed from one to the next. Only positions are
kept (some KB an iteration); pictures and videos are drawn when somebody asks.

Shapes: N lanes, T control steps of an iteration, L steps of an episode, q = 6 positions.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from onedemo.core.files import jpeg_fault, read_whole, replacing, sealed, write_atomic
from onedemo.demos.library import read_frames
from onedemo.demos.video import write_webm
from onedemo.render.clip_image import side_by_side
from onedemo.render.renderer import Renderer, RenderThread
from onedemo.reward.episode_rules import mean_rating
from onedemo.rl.rollouts import Transitions
from onedemo.types import Demo

PARTS = 40
"""Of the demo, each with a mean rating."""
_SHOWN = 6
_WIDTH, _HEIGHT = 160, 120
_QUALITY = 82
_AT_ONCE = 30
"""Pictures in memory while a video is drawn: each is half a megabyte."""


def by_part(rollouts: Transitions, demo_steps: int) -> list[float | None]:
    """Where in the demo the rollouts are rated how.

    Args:
        rollouts: With rewards of ``PracticeRules``, (N, T).
        demo_steps: Control steps of the demo.

    Returns:
        The mean rating in each of ``PARTS`` parts of the demo; None where nobody was.
    """
    moved = rollouts.next_clock - rollouts.clock
    part = np.minimum(rollouts.next_clock, demo_steps - 1) * PARTS // demo_steps
    rewards, steps = (
        np.bincount(part.ravel(), weights=x.ravel(), minlength=PARTS) for x in (rollouts.rewards, moved)
    )
    ratings = mean_rating(rewards[:, None], steps[:, None])
    return [round(float(rating), 3) if n else None for rating, n in zip(ratings, steps, strict=True)]


class Episode(NamedTuple):
    """A whole episode of one lane."""

    qpos: np.ndarray
    """(L, q), float32."""
    clock: np.ndarray
    """Demo step at each, (L,)."""
    rewards: np.ndarray
    """Of each step, (L,)."""
    moved: np.ndarray
    """Demo steps passed in each, (L,)."""

    @property
    def worth(self) -> float:
        """What it is compared by, its return: long and good is better than good and soon over."""
        return float(self.rewards.sum())


class Lanes:
    """Follows lanes from iteration to iteration and puts their episodes together."""

    def __init__(self) -> None:
        self._open: dict[int, list[Episode]] = {}

    def ended(self, rollouts: Transitions) -> list[Episode]:
        """The episodes that ended in an iteration, (N, T), and whose beginning was seen."""
        whole = []
        moved = rollouts.next_clock - rollouts.clock
        for lane, ends in enumerate(rollouts.terminated | rollouts.truncated):
            edges = [0, *(np.flatnonzero(ends) + 1).tolist(), len(ends)]
            for start, stop in itertools.pairwise(edges):
                if start > 0:
                    self._open[lane] = []
                if start == stop or lane not in self._open:
                    continue  # nothing of it yet; or it had begun before anybody looked
                cut = (lane, slice(start, stop))
                parts = self._open[lane]
                parts.append(
                    Episode(
                        rollouts.qpos[cut].astype(np.float32),
                        *(x[cut].copy() for x in (rollouts.clock, rollouts.rewards, moved)),
                    )
                )
                if stop > 0 and ends[stop - 1]:
                    whole.append(Episode(*map(np.concatenate, zip(*parts, strict=True))))
                    parts.clear()
        return whole


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
        self._lanes = Lanes()

    def note(
        self, iteration: int, rollouts: Transitions, frames_of: Callable[[np.ndarray], np.ndarray],
        demo_steps: int,
    ) -> dict[str, Any]:  # fmt: skip
        """Looks at what was done in an iteration, and keeps the best whole episode that ended in it.

        Args:
            iteration: Its number.
            rollouts: What was done, with rewards of ``PracticeRules``, (N, T).
            frames_of: Demo frame at control steps.
            demo_steps: Control steps of the demo.

        Returns:
            "timeline" as ``by_part``; and "best", the episode's mean predicted rating, if one ended.
        """
        told: dict[str, Any] = {"timeline": by_part(rollouts, demo_steps)}
        if whole := self._lanes.ended(rollouts):
            best = max(whole, key=lambda episode: episode.worth)
            self.keep(iteration, best.qpos, frames_of(best.clock))
            told["best"] = float(mean_rating(best.rewards, best.moved))
        return told

    def keep(self, iteration: int, qpos: np.ndarray, frames: np.ndarray) -> None:
        """Keeps the best rollout of an iteration: positions (L, q), and the demo frame beside each (L,)."""
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
        if file.exists() and (suffix != "jpg" or read_whole(file, jpeg_fault)):
            return file
        kept = read_whole(self._file(iteration, "npz"))
        if kept is None:
            raise FileNotFoundError(f"nothing of iteration {iteration} is left")
        with np.load(io.BytesIO(kept), allow_pickle=False) as data:
            qpos, frames = data["qpos"].astype(np.float64), data["frames"]
        if suffix == "jpg":
            strip = self._renderer.submit(lambda renderer: filmstrip(renderer, qpos)).result()
            write_atomic(file, sealed(strip))
        else:
            demo = read_frames(self._demo)
            self._renderer.submit(
                lambda renderer: write_video(
                    file, renderer, qpos, demo, frames, dt=self._dt, fps=self._demo.fps
                )
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
    file: Path, renderer: Renderer, qpos: np.ndarray, demo: np.ndarray, frames: np.ndarray, *, dt: float,
    fps: float,
) -> None:  # fmt: skip
    """A rollout beside the demo, in real time, as WebM.

    Args:
        file: Where to.
        renderer: Draws.
        qpos: Positions, (L, q).
        demo: The demo's frames, (F, H, W, 3), uint8.
        frames: Which of them is beside each position, (L,).
        dt: Seconds of a control step.
        fps: Frames per second of the video.
    """
    shown = np.round(np.arange(0, len(qpos) * dt * fps) / fps / dt).astype(int)
    shown = shown[shown < len(qpos)]

    def pairs() -> Iterator[np.ndarray]:
        for some in np.array_split(shown, -(-len(shown) // _AT_ONCE)):
            for t, robot in zip(some, renderer.render(qpos[some]), strict=True):
                yield side_by_side(demo[frames[t]], robot)

    with replacing(file, ".webm") as half:
        write_webm(half, pairs(), fps=fps)
