"""The curves of runs over HTTP, for the charts: JSON, for researchers alone."""

from __future__ import annotations

import asyncio
from functools import lru_cache
from typing import Any, Protocol

from aiohttp import web

from onedemo.app.services.curves import curves
from onedemo.demos.library import list_demos
from onedemo.errors import UserError
from onedemo.evaluation.demo_level import predicted_rating_of, true_reward_of
from onedemo.reward.model import Snapshot
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.types import Demo


class Charted(Protocol):
    """What is needed of a trainer."""

    store: Store
    run: str
    demo: Demo


class Shown(Protocol):
    """What is needed of a page."""

    @property
    def trainer(self) -> Charted:
        """The run that is served."""
        ...


class Curves:
    """The handler.

    Args:
        page: Whose run is the one at hand.
    """

    def __init__(self, page: Shown) -> None:
        self._page = page
        self._level = lru_cache(32)(true_reward_of)
        self._ratings: dict[str, tuple[int, float | None]] = {}
        self._demos: dict[str, Demo] = {}

    async def curves(self, request: web.Request) -> web.StreamResponse:
        """The iterations of a run.

        Query: ``run``, a name; ``after``, number of the last iteration that is known, 0 if none is.
        """
        run, after = request.query.get("run", ""), request.query.get("after", "0")
        if not (run and len(run) <= 200 and after.isdecimal() and len(after) <= 12):
            raise web.HTTPBadRequest(text="Curves are asked for by run and number.")
        told = await asyncio.to_thread(self._told, run, int(after))
        if told is None:
            raise web.HTTPNotFound(text="There is no such run.")
        return web.json_response(told)

    def _told(self, run: str, after: int) -> dict[str, Any] | None:
        trainer = self._page.trainer
        row = next((row for row in trainer.store.runs.all() if row["id"] == run), None)
        if row is None:
            return None
        told = curves(trainer.store, run, after)
        demo = self._demo(row["demo_sha256"])
        levels = {}
        if demo is not None:
            levels = {"true_reward": self._level(demo), "reference": self._rating(row, demo, told["columns"])}
        return {
            "run": run,
            "title": row["title"],
            "colour": trainer.store.runs.numbers()[run],
            "live": run == trainer.run,
            "levels": {name: level for name, level in levels.items() if level is not None},
            **told,
        }

    def _rating(self, row: dict[str, Any], demo: Demo, columns: dict[str, list]) -> float | None:
        """What a run's newest reward model gives to the demo itself, if no iteration has it on record."""
        run, newest = row["id"], (columns["snapshot"] or [0])[-1]
        if any(level is not None for level in columns["reference"]):
            self._ratings[run] = newest, None
        elif newest and self._ratings.get(run, (0, None))[0] != newest:
            file = RunDirectory(self._page.trainer.store.path.parent, run).snapshot(newest)
            try:
                rating = predicted_rating_of(demo, Snapshot.load(file), row["step_seconds"])
            except (OSError, UserError):  # imported without it, or damaged: the trainer says so
                rating = None
            self._ratings[run] = newest, rating
        return self._ratings.get(run, (0, None))[1]

    def _demo(self, sha256: str) -> Demo | None:
        """That of a run; None if it is not in the library any more."""
        demo = self._page.trainer.demo
        if demo.sha256 != sha256 and sha256 not in self._demos:
            there = list_demos(self._page.trainer.store.path.parent / "demos")
            self._demos = {demo.sha256: demo for demo in there}
        return demo if demo.sha256 == sha256 else self._demos.get(sha256)
