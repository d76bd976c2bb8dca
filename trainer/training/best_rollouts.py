"""What each iteration looked like: how parts of the demo are rated, and the best rollout to be seen again.

An episode lasts longer than an iteration, so lanes are followed from one to the next. Only positions are
kept (some KB an iteration); pictures and videos are drawn when somebody asks.

Shapes: N lanes, T control steps of an iteration, L steps of an episode, q = 6 positions.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from onedemo.core.files import jpeg_fault, read_whole, write_atomic
from onedemo.render.render_thread import Order
from onedemo.reward.episode_rules import mean_rating
from onedemo.rl.rollouts import Transitions
from onedemo.training.pictures import Job, PictureFiles, draw_film, draw_strip

PARTS = 40
"""Of the demo, each with a mean rating."""


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
        pictures: Has them drawn; None if nobody looks.
    """

    def __init__(self, directory: Path, pictures: PictureFiles | None) -> None:
        self._directory, self._pictures = directory, pictures
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

    def picture(self, iteration: int, suffix: str) -> Future[Path]:
        """The best rollout of an iteration as a filmstrip ("jpg") or a video ("webm"), drawn when asked for.

        Any thread may ask. Videos are made behind clips, one at a time.

        Raises:
            FileNotFoundError: If none was kept.
        """
        assert self._pictures is not None, "nothing is drawn here"
        file = self._file(iteration, suffix)
        if suffix == "jpg":
            read_whole(file, jpeg_fault)  # one that is damaged is set aside
        order = Order.AWAITED if suffix == "jpg" else Order.FILM
        return self._pictures.draw(file, lambda: self._job(iteration, file), order)

    def _job(self, iteration: int, file: Path) -> Job:
        assert self._pictures is not None
        kept = read_whole(self._file(iteration, "npz"))
        if kept is None:
            raise FileNotFoundError(f"nothing of iteration {iteration} is left")
        with np.load(io.BytesIO(kept), allow_pickle=False) as data:
            qpos, frames = data["qpos"].astype(np.float64), data["frames"]
        if file.suffix == ".jpg":
            return partial(draw_strip, file=file, qpos=qpos)
        return partial(
            draw_film, file=file, demo=self._pictures.demo, qpos=qpos, frames=frames, dt=self._pictures.dt,
            title=f"Robot, iteration {iteration}",
        )  # fmt: skip

    def _file(self, iteration: int, suffix: str) -> Path:
        return self._directory / f"{iteration:06d}.{suffix}"
