"""A video that a researcher sends over HTTP becomes a demo.

It is streamed to a file under a name of our own, decoded by a limited child
(``onedemo.demos.sandboxed_decoder``) and
added exactly as ``onedemo demo add`` does. Whatever happens, the file is gone afterwards.
"""

from __future__ import annotations

import asyncio
import math
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import BodyPartReader, web

from onedemo.core.directories import Workshop, clear_left_over, make_directory
from onedemo.core.files import private_opener
from onedemo.demos.import_checks import read_crop
from onedemo.demos.library import import_video
from onedemo.errors import UserError

LARGEST = 500 << 20
"""Bytes of a video."""
LONGEST_SECONDS = 600.0
"""Until a video has arrived."""
MOST_AT_ONCE = 2
"""Uploads, with their decoding."""
_LONGEST_FIELD = 200
_FIELDS = ("name", "start", "end", "crop", "mirror")


class Uploads:
    """Takes in videos.

    Args:
        data_dir: Where the demos are; what an earlier process left of its uploads is removed.
        largest: Bytes of a video.
        longest: Seconds until it has arrived.
    """

    def __init__(self, data_dir: Path, *, largest: int = LARGEST, longest: float = LONGEST_SECONDS) -> None:
        self._demos_dir, self._place = data_dir / "demos", data_dir / "uploads"
        self._largest, self._longest = largest, longest
        self._open = 0
        clear_left_over(self._place, "upload-")  # not of another server, which may be at it
        clear_left_over(self._demos_dir, ".import-")

    async def add(self, request: web.Request) -> web.Response:
        """Answers a form with ``name``, if wanted ``start``, ``end``, ``crop``, ``mirror``, last ``video``.

        The answer is one sentence: what the demo is now, or what was wrong; ``X-Demo`` is the demo's name.
        """
        if self._open >= MOST_AT_ONCE:
            raise web.HTTPServiceUnavailable(text="Other videos are being uploaded; try again in a minute.")
        self._open += 1
        path = None
        try:
            make_directory(self._place, private=True)
            with Workshop(self._place, "upload-") as place:
                path = place / "video"
                with open(path, "xb", opener=private_opener) as file:
                    async with asyncio.timeout(self._longest):
                        fields = await self._receive(request, file)
                options = {"demos_dir": self._demos_dir, "source": "uploaded"} | _options(fields)
                demo = await asyncio.to_thread(partial(import_video, path, **options))
        except TimeoutError:
            raise web.HTTPRequestTimeout(
                text=f"The video did not arrive within {self._longest:g} s; send a shorter one."
            ) from None
        except (UserError, ValueError) as error:
            said = str(error).replace(str(path), "the video").replace("--", "")
            raise web.HTTPBadRequest(text=f"{said[:1].upper()}{said[1:]}.") from None
        except OSError as error:
            raise web.HTTPInsufficientStorage(
                text=f"The video could not be stored ({error.strerror or error})."
            ) from None
        finally:
            self._open -= 1
        known = demo.name != fields["name"]
        said = f"This video is known already, as {demo.name}" if known else f"{demo.name} is a demo now"
        return web.Response(
            text=f"{said}: {demo.seconds:.1f} s, {demo.frames} frames.", headers={"X-Demo": demo.name}
        )

    async def _receive(self, request: web.Request, file: Any) -> dict[str, str]:
        """Writes the video to the file; returns the other fields. The file's own name is not looked at."""
        if not request.content_type.startswith("multipart/form-data"):
            raise ValueError("an upload is a form with a name and a video")
        fields: dict[str, str] = {}
        parts = await request.multipart()
        while (part := await parts.next()) is not None:
            if not isinstance(part, BodyPartReader):
                break
            if part.name == "video":
                size = 0
                while chunk := await part.read_chunk(1 << 16):
                    size += len(chunk)
                    if size > self._largest:
                        raise ValueError(
                            f"the video is larger than {self._largest / 2**20:g} MB; scale it down"
                        )
                    await asyncio.to_thread(file.write, chunk)
                return fields
            if part.name not in _FIELDS or part.name in fields:
                break
            text = await part.read_chunk(_LONGEST_FIELD + 1)
            if len(text) > _LONGEST_FIELD or await part.read_chunk(1):
                raise ValueError(f"{part.name} is up to {_LONGEST_FIELD} characters")
            fields[part.name] = text.decode("utf-8", "replace").strip()
        raise ValueError(f"an upload has the fields {', '.join(_FIELDS)} and, as the last, video")


def _options(fields: dict[str, str]) -> dict[str, Any]:
    times = {}
    for name in ("start", "end"):
        try:
            times[name] = float(fields[name]) if fields.get(name) else None
        except ValueError:
            times[name] = math.nan
        if times[name] is not None and not math.isfinite(times[name]):
            raise ValueError(f"{name} is a number of seconds")
    try:
        crop = read_crop(fields["crop"]) if fields.get("crop") else None
    except ValueError as error:
        raise ValueError(f"the part of the video {error}") from None
    return {"name": fields.get("name", ""), "crop": crop, "mirror": fields.get("mirror") == "on", **times}
