"""The rated segments of a run, each read from the database once."""

from __future__ import annotations

import numpy as np

from onedemo.storage.rating_records import RatedSegment, Rating
from onedemo.storage.store import Store
from onedemo.types import Segment


class TrainingSet:
    """What the predictor of one run is fitted on, kept in memory from fit to fit.

    Kept is what a fit looks at: observations and actions, always float32, so that the same events give
    the same fit however often they were read. 2.6 KB a rating with clips of 38 steps. For one thread.

    Args:
        store: Holds ratings and segments.
        run: Whose ratings.
    """

    def __init__(self, store: Store, run: str) -> None:
        self._store, self._run = store, run
        self._kept: dict[int, RatedSegment] = {}

    def at(self, event: int) -> list[RatedSegment]:
        """The ratings that held when ``event`` was written, in the order of their events.

        Only segments of ratings that the last call did not give are read.

        Returns:
            As ``Store.ratings.for_training``, with the segments. Their positions and velocities are left out
            (``qpos`` and ``qvel`` are (W, 0)).
        """
        ratings = self._store.ratings.for_training(self._run, event)
        self._kept = {r.event: self._kept.get(r.event) or self._read(r) for r in ratings}
        return list(self._kept.values())

    def _read(self, rating: Rating) -> RatedSegment:
        whole = self._store.clips.segment(rating.clip)
        nothing = np.empty((len(whole), 0), np.float32)
        segment = Segment(
            obs=whole.obs.astype(np.float32),
            actions=whole.actions.astype(np.float32),
            qpos=nothing,
            qvel=nothing,
        )
        return RatedSegment(
            event=rating.event, demo_step=rating.demo_step, segment=segment, value=rating.value,
            mark=rating.mark, clip=rating.clip,
        )  # fmt: skip
