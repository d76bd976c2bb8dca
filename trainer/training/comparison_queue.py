"""Makes pairs for people to compare, while somebody looks: cut from the newest rollouts and drawn.

Shapes: N lanes, T control steps, W control steps a clip.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import numpy as np

from onedemo.core.files import jpeg_fault, read_whole
from onedemo.queries.selection import choose
from onedemo.render.render_thread import Order
from onedemo.storage.comparisons import NewPair, Pair
from onedemo.storage.store import Store
from onedemo.training.clip_worker import Notes
from onedemo.training.learner import Learner
from onedemo.training.pictures import PictureFiles
from onedemo.types import Rollouts

log = logging.getLogger("onedemo")

_QUEUE = 6
_WANTED_S = 10.0
"""Pairs are made for so long after somebody looked last."""
_NEAR = 8
"""Control steps that the clocks of a pair's clips may differ."""


class ComparisonQueue:
    """The pairs of one run.

    Args:
        store: Holds them.
        run: Name of the run.
        file: Where the picture of a pair goes.
        pictures: Has them drawn.
        seed: Of what is drawn by lot.
    """

    def __init__(
        self,
        store: Store,
        run: str,
        file: Callable[[int], Path],
        pictures: PictureFiles,
        seed: int,
    ) -> None:
        self._store, self._run, self._file = store, run, file
        self._pictures = pictures
        self._rng = np.random.default_rng([seed, 1207])
        self._notes = Notes()
        self._wanted_until = 0.0
        self._begun = False

    def want(self) -> None:
        """Somebody looks; any thread may say so."""
        self._wanted_until = time.monotonic() + _WANTED_S

    def fill(self, learner: Learner, pool: Rollouts | None) -> None:
        """Cuts what is missing from the queue, if somebody looks, and has it drawn."""
        if pool is None or time.monotonic() > self._wanted_until:
            return
        ready = self._store.comparisons.waiting_pairs(self._run)
        oldest = learner.iteration - _OLD
        stale = [p.id for p in ready if p.iteration < oldest or not self._file(p.id).exists()]
        if not self._begun:  # a process before this one was to draw them, or has drawn them
            stale += [p.id for p in self._store.comparisons.waiting_pairs(self._run, "cut")]
            stale += [p.id for p in ready if not read_whole(self._file(p.id), jpeg_fault)]
            self._begun = True
        self._store.comparisons.set_pair_state(stale, "withdrawn")
        waiting = [
            p for state in ("ready", "cut") for p in self._store.comparisons.waiting_pairs(self._run, state)
        ]
        drawn = draw_pairs(
            pool, _QUEUE - len(waiting), learner.clip_steps, learner.demo_steps, self._rng,
            any_time=learner.config.ratings.pairing == "any" and learner.iteration == 0,
        )  # fmt: skip
        new = [
            NewPair(
                demo_step=demo_step,
                left=pool.segment(*left, learner.clip_steps),
                right=pool.segment(*right, learner.clip_steps),
                stage="pretrain" if learner.iteration == 0 else "online",
                iteration=learner.iteration,
            )
            for demo_step, left, right in drawn
        ]
        for pair in self._store.comparisons.add_pairs(self._run, new):
            drawn = self._drawn(pair.id, pair.demo_step, Order.AHEAD)
            drawn.add_done_callback(lambda future, pair=pair: self._note(future, pair))

    def picture(self, pair_id: int) -> Future[Path]:
        """The future of a pair's picture, which is drawn again if it was deleted.

        Raises:
            KeyError: If there is no such pair.
        """
        return self._drawn(pair_id, self._store.comparisons.pair_step(pair_id), Order.AWAITED)

    def _drawn(self, pair_id: int, demo_step: int, order: Order) -> Future[Path]:
        return self._pictures.clip(
            self._file(pair_id), demo_step, lambda: self._store.comparisons.pair_segments(pair_id), order
        )

    def _note(self, future: Future[Path], pair: Pair) -> None:
        if future.cancelled():
            return
        state = "ready"
        if (error := future.exception()) is not None:
            log.error("pair %d could not be drawn", pair.id, exc_info=error)
            state = "withdrawn"
        self._notes.add(partial(self._store.comparisons.set_pair_state, [pair.id], state))


_OLD = 10
"""Iterations after which a pair that nobody answered expires."""

Place = tuple[int, int]
"""Lane and first step."""


def draw_pairs(
    rollouts: Rollouts, count: int, clip_steps: int, demo_steps: int, rng: np.random.Generator, *,
    any_time: bool,
) -> list[tuple[int, Place, Place]]:  # fmt: skip
    """Pairs of clips beside the same moment of the demo, uniformly.

    Args:
        rollouts: What the agent did, (N, T).
        count: How many pairs.
        clip_steps: W.
        demo_steps: Control steps of the demo.
        rng: Decides.
        any_time: Any two clips may be a pair, beside any moment; else both are within a few steps of it.

    Returns:
        Demo step, left and right of each; fewer if there are not enough.
    """
    if count <= 0:
        return []
    asked = choose(rollouts, 40 * count, clip_steps, demo_steps, rng, any_time=any_time, how="uniform")
    pairs: list[tuple[int, Place, Place]] = []
    used: set[int] = set()
    for i, left in enumerate(asked):
        if len(pairs) == count:
            break
        for j in range(i + 1, len(asked)):
            right = asked[j]
            near = any_time or abs(left.demo_step - right.demo_step) <= _NEAR
            if i in used or j in used or not near:
                continue
            used |= {i, j}
            pairs.append((left.demo_step, (left.lane, left.start), (right.lane, right.start)))
            break
    return pairs
