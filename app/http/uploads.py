"""A video that a researcher sends over HTTP becomes a demo, in steps.

``POST /demos`` streams it to a file under a name of our own; nothing is decoded but one frame. Then any
number of times a part of it is chosen, brought in (``result``) and looked at, exactly as ``onedemo demo add``
does it, but not yet in the library; at last it is kept, or discarded. All decoding is done by a limited child
(``onedemo.demos.sandboxed_decoder``).

What is not kept lies in ``uploads/`` of the data directory, which no backup saves, and is gone after an hour,
or once this process has ended.
"""

from __future__ import annotations

import asyncio
import math
import re
import secrets
import shutil
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from aiohttp import BodyPartReader, web

from onedemo.app.network.refusals import read_json
from onedemo.core.directories import Workshop, clear_left_over, make_directory
from onedemo.core.files import private_opener
from onedemo.demos.containers import check_file
from onedemo.demos.edits import Options, check_options, read_loop, read_rotation, read_speed
from onedemo.demos.library import demo_picture, keep_demo, known_demo
from onedemo.demos.preparing import VIDEO, prepare_demo
from onedemo.demos.sandboxed_decoder import Look, look
from onedemo.demos.video import jpeg
from onedemo.errors import UserError

LARGEST = 500 << 20
"""Bytes of a video."""
LONGEST_SECONDS = 600.0
"""Until a video has arrived."""
MOST_AT_ONCE = 2
"""Videos that arrive or are decoded at one time."""
MOST_WAITING = 4
"""Videos that are neither kept nor discarded; the oldest goes when another comes."""
WAIT_SECONDS = 3600.0
"""That such a video stays after it was last asked for."""
_CHOSEN = {"start", "end", "rotate", "stabilise", "crop", "track", "mirror", "speed", "reverse", "loop"}
_FACTS = ("seconds", "frames", "fps", "width", "height", "edits")
_CALLED = {
    "track": "“Follow what moves”", "stabilise": "“Hold the background still”", "speed": "“Speed”",
    "loop": "“Repeat”", "rotate": "“Turn”",
}  # fmt: skip
"""Options of the command line, on the page."""

_T = TypeVar("_T")


@dataclass(slots=True)
class _Upload:
    place: Workshop
    look: Look
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    end: asyncio.TimerHandle | None = None
    tried: int = 0
    """Results so far: each has an address of its own, so that no browser shows an earlier one."""
    shown: int = 0
    """The newest that could be made; 0: none so far."""
    stills: list[bytes] = field(default_factory=list)
    """Its first and its last frame, JPEG."""

    @property
    def video(self) -> Path:
        return self.place.path / "video"

    def result(self, number: int) -> Path:
        return self.place.path / f"result-{number}"


class Uploads:
    """Takes in videos.

    Args:
        data_dir: Where the demos are; what an earlier process left of its uploads is removed.
        largest: Bytes of a video.
        longest: Seconds until it has arrived.
        wait: Seconds that one which is neither kept nor discarded stays.
    """

    def __init__(
        self, data_dir: Path, *, largest: int = LARGEST, longest: float = LONGEST_SECONDS,
        wait: float = WAIT_SECONDS,
    ) -> None:  # fmt: skip
        self._demos_dir, self._place = data_dir / "demos", data_dir / "uploads"
        self._largest, self._longest, self._wait = largest, longest, wait
        self._busy = 0
        self._waiting: dict[str, _Upload] = {}
        self._pictures: dict[str, bytes] = {}
        clear_left_over(self._place, "upload-")  # not of another server, which may be at it
        clear_left_over(self._demos_dir, ".import-")

    def close(self) -> None:
        """Discards what waits."""
        for name in list(self._waiting):
            self._end(name)

    async def add(self, request: web.Request) -> web.Response:
        """Takes a form whose one field is ``video``; answers what it is: JSON.

        ``upload`` names it from now on; ``width`` and ``height`` are pixels of the upright video; ``seconds``
        and ``fps`` are by the container's word, 0 where it does not say.
        """
        with self._at_work(), _sentences("video"):
            make_directory(self._place, private=True)
            place = Workshop(self._place, "upload-")
            try:
                path = place.path / "video"
                try:
                    with open(path, "xb", opener=private_opener) as file:
                        async with asyncio.timeout(self._longest):
                            await self._receive(request, file)
                except TimeoutError:
                    raise web.HTTPRequestTimeout(
                        text=f"The video did not arrive within {self._longest:g} s; send a shorter one."
                    ) from None
                with _named(path):
                    await asyncio.to_thread(check_file, path)
                    found = await asyncio.to_thread(look, path)
            except BaseException:
                place.__exit__()
                raise
        name, upload = secrets.token_hex(16), _Upload(place, found)
        for oldest in [each for each, other in self._waiting.items() if not other.lock.locked()]:
            if len(self._waiting) < MOST_WAITING:
                break
            self._end(oldest)
        self._waiting[name] = upload
        self._wait_on(name)
        told = {"width": found.width, "height": found.height, "seconds": found.seconds, "fps": found.fps}
        return web.json_response({"upload": name, **told})

    async def poster(self, request: web.Request) -> web.Response:
        """One frame, JPEG, at most 640 px long: query ``at``, in seconds. For what a browser cannot play."""
        async with self._upload(request) as upload:
            with _sentences("video"), _named(upload.video):
                at = _seconds(request.query.get("at") or 0.0, "at")
                found = upload.look
                if at:
                    with self._at_work():
                        found = await asyncio.to_thread(partial(look, upload.video, at=at))
                return _picture(await asyncio.to_thread(jpeg, found.picture))

    async def bring_in(self, request: web.Request) -> web.Response:
        """Makes what the demo would be; answers with its facts: JSON.

        Takes what ``onedemo.demos.edits.Options`` says, as far as a person chooses it; each may be left out,
        or null: ``{"start": s, "end": s, "rotate": degrees, "stabilise": bool, "crop": [x, y, width, height],
        "track": bool, "mirror": bool, "speed": times, "reverse": bool, "loop": times or true}``. What was
        shown before stays, and can be kept, if this cannot be done.
        """
        async with self._upload(request) as upload:
            with self._at_work(), _sentences("video"), _named(upload.video):
                options = _options(await read_json(request))
                upload.tried += 1
                place = upload.result(upload.tried)
                make_directory(place, private=True)
                warnings: list[str] = []
                ends: list[np.ndarray] = []

                def stored(frame: np.ndarray) -> None:
                    ends[1:] = [frame]

                work = partial(
                    prepare_demo, upload.video, options, place, source="uploaded", warn=warnings.append,
                    stored=stored,
                )  # fmt: skip
                try:
                    demo = await asyncio.to_thread(work)
                except BaseException:
                    shutil.rmtree(place, ignore_errors=True)
                    raise
                shutil.rmtree(upload.result(upload.shown), ignore_errors=True)
                upload.shown, upload.stills = upload.tried, [jpeg(frame) for frame in ends]
                known = await asyncio.to_thread(known_demo, demo.sha256, self._demos_dir)
        facts = {name: getattr(demo, name) for name in _FACTS}
        said = [_sentence(warning) for warning in warnings]
        about = {"result": upload.shown, "known": known.name if known else None, "warnings": said}
        return web.json_response(facts | about)

    @asynccontextmanager
    async def result_of(self, request: web.Request) -> AsyncIterator[Path]:
        """Where what the demo would be lies, for one request at a time that works on it."""
        async with self._upload(request) as upload:
            with self._at_work(), _sentences("mask"), _named(upload.result / "video.webm"):
                if not (upload.result / "demo.json").is_file():
                    raise ValueError("choose a part and look at the result first")
                yield upload.result

    async def result(self, request: web.Request) -> web.StreamResponse:
        """What the demo would be, as video."""
        async with self._upload(request) as upload:
            path = upload.result(upload.shown) / VIDEO
            if request.match_info["result"] != str(upload.shown) or not path.is_file():
                raise web.HTTPNotFound()
            return web.FileResponse(path, headers={"Content-Type": "video/webm"})

    async def still(self, request: web.Request) -> web.Response:
        """The first or the last frame of what the demo would be, JPEG."""
        async with self._upload(request) as upload:
            if request.match_info["result"] != str(upload.shown) or not upload.stills:
                raise web.HTTPNotFound()
            return _picture(upload.stills[0 if request.match_info["end"] == "first" else -1])

    async def keep(self, request: web.Request) -> web.Response:
        """Makes it a demo, called as the query's ``name`` says; answers its name, which it may have had."""
        async with self._upload(request) as upload:
            with _sentences("name"):
                if not upload.shown:
                    raise ValueError("choose a part and look at the result first")
                name = request.query.get("name", "").strip()
                work = partial(keep_demo, upload.result(upload.shown), name, self._demos_dir)
                demo = await asyncio.to_thread(work)
        self._end(request.match_info["upload"])
        return web.json_response({"name": demo.name, "known": demo.name != name})

    async def discard(self, request: web.Request) -> web.Response:
        """Deletes what was sent."""
        async with self._upload(request):
            pass
        self._end(request.match_info["upload"])
        return web.Response(status=204)

    async def picture(self, request: web.Request) -> web.Response:
        """A frame of a demo of the library, JPEG."""
        sha256 = request.match_info["demo"]
        if sha256 not in self._pictures:
            demo = await asyncio.to_thread(known_demo, sha256, self._demos_dir)
            try:
                picture = await asyncio.to_thread(demo_picture, demo) if demo else None
            except UserError:  # its video is gone or damaged
                picture = None
            if picture is None:
                raise web.HTTPNotFound()
            self._pictures[sha256] = picture
        return _picture(self._pictures[sha256], {"Cache-Control": "private, max-age=31536000, immutable"})

    # What waits

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        if self._busy >= MOST_AT_ONCE:
            raise web.HTTPServiceUnavailable(text="Other videos are being uploaded; try again in a minute.")
        self._busy += 1
        try:
            yield
        finally:
            self._busy -= 1

    @asynccontextmanager
    async def _upload(self, request: web.Request) -> AsyncIterator[_Upload]:
        """What an address names, for one request at a time."""
        name = request.match_info["upload"]
        gone = web.HTTPNotFound(text="This video is not here any more. Please choose it again.")
        if (upload := self._waiting.get(name)) is None:
            raise gone
        self._wait_on(name)
        async with upload.lock:
            if name not in self._waiting:
                raise gone
            yield upload

    def _wait_on(self, name: str) -> None:
        upload = self._waiting[name]
        if upload.end is not None:
            upload.end.cancel()
        upload.end = asyncio.get_running_loop().call_later(self._wait, self._end, name)

    def _end(self, name: str) -> None:
        if (upload := self._waiting.get(name)) is None:
            return
        if upload.end is not None:
            upload.end.cancel()
        if upload.lock.locked():  # it is being brought in
            self._wait_on(name)
            return
        del self._waiting[name]
        upload.place.__exit__()

    async def _receive(self, request: web.Request, file: Any) -> None:
        """Writes the video to the file. What it is called, or its type, is not looked at."""
        if not request.content_type.startswith("multipart/form-data"):
            raise ValueError("an upload is a form with a video")
        part = await (await request.multipart()).next()
        if not isinstance(part, BodyPartReader) or part.name != "video":
            raise ValueError("an upload has one field, video")
        size = 0
        while chunk := await part.read_chunk(1 << 16):
            size += len(chunk)
            if size > self._largest:
                raise ValueError(f"the video is larger than {self._largest / 2**20:g} MB; scale it down")
            await asyncio.to_thread(file.write, chunk)


@contextmanager
def _sentences(what: str) -> Iterator[None]:
    """What was wrong as one sentence to whoever asked."""
    try:
        yield
    except (UserError, ValueError) as error:
        raise web.HTTPBadRequest(text=_sentence(str(error))) from None
    except OSError as error:
        raise web.HTTPInsufficientStorage(
            text=f"The {what} could not be stored ({error.strerror or error})."
        ) from None


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Sentences about a file of ours are about the video."""
    try:
        yield
    except UserError as error:
        raise UserError(str(error).replace(str(path), "the video")) from None


def _sentence(said: str) -> str:
    """What is said of an option of the command line, about what is called otherwise on the page."""
    said = re.sub(r"--([a-z]+)", lambda option: _CALLED.get(option[1], option[1]), said)
    return f"{said[:1].upper()}{said[1:]}."


def _picture(data: bytes, headers: dict[str, str] | None = None) -> web.Response:
    return web.Response(body=data, content_type="image/jpeg", headers=headers)


def _seconds(value: Any, name: str) -> float:
    try:
        seconds = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not 0 <= seconds < 1e6:
        raise ValueError(f"{name} is a number of seconds")
    return seconds


def _options(body: Any) -> Options:
    if not isinstance(body, dict) or not set(body) <= _CHOSEN:
        raise ValueError(f"a part of a video has {', '.join(sorted(_CHOSEN))}")
    start, end = (None if body.get(name) is None else _seconds(body[name], name) for name in ("start", "end"))
    given, crop = body.get("crop"), None
    if given is not None:
        if not (isinstance(given, list) and len(given) == 4 and all(type(side) is int for side in given)):
            raise ValueError("the part of the picture is four whole numbers: x, y, width, height")
        x, y, width, height = (max(-1, min(side, 1 << 20)) for side in given)
        crop = (x, y, width, height)
    numbers = {
        name: read(body[name])
        for name, read in (("speed", read_speed), ("loop", read_loop), ("rotate", read_rotation))
        if body.get(name) is not None
    }
    switches = {name: body.get(name) is True for name in ("mirror", "reverse", "track", "stabilise")}
    options = Options(start=start, end=end, crop=crop, **numbers, **switches)
    check_options(options)
    return options
