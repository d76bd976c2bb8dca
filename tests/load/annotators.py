"""People at the page, played by one light process: what a browser sends and receives, without drawing.

An annotator opens its link, reads the page's messages, learns from them which clip is on screen and
which command is which key, fetches the pictures a browser would, and answers. The clock of a
press stops when the next clip's message and its picture are both there, as ``page.js`` lets nobody
rate a picture that has not come.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from urllib.parse import urljoin, urlsplit
from uuid import uuid4

import aiohttp
import msgspec
import zstandard

_PAGE = re.compile(r'data-page="([^"]+)"')
_CLIP = re.compile(r'data-clip="(\d+)"')
_AHEAD = re.compile(r'data-ahead="clips/(\d+)\.jpg\b')
_WAITING = 'class="od-waiting"'
_SIZES = 16
"""Bytes before the compressed part of a message: its size when unpacked, and as it is."""
_PATIENCE_S = 20.0
_NO_CLIP_S = 300.0
"""Practice may take so long on a busy machine, and new clips are cut after it."""
_JUDGING_S = 0.35
"""Nobody judges a clip sooner, and the page takes no rating that comes within 0.3 s."""
_CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, -3.0, 1.0],
    "fov": 0.8, "near": 0.01, "far": 100.0, "image_height": 480, "image_width": 640,
    "look_at": [0.0, 0.0, 1.0], "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Press:
    """One rating as the person saw it."""

    clip: int
    value: int
    at: float
    """When the key went down, ``time.time()``."""
    seconds: float
    """Until the next clip was on screen with its picture, or the note that there is none."""


@dataclass
class Tab:
    """One open page. Made by ``open_tab``; ``close`` it."""

    base: str
    """Address of the front, ``http://127.0.0.1:PORT``."""
    address: str
    """Of the page."""
    session: aiohttp.ClientSession
    socket: aiohttp.ClientWebSocketResponse
    headers: dict[str, str]
    """The cookie."""
    clip: int | None = None
    """The clip on screen, None while there is none."""
    waiting: bool = False
    """Whether the page says that there is nothing to rate."""
    keys: dict[str, str] = field(default_factory=dict)
    """Command by its key, such as "alt+P"."""
    token: str = ""
    """What the page is called in requests."""
    presses: list[Press] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._pictures: dict[int, asyncio.Task[None]] = {}
        self._coming: int | None = None
        self._shown_at = 0.0
        self._changed = asyncio.Event()
        self._unpack = zstandard.ZstdDecompressor()
        self._reader = asyncio.create_task(self._read())

    async def rate(self, value: int) -> Press:
        """Gives the rating, a moment after the clip came at the earliest, and waits for what comes next.

        That is the next clip, or the note that there is none just now.

        Raises:
            RuntimeError: If there is no clip to rate, the rating does not count, or nothing comes.
        """
        await asyncio.sleep(self._shown_at + _JUDGING_S - time.monotonic())
        before = self.clip
        if before is None:
            raise RuntimeError("there is no clip on screen to rate")
        at, began = time.time(), time.perf_counter()
        answer = await self.post(press="rate", clip=before, value=value)
        if answer != (200, '{"counted": true}'):
            raise RuntimeError(f"a rating did not count: {answer}")
        await self.until(lambda: self.clip != before, f"a clip after {before}")
        if self.clip is not None:
            await self._pictures[self.clip]
        press = Press(clip=before, value=value, at=at, seconds=time.perf_counter() - began)
        self.presses.append(press)
        return press

    async def next_clip(self) -> None:
        """Waits for a clip after the note that there is none; the press before has taken so much longer.

        Raises:
            RuntimeError: If none comes within minutes.
        """
        began = time.perf_counter()
        await self.until(lambda: self.clip is not None, "another clip", _NO_CLIP_S)
        assert self.clip is not None
        await self._pictures[self.clip]
        last = self.presses[-1]
        self.presses[-1] = replace(last, seconds=last.seconds + time.perf_counter() - began)

    async def post(self, **press: object) -> tuple[int, str]:
        """Sends a press, as a browser does; status and text of what is answered to it."""
        body = {"page": self.token, "id": str(uuid4())} | press
        headers = self.headers | {"Origin": self.base}
        async with self.session.post(f"{self.address}/press", json=body, headers=headers) as answer:
            return answer.status, await answer.text()

    async def do(self, **action: object) -> int:
        """Sends an action of a researcher, as a browser does; the status of the answer."""
        headers = self.headers | {"Origin": self.base, "X-Onedemo-Page": self.token}
        async with self.session.post(f"{self.address}/do", json=action, headers=headers) as answer:
            return answer.status

    async def press(self, key: str) -> None:
        """Presses a key and waits for nothing.

        Raises:
            RuntimeError: If that key does nothing on the page.
        """
        if key not in self.keys:
            raise RuntimeError(f"no command has the key {key!r}; there are {', '.join(self.keys)}")
        await self._say({"type": "CommandTriggerMessage", "uuid": self.keys[key]})

    async def until(
        self, condition: Callable[[], object], what: str, patience_s: float = _PATIENCE_S
    ) -> None:
        """Waits until the page is in some state.

        Raises:
            RuntimeError: If it does not come to it, or the connection ends.
        """
        end = time.monotonic() + patience_s
        while not condition():
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), end - time.monotonic())
            except TimeoutError:
                raise RuntimeError(f"waited {patience_s:.0f} s in vain for {what}") from None
            if self._reader.done():
                raise RuntimeError(f"the page ended its connection before {what}")

    async def close(self) -> None:
        """Closes the page."""
        self._reader.cancel()
        for task in self._pictures.values():
            task.cancel()
        with suppress(asyncio.CancelledError):
            await self._reader
        await asyncio.gather(*self._pictures.values(), return_exceptions=True)
        await self.socket.close()

    async def _say(self, message: dict) -> None:
        await self.socket.send_bytes(msgspec.msgpack.encode(message))

    async def _read(self) -> None:
        try:
            async for packet in self.socket:
                if packet.type is aiohttp.WSMsgType.BINARY:
                    size = int.from_bytes(packet.data[8:_SIZES], "little")
                    packed = self._unpack.decompress(packet.data[_SIZES : _SIZES + size])
                    for message in msgspec.msgpack.decode(packed)["messages"]:
                        self._see(message)
                    self._changed.set()
        finally:
            self._changed.set()

    def _see(self, message: dict) -> None:
        kind = message["type"]
        if kind == "RegisterCommandMessage":
            props = message["props"]
            if props["hotkey"]:
                modifier = f"{props['modifier']}+" if props["modifier"] else ""
                self.keys[modifier + props["hotkey"]] = message["uuid"]
        elif kind == "RemoveCommandMessage":
            self.keys = {key: uuid for key, uuid in self.keys.items() if uuid != message["uuid"]}
        elif kind == "GuiHtmlMessage":
            self._show(message["props"]["content"])
        elif kind == "GuiUpdateMessage" and isinstance(message["updates"].get("content"), str):
            self._show(message["updates"]["content"])

    def _show(self, html: str) -> None:
        if found := _PAGE.search(html):
            self.token = found[1]
        elif found := _CLIP.search(html):
            if self.clip != int(found[1]):
                self._shown_at = time.monotonic()
            self.clip, self.waiting = int(found[1]), False
            self._keep(self.clip, self._coming)
        elif ahead := _AHEAD.search(html):
            self._coming = int(ahead[1])
            self._keep(self.clip, self._coming)
        elif _WAITING in html:
            self.clip, self.waiting = None, True

    def _keep(self, *clips: int | None) -> None:
        """What was shown is forgotten, what comes is fetched ahead."""
        self._pictures = {
            clip: self._pictures.get(clip) or asyncio.create_task(self._fetch(clip))
            for clip in clips
            if clip is not None
        }

    async def _fetch(self, clip: int) -> None:
        async with self.session.get(f"{self.address}/clips/{clip}.jpg", headers=self.headers) as answer:
            answer.raise_for_status()
            await answer.read()


async def open_tab(session: aiohttp.ClientSession, link: str) -> Tab:
    """Opens a person's link as a browser does: cookie, page, WebSocket.

    Args:
        session: May be shared by many tabs; it needs a ``DummyCookieJar``, each tab has a cookie of its own.
        link: As ``onedemo serve`` prints it.

    Raises:
        aiohttp.ClientError: If the link or the page does not work.
    """
    base = "{0.scheme}://{0.netloc}".format(urlsplit(link))
    async with session.get(link, allow_redirects=False) as answer:
        cookies = "; ".join(f"{name}={cookie.value}" for name, cookie in answer.cookies.items())
        page = urljoin(base, answer.headers.get("Location", "/login"))
    headers = {"Cookie": cookies}
    async with session.get(page, headers=headers) as answer:
        answer.raise_for_status()
        await answer.read()
    socket = await session.ws_connect(
        page, headers=headers | {"Origin": base}, protocols=[f"viser-v{version('viser')}"], max_msg_size=0
    )
    tab = Tab(base=base, address=page.rstrip("/"), session=session, socket=socket, headers=headers)
    await tab._say(_CAMERA)  # what makes Viser count the browser as connected
    return tab


def browser_session() -> aiohttp.ClientSession:
    """A session for ``open_tab``, without limits of its own on connections."""
    return aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar(), connector=aiohttp.TCPConnector(limit=0))


def rating(tab: Tab) -> int:
    """What a person at the tab would press, 1..5: every rating comes up equally often."""
    return 1 + (tab.clip or 0) % 5


async def rate_for(tabs: Sequence[Tab], *, every_s: float, seconds: float) -> None:
    """Lets each tab rate once every so many seconds, evenly staggered, for a while.

    Args:
        tabs: Each with a clip on screen.
        every_s: Seconds from press to press of one person.
        seconds: How long.

    Where somebody has no clip to rate, the time until one comes counts as well.

    Raises:
        ExceptionGroup: Of RuntimeErrors, as ``Tab.rate``, or if no more clips come.
    """
    end = time.monotonic() + seconds

    async def person(tab: Tab, start: float) -> None:
        due = start
        while due < end:
            await asyncio.sleep(due - time.monotonic())
            await tab.rate(rating(tab))
            if tab.clip is None:
                await tab.next_clip()
            due = max(due + every_s, time.monotonic())

    began = time.monotonic()
    async with asyncio.TaskGroup() as group:
        for number, tab in enumerate(tabs):
            group.create_task(person(tab, began + every_s * number / len(tabs)))
