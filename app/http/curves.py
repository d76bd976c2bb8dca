"""The curves of runs over HTTP, for the charts: JSON, for researchers alone."""

from __future__ import annotations

import asyncio
from functools import lru_cache
from typing import Any, Protocol

from aiohttp import web

from onedemo.app.services.curves import curves
from onedemo.evaluation.demo_level import true_reward_of
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
        self._level = lru_cache(8)(true_reward_of)

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
        numbers = trainer.store.runs.numbers()
        if run not in numbers:
            return None
        here = run == trainer.run
        level = self._level(trainer.demo) if here else None
        return {
            "run": run,
            "colour": numbers[run],
            "live": here,
            "levels": {} if level is None else {"true_reward": level},
            **curves(trainer.store, run, after),
        }
