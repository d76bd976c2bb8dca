"""Pictures and static files over HTTP: of the run that is served, and of our page, nothing else."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, TypeVar

from aiohttp import web

from onedemo.app.http import assets
from onedemo.app.services.demo_images import Pictures
from onedemo.errors import UserError
from onedemo.storage.store import Store
from onedemo.types import Clip

_KEEP = {"Cache-Control": "private, max-age=31536000, immutable"}
"""Addresses of what differs between runs or demos end in ?v= and what they are of."""

_TRIES = 3
"""Of a picture that is deleted whenever it has been drawn."""
_KINDS = {".jpg": "image/jpeg", ".webm": "video/webm"}

T = TypeVar("T")


class Filmed(Protocol):
    """What is needed of a trainer."""

    store: Store
    run: str

    def clip_picture(self, clip: Clip) -> Future[Path]:
        """The future of the picture of a clip, which may have to be drawn."""
        ...

    def pair_picture(self, pair_id: int) -> Future[Path]:
        """The same of a pair."""
        ...

    def rollout_picture(self, iteration: int, suffix: str) -> Future[Path]:
        """The same of the best rollout of an iteration; FileNotFoundError if there is none."""
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
        self._preparing = ThreadPoolExecutor(1, "demo-pictures")

    async def static(self, request: web.Request) -> web.StreamResponse:
        """A file of ours."""
        return self._served(assets.STATIC, request)

    async def vendored(self, request: web.Request) -> web.StreamResponse:
        """A file of a package of others that the page uses, named in ``static/vendor``."""
        names = {folder.name: folder for folder in (assets.STATIC / "vendor").iterdir()}
        folder = names.get(request.match_info["package"])
        if folder is None:
            raise web.HTTPNotFound()
        return self._served(folder, request)

    async def viser(self, request: web.Request) -> web.StreamResponse:
        """A file of Viser's client."""
        file = assets.viser_files().get(request.match_info["name"])
        if file is None:
            raise web.HTTPNotFound()
        headers = _KEEP | {"Content-Type": file.kind, "Content-Encoding": "gzip"}
        return web.Response(body=file.body, headers=headers)

    def _served(self, folder: Path, request: web.Request) -> web.StreamResponse:
        path = folder / request.match_info["name"]
        if path.parent != folder or path.suffix not in assets.SERVED or not path.is_file():
            raise web.HTTPNotFound()
        return web.FileResponse(path, headers={"Cache-Control": "no-cache"})

    async def login_static(self, request: web.Request) -> web.StreamResponse:
        """A file of ours that the login page needs."""
        path = assets.STATIC / PurePosixPath(request.path).name
        return web.FileResponse(path, headers={"Cache-Control": "no-cache"})

    async def clip(self, request: web.Request) -> web.StreamResponse:
        """The picture of a clip."""
        number = int(request.match_info["clip"])
        trainer = self._page.trainer
        clip = await asyncio.to_thread(trainer.store.clips.get, number)
        if clip is None or clip.run != trainer.run:
            raise web.HTTPNotFound()
        return await _file(request, trainer.clip_picture, clip)

    async def pair(self, request: web.Request) -> web.StreamResponse:
        """The picture of a pair."""
        number = int(request.match_info["pair"])
        trainer = self._page.trainer
        if await asyncio.to_thread(trainer.store.comparisons.pair_run, number) != trainer.run:
            raise web.HTTPNotFound()
        return await _file(request, trainer.pair_picture, number)

    async def rollout(self, request: web.Request) -> web.StreamResponse:
        """The best rollout of an iteration: a picture, or the film."""
        iteration, suffix = int(request.match_info["iteration"]), request.match_info["suffix"]
        return await _file(request, self._page.trainer.rollout_picture, iteration, suffix)

    async def demo_frame(self, request: web.Request) -> web.StreamResponse:
        """A frame of the demo."""
        frames = await self._of_demo(Pictures.frames)
        index = int(request.match_info["index"])
        if index >= len(frames):
            raise web.HTTPNotFound()
        return web.Response(body=frames[index], content_type="image/jpeg", headers=_KEEP)

    async def demo_video(self, request: web.Request) -> web.StreamResponse:
        """The whole demo, as it is stored."""
        path = self._page.pictures.demo.path
        if not path.is_file():
            raise web.HTTPNotFound(text="The demonstration's video is gone.")
        return web.FileResponse(path, headers=_KEEP | {"Content-Type": "video/webm"})

    async def demo_example(self, request: web.Request) -> web.StreamResponse:
        """A clip of the guide."""
        examples = await self._of_demo(Pictures.examples)
        example = examples.get(request.match_info["name"])
        if example is None:
            raise web.HTTPNotFound()
        return web.Response(body=example, content_type="image/jpeg", headers=_KEEP)

    async def _of_demo(self, what: Callable[[Pictures], T]) -> T:
        """Made on first use, which takes seconds, by one thread however many pages ask."""
        preparing = asyncio.get_running_loop().run_in_executor(self._preparing, what, self._page.pictures)
        try:
            return await preparing
        except UserError:  # its video is gone; the page says so, and the log has
            raise web.HTTPNotFound(text="The demonstration's video is gone.") from None


async def _file(request: web.Request, ask: Callable[..., Future[Path]], *what: Any) -> web.Response:
    """A picture once it is there. Whoever waits for it holds no thread: others need those to rate."""
    for _ in range(_TRIES):
        try:
            coming = await asyncio.to_thread(ask, *what)
            path = await asyncio.shield(asyncio.wrap_future(coming))  # others may wait for the same
        except (FileNotFoundError, KeyError):
            raise web.HTTPNotFound() from None
        except UserError as error:  # nothing can be drawn here
            raise web.HTTPServiceUnavailable(text=str(error)) from None
        with suppress(FileNotFoundError):  # deleted in between, by ``onedemo tidy``: it is drawn again
            return _picture(request, path, await asyncio.to_thread(path.read_bytes))
    raise web.HTTPServiceUnavailable(text="This picture is deleted as soon as it is drawn.")


def _picture(request: web.Request, path: Path, data: bytes) -> web.Response:
    """All of it, or the part that is asked for: browsers fetch films so."""
    headers = _KEEP | {"Content-Type": _KINDS[path.suffix], "Accept-Ranges": "bytes"}
    if "Range" not in request.headers:
        return web.Response(body=data, headers=headers)
    try:
        first, end, _ = request.http_range.indices(len(data))
    except ValueError:
        first, end = 0, 0
    if first >= end:
        headers = {"Content-Range": f"bytes */{len(data)}"}
        raise web.HTTPRequestRangeNotSatisfiable(headers=headers)
    headers["Content-Range"] = f"bytes {first}-{end - 1}/{len(data)}"
    return web.Response(status=206, body=data[first:end], headers=headers)
