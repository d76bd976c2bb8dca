"""What researchers take away over HTTP: ratings, segments, the data card; and a look at them before."""

from __future__ import annotations

import asyncio
import re
import tempfile
import zipfile
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from aiohttp import web

from onedemo.app.dataset import csv_writer
from onedemo.app.dataset.card import card
from onedemo.app.dataset.columns import RATINGS
from onedemo.app.dataset.exporter import FILES, csv_of, write_export, write_file
from onedemo.app.templates import render
from onedemo.errors import in_words
from onedemo.storage.store import Store

FILTERS = ("run", "rater", "stage", "value", "choice", "repeat", "left_out")
"""Columns of the ratings by which they can be filtered."""
_NUMBERS = ("value", "repeat", "left_out")
_NUMBER = re.compile(r"[0-9]{0,9}")
_SHOWN = 50
"""Ratings in a preview."""


class Downloads:
    """Handlers, for researchers alone.

    Args:
        store: Where the data is.
        headers: Sent with everything.
    """

    def __init__(self, store: Store, headers: dict[str, str]) -> None:
        self._store, self._headers = store, headers | {"Cache-Control": "no-store"}

    async def csv(self, request: web.Request) -> web.StreamResponse:
        """The ratings."""
        rows = self._store.ratings.stream(**self._filters(request))
        return await self._stream(request, "ratings", csv_writer.csv_blocks(rows))

    async def comparisons(self, request: web.Request) -> web.StreamResponse:
        """The answers about pairs."""
        return await self._stream(request, "comparisons", self._blocks(request, "comparisons.csv"))

    async def skips(self, request: web.Request) -> web.StreamResponse:
        """Skipped clips, and why."""
        return await self._stream(request, "skips", self._blocks(request, "skips.csv"))

    def _blocks(self, request: web.Request, name: str) -> Generator[bytes, None, None]:
        return csv_of(self._store, read_filters(request.query).get("run"), name)

    async def _stream(
        self, request: web.Request, what: str, blocks: Generator[bytes, None, None]
    ) -> web.StreamResponse:
        response = self._attachment(what, "csv", "text/csv")
        await response.prepare(request)
        loop = asyncio.get_running_loop()
        # One thread for the whole export: a SQLite connection belongs to the thread that opened it.
        with ThreadPoolExecutor(max_workers=1) as reader:
            try:
                while block := await loop.run_in_executor(reader, next, blocks, None):
                    await response.write(block)
            finally:
                await loop.run_in_executor(reader, blocks.close)
        await response.write_eof()
        return response

    async def parquet(self, request: web.Request) -> web.StreamResponse:
        """The segments behind the clips."""
        write = partial(write_file, self._store, read_filters(request.query).get("run"), "segments.parquet")
        return await self._file(request, "segments", "parquet", "application/vnd.apache.parquet", write)

    async def everything(self, request: web.Request) -> web.StreamResponse:
        """All that people gave, for ``onedemo import``."""
        run = read_filters(request.query).get("run")

        def write(file: Path) -> None:
            write_export(self._store, run, file.parent)
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
                for name in FILES:
                    archive.write(file.parent / name, f"{file.stem}/{name}")

        return await self._file(request, "everything", "zip", "application/zip", write)

    async def _file(
        self, request: web.Request, what: str, suffix: str, kind: str, write: Callable[[Path], None]
    ) -> web.StreamResponse:
        response = self._attachment(what, suffix, kind)
        with tempfile.TemporaryDirectory() as directory:
            file = Path(directory) / csv_writer.file_name(what, suffix)
            try:
                await asyncio.to_thread(write, file)
            except OSError as error:
                raise web.HTTPInsufficientStorage(
                    text=f"The file could not be made. {in_words(error)}"
                ) from None
            await response.prepare(request)
            with file.open("rb") as source:
                while block := await asyncio.to_thread(source.read, 1 << 18):
                    await response.write(block)
            await response.write_eof()
        return response

    async def card(self, request: web.Request) -> web.StreamResponse:
        """The data card."""
        text = await asyncio.to_thread(card, self._store, read_filters(request.query).get("run"))
        response = self._attachment("card", "md", "text/markdown")
        await response.prepare(request)
        await response.write(text.encode())
        await response.write_eof()
        return response

    async def preview(self, request: web.Request) -> web.StreamResponse:
        """A look at the ratings."""
        filters = self._filters(request)
        html = await asyncio.to_thread(self._table, filters)
        return web.Response(text=html, content_type="text/html")

    async def given(self, request: web.Request) -> web.StreamResponse:
        """Ratings of a run one by one, newest first, to be looked at: JSON.

        Query: ``run``; ``rater``, by name; ``before``, a rating's number.
        """
        run, rater, before = (request.query.get(name, "") for name in ("run", "rater", "before"))
        if max(len(run), len(rater), 10 * len(before)) > 200 or (before and not before.isdecimal()):
            raise web.HTTPBadRequest(text="Ratings are listed by run, rater and number.")
        ratings, number = self._store.ratings, min(int(before), 2**53) if before else None
        most = _SHOWN + 1
        (rater,) = self._spelled([rater]) if rater else [None]
        found = await asyncio.to_thread(ratings.given, run, rater=rater, before=number, most=most)
        raters = sorted({name for name, _ in await asyncio.to_thread(ratings.tallies, run)})
        rows = [rating._asdict() for rating in found[:_SHOWN]]
        return web.json_response({"ratings": rows, "more": len(found) > _SHOWN, "raters": raters})

    def _filters(self, request: web.Request) -> dict[str, Any]:
        filters = read_filters(request.query)
        if "rater" in filters:
            filters["rater"] = self._spelled(filters["rater"])
        return filters

    def _spelled(self, names: list[str]) -> list[str]:
        """These names as their raters write them; what is nobody's name stays as it is."""
        known = {rater.name for rater in self._store.accounts.raters()}
        alike = {name.casefold(): name for name in known}
        return [name if name in known else alike.get(name.casefold(), name) for name in names]

    def _table(self, filters: dict[str, Any]) -> str:
        rows = self._store.ratings.stream(**filters)
        shown = list(islice(rows, _SHOWN))
        more = sum(1 for _ in rows)
        return render("data.html:preview", rows=shown, count=len(shown) + more, columns=RATINGS)

    def _attachment(self, what: str, suffix: str, kind: str) -> web.StreamResponse:
        response = web.StreamResponse(headers=dict(self._headers))
        response.content_type = kind
        if kind.startswith("text/"):
            response.charset = "utf-8"
        name = csv_writer.file_name(what, suffix)
        response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
        return response


def read_filters(query) -> dict[str, Any]:
    """The filters in a query; empty ones are none. Of raters there may be several, as a list.

    Raises:
        web.HTTPBadRequest: If one is unknown, or no number where one is wanted.
    """
    filters: dict[str, Any] = {}
    for name, value in query.items():
        if name not in FILTERS or len(value) > 200 or (name in _NUMBERS and not _NUMBER.fullmatch(value)):
            raise web.HTTPBadRequest(text=f"Ratings cannot be filtered by {name[:40]!r} {value[:40]!r}.")
        if value and name == "rater":
            filters.setdefault(name, []).append(value)
        elif value:
            filters[name] = int(value) if name in _NUMBERS else value
    return filters
