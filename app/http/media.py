"""Pictures and static files over HTTP: of the run that is served, and of our page, nothing else."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

from aiohttp import web

from onedemo.app.http import assets
from onedemo.app.services.demo_images import Pictures
from onedemo.errors import UserError
from onedemo.storage.store import Store

_T = TypeVar("_T")
_KEEP = {"Cache-Control": "private, max-age=31536000, immutable"}
"""Addresses of what differs between runs or demos end in ?v= and what they are of."""


class Filmed(Protocol):
    """What is needed of a trainer."""

    store: Store
    run: str

    def clip_file(self, clip_id: int) -> Path:
        """The picture of a clip."""
        ...

    def pair_file(self, pair_id: int) -> Path:
        """The picture of a pair."""
        ...

    def rollout_file(self, iteration: int, suffix: str) -> Path:
        """The best rollout of an iteration."""
        ...


class Shown(Protocol):
    """What is needed of a page."""

    @property
    def trainer(self) -> Filmed:
        """The run that is served."""
        ...

    @property
    def pictures(self) -> Pictures:
        """Of its demo."""
        ...


class Files:
    """Handlers; who may use which, the front says.

    Args:
        page: Whose run and demo.
    """

    def __init__(self, page: Shown) -> None:
        self._page = page

    async def static(self, request: web.Request) -> web.StreamResponse:
        """A file of ours."""
        path = assets.STATIC / request.match_info["name"]
        if path.parent != assets.STATIC or path.suffix not in assets.SERVED or not path.is_file():
            raise web.HTTPNotFound()
        return web.FileResponse(path, headers={"Cache-Control": "no-cache"})

    async def login_static(self, request: web.Request) -> web.StreamResponse:
        """A file of ours that the login page needs."""
        path = assets.STATIC / request.path.removeprefix("/static/")
        return web.FileResponse(path, headers={"Cache-Control": "no-cache"})

    async def clip(self, request: web.Request) -> web.StreamResponse:
        """The picture of a clip."""
        number = int(request.match_info["clip"])
        trainer = self._page.trainer
        clip = await asyncio.to_thread(trainer.store.clips.get, number)
        if clip is None or clip.run != trainer.run:
            raise web.HTTPNotFound()
        return _jpeg(trainer.clip_file(number))

    async def pair(self, request: web.Request) -> web.StreamResponse:
        """The picture of a pair."""
        number = int(request.match_info["pair"])
        trainer = self._page.trainer
        if await asyncio.to_thread(trainer.store.comparisons.pair_run, number) != trainer.run:
            raise web.HTTPNotFound()
        return _jpeg(trainer.pair_file(number))

    async def rollout(self, request: web.Request) -> web.StreamResponse:
        """The best rollout of an iteration: a picture, or the film."""
        iteration, suffix = int(request.match_info["iteration"]), request.match_info["suffix"]
        try:
            path = await asyncio.to_thread(self._page.trainer.rollout_file, iteration, suffix)
        except FileNotFoundError:
            raise web.HTTPNotFound() from None
        except UserError as error:  # nothing can be drawn here
            raise web.HTTPServiceUnavailable(text=str(error)) from None
        kind = {"jpg": "image/jpeg", "webm": "video/webm"}[suffix]
        return web.FileResponse(path, headers=_KEEP | {"Content-Type": kind})

    async def demo_frame(self, request: web.Request) -> web.StreamResponse:
        """A frame of the demo."""
        frames = await _of_demo(self._page.pictures.frames)
        index = int(request.match_info["index"])
        if index >= len(frames):
            raise web.HTTPNotFound()
        return web.Response(body=frames[index], content_type="image/jpeg", headers=_KEEP)

    async def demo_example(self, request: web.Request) -> web.StreamResponse:
        """A clip of the guide."""
        examples = await _of_demo(self._page.pictures.examples)
        example = examples.get(request.match_info["name"])
        if example is None:
            raise web.HTTPNotFound()
        return web.Response(body=example, content_type="image/jpeg", headers=_KEEP)


async def _of_demo(pictures: Callable[[], _T]) -> _T:
    try:
        return await asyncio.to_thread(pictures)
    except UserError:  # its video is gone; the page says so, and the log has
        raise web.HTTPNotFound(text="The demonstration's video is gone.") from None


def _jpeg(path: Path) -> web.FileResponse:
    if not path.is_file():
        raise web.HTTPNotFound()
    return web.FileResponse(path, headers=_KEEP | {"Content-Type": "image/jpeg"})
