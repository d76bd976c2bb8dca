"""Connections of strangers are bounded in number and time, and never crowd out people with a session."""

from __future__ import annotations

import asyncio
import logging
import sys
import time
import zlib
from collections.abc import Sequence
from contextlib import asynccontextmanager

import pytest
from aiohttp import web

from onedemo.app.network import connections, refusals
from onedemo.app.network.bind import Listening
from onedemo.app.network.capacity import Crowd, Limits, raise_descriptors
from onedemo.app.network.connections import Connections
from onedemo.app.network.rate_limit import Bucket, Buckets
from onedemo.app.network.refusals import Refusals, read_body, read_json

SMALL = Limits(strangers=12, strangers_each=4, members=12, members_each=8, pages=4)
GET = b"GET /hello HTTP/1.1\r\nHost: x\r\n%s\r\n"
HALF_BODY = b"POST /take HTTP/1.1\r\nHost: x\r\nContent-Length: 50\r\n\r\nab"
MINE = b"X-Person: 7\r\n"


def person(request: web.Request) -> int | None:
    return int(request.headers["X-Person"]) if "X-Person" in request.headers else None


async def hello(request: web.Request) -> web.Response:
    return web.Response(text="hello")


async def take(request: web.Request) -> web.Response:
    return web.Response(text=f"{len(await read_body(request, 100))} bytes")


async def json(request: web.Request) -> web.Response:
    try:
        return web.json_response(await read_json(request))
    except ValueError as error:
        raise web.HTTPBadRequest(text=str(error)) from None


async def much(request: web.Request) -> web.StreamResponse:
    response = web.StreamResponse()
    await response.prepare(request)
    while True:
        await response.write(bytes(1 << 20))


async def socket(request: web.Request) -> web.StreamResponse:
    answer = web.WebSocketResponse(autoping=False)
    await answer.prepare(request)
    request.protocol.allow(Bucket(1000, 20_000))
    async for _ in answer:
        pass
    return answer


@asynccontextmanager
async def front(limits: Limits = SMALL, offences: Buckets | None = None, between: Sequence = ()):
    """A front without people or pages: (what holds the connections, how to connect)."""
    guard = Refusals(Listening(), offences or Buckets(0.0, 1000), person)
    app = web.Application(middlewares=[guard.around, *between, guard.within])
    app.add_routes([web.get("/hello", hello), web.get("/much", much), web.get("/socket", socket)])
    app.add_routes([web.post("/take", take), web.post("/json", json)])
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    held = Connections(limits)
    port = await held.open(runner.server, "127.0.0.1", 0, None)
    writers = []

    async def connect(data: bytes = b"", *, from_: str = "127.0.0.1"):
        local = (from_, 0) if sys.platform == "linux" else None
        reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=local)
        writers.append(writer)
        writer.write(data)
        await writer.drain()
        return reader, writer

    try:
        yield held, connect
    finally:
        for writer in writers:
            writer.close()
        await held.close()
        await runner.cleanup()


async def status(reader) -> int:
    """Of the next answer; 0 if the connection ended without one. Its body is read, too."""
    try:
        async with asyncio.timeout(20):
            head = await reader.readuntil(b"\r\n\r\n")
            for line in head.lower().split(b"\r\n"):
                if line.startswith(b"content-length:"):
                    await reader.readexactly(int(line.split(b":")[1]))
            return int(head.split()[1])
    except (asyncio.IncompleteReadError, ConnectionError):
        return 0


async def ended(reader) -> bytes:
    """What still comes until the connection ends."""
    async with asyncio.timeout(20):
        try:
            return await reader.read(-1)
        except ConnectionError:
            return b""


async def post(connect, path: str, body: bytes, *headers: str) -> tuple[int, bytes]:
    """(Status, head and body) of a request of its own."""
    lines = [
        f"POST {path} HTTP/1.1",
        "Host: x",
        f"Content-Length: {len(body)}",
        "Connection: close",
        *headers,
    ]
    reader, _ = await connect("\r\n".join(lines).encode() + b"\r\n\r\n" + body)
    answer = await ended(reader)
    return int(answer.split()[1]), answer


@pytest.fixture
def soon(monkeypatch):
    """Time limits of tenths of a second."""
    monkeypatch.setattr(connections, "HEADER_S", 0.2)
    monkeypatch.setattr(connections, "STRANGER_S", 0.4)
    monkeypatch.setattr(connections, "STALLED_S", 0.2)
    monkeypatch.setattr(connections, "_LOOK_S", 0.05)
    monkeypatch.setattr(refusals, "BODY_S", 0.2)


def test_a_connection_of_a_stranger_ends_whatever_it_waits_for(soon):
    async def go():
        async with front() as (_, connect):
            silent, _ = await connect()
            half, _ = await connect(GET[:20])
            idle, _ = await connect(GET % b"")
            assert await status(idle) == 200
            body, _ = await connect(HALF_BODY)
            assert await ended(silent) == b""
            assert await ended(half) == b""
            assert await ended(idle) == b""
            assert (await ended(body)).startswith(b"HTTP/1.1 408")

    asyncio.run(go())


def test_a_header_that_comes_in_pieces_is_heard():
    async def go():
        async with front() as (_, connect):
            reader, writer = await connect()
            for piece in (
                b"GET /hel",
                b"lo HTTP/1.1\r\n",
                b"Host: x\r\n",
                b"\r\nGET /nothing HTTP/1.1\r\nHost: x\r\n\r\n",
            ):
                writer.write(piece)
                await writer.drain()
                await asyncio.sleep(0.02)
            assert [await status(reader), await status(reader)] == [200, 404]

    asyncio.run(go())


@pytest.mark.skipif(sys.platform != "linux", reason="takes many addresses of the loopback")
def test_somebody_with_a_session_gets_in_while_strangers_hold_every_place():
    async def go():
        async with front() as (_, connect):
            mine, me = await connect(GET % MINE)
            assert await status(mine) == 200
            crowd = [
                await connect(start, from_=f"127.0.0.{2 + n}")
                for n in range(60)
                for start in (
                    b"",
                    GET[:20],
                    HALF_BODY,
                )
            ]
            still_open = sum(not reader.at_eof() for reader, _ in crowd)
            async with asyncio.timeout(10):
                while still_open > 2 * SMALL.strangers:
                    await asyncio.sleep(0.01)
                    still_open = sum(not (reader.at_eof() or reader.exception()) for reader, _ in crowd)
            newcomer, _ = await connect(GET % MINE)
            assert await status(newcomer) == 200
            me.write(GET % MINE)
            assert await status(mine) == 200, "somebody with a session was crowded out"

    asyncio.run(go())


def test_a_connection_that_was_lost_while_its_request_is_answered_takes_no_place_again():
    async def go():
        asked, lost, answered = asyncio.Event(), asyncio.Event(), asyncio.Event()

        @web.middleware
        async def recognise(request, handler):
            asked.set()
            await lost.wait()
            try:
                return await handler(request)
            finally:
                answered.set()

        async with front(between=[recognise]) as (held, connect), asyncio.timeout(20):
            _, writer = await connect(GET % MINE)
            await asked.wait()
            writer.transport.abort()
            while list(held._strangers):
                await asyncio.sleep(0.01)
            lost.set()
            await answered.wait()
            assert not list(held._members) and not list(held._strangers)

    asyncio.run(go())


def test_what_nobody_takes_is_not_kept(soon):
    async def go():
        async with front() as (held, connect):
            await connect((GET % MINE).replace(b"/hello", b"/much"))
            async with asyncio.timeout(10):
                while not list(held._members):
                    await asyncio.sleep(0.01)
                while list(held._members):
                    await asyncio.sleep(0.01)

    asyncio.run(go())


def test_frames_of_any_kind_are_counted():
    """Empty fragments are no message until the last has come; 47.8 million passed in 15 s."""

    async def go():
        async with front() as (_, connect):
            upgrade = b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            upgrade += b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n" + MINE
            reader, writer = await connect((GET % upgrade).replace(b"/hello", b"/socket"))
            assert await status(reader) == 101
            writer.write(b"\x02\x80\0\0\0\0")
            async with asyncio.timeout(20):
                try:
                    for _ in range(100):
                        writer.write(b"\x00\x80\0\0\0\0" * 1000)
                        await writer.drain()
                        await asyncio.sleep(0)
                    assert await reader.read(-1) == b""
                except ConnectionError:
                    pass

    asyncio.run(go())


def test_the_newest_takes_the_place_of_the_oldest_of_whoever_holds_most():
    crowd: Crowd[str] = Crowd(4, 2)
    assert [crowd.enter("a", "a1"), crowd.enter("a", "a2"), crowd.enter("b", "b1")] == [None] * 3
    assert crowd.enter("a", "a3") == "a1"  # two of each
    assert crowd.enter("c", "c1") is None
    assert crowd.enter("d", "d1") == "a2"  # four in all
    assert crowd.enter("b", "b1") is None  # once more: now the newest
    assert sorted(crowd) == ["a3", "b1", "c1", "d1"]
    crowd.leave("a", "a3")
    crowd.leave("a", "a3")
    assert crowd.enter("e", "e1") is None


@pytest.mark.parametrize("descriptors", [256, 1024, 4096, 20_000, 1 << 20])
def test_all_places_together_are_fewer_than_the_descriptors(descriptors):
    limits = Limits.of(descriptors)
    assert 2 * limits.strangers + limits.members + 2 * limits.pages <= 0.8 * descriptors
    assert min(limits.strangers, limits.pages) >= 32


@pytest.mark.skipif(sys.platform == "win32", reason="has no such limit")
def test_as_many_descriptors_as_allowed_are_taken():
    import resource

    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (500, before[1]))
        taken = raise_descriptors()
        assert taken == resource.getrlimit(resource.RLIMIT_NOFILE)[0] > 500
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


# What is sent


def test_nothing_encoded_is_read_or_inflated():
    """A gigabyte of zeros, in a few hundred kilobytes, to an address that takes no body."""
    squeeze = zlib.compressobj(9)
    block = squeeze.compress(bytes(1 << 24)) + squeeze.flush(zlib.Z_SYNC_FLUSH)
    bomb = (
        block
        + squeeze.compress(bytes(1 << 24))
        + squeeze.flush(zlib.Z_SYNC_FLUSH)
        + 60 * (squeeze.compress(bytes(1 << 24)) + squeeze.flush(zlib.Z_SYNC_FLUSH))
    )

    async def go():
        async with front() as (_, connect):
            for path in ("/take", "/hello", "/nothing"):
                for coding in ("deflate", "gzip", "br", "zstd", "x-odd"):
                    began = time.process_time()
                    said, answer = await post(connect, path, bomb, f"Content-Encoding: {coding}")
                    assert said == 415 and b"Content-Encoding" in answer, (path, coding)
                    assert time.process_time() - began < 1.0, (path, coding)

    asyncio.run(go())


def test_a_body_that_nobody_reads_ends_the_connection():
    async def go():
        async with front() as (_, connect):
            reader, _ = await connect(HALF_BODY.replace(b"/take", b"/nothing"))
            assert await status(reader) == 404
            assert await ended(reader) == b""

    asyncio.run(go())


@pytest.mark.parametrize(
    ("path", "body", "header", "wanted"),
    [
        ("/take", b"a" * 100, "X: y", 200),
        ("/take", b"a" * 101, "X: y", 413),
        ("/take", b"a", "Content-Type: text/plain; charset=utf-8", 200),
        ("/take", b"a", "Content-Type: text/plain; charset=punycode", 415),
        ("/take", b"a", "Content-Type: text/plain; charset=no-such", 415),
        ("/json", b'{"a": 1}', "Content-Type: application/json", 200),
        ("/json", b"[" * 5000, "X: y", 400),
        ("/json", b"\xff\xfe", "X: y", 400),
        ("/json", b"", "X: y", 400),
        ("/json", b"9" * 5000, "X: y", 400),
        ("/hello", b"", "X: y", 405),
        ("/nothing", b"", "X: y", 404),
    ],
)
def test_every_body_has_its_short_answer(path, body, header, wanted):
    async def go():
        async with front() as (_, connect):
            said, answer = await post(connect, path, body, header)
            assert said == wanted and b"Traceback" not in answer

    asyncio.run(go())


@pytest.mark.parametrize(
    "data",
    [
        b"hello\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01\n", b"GET /hello HTTP/9\r\n\r\n",
        b"GET /hello HTTP/1.1\r\n\0: y\r\n\r\n", GET % (b"X: " + b"y" * 40_000 + b"\r\n"),
        GET % (b"X: y\r\n" * 1000), b"GET /" + b"a" * 40_000, GET % b"Content-Length: -1\r\n",
        GET % b"Transfer-Encoding: gzip\r\n",
    ],
)  # fmt: skip
def test_what_is_no_request_is_told_so_and_not_logged(data, caplog):
    async def go():
        async with front() as (_, connect):
            reader, _ = await connect(data)
            return await ended(reader)

    with caplog.at_level(logging.INFO):
        answer = asyncio.run(go())
    assert answer.startswith(b"HTTP/1.1 400") or answer.startswith(b"HTTP/1.0 400")
    assert b"aiohttp" not in answer and len(answer) < 500
    assert not caplog.records


def test_broken_requests_of_one_sender_are_counted():
    async def go():
        async with front(offences=Buckets(0.0, 2)) as (_, connect):
            said = [(await post(connect, "/take", b"a" * 200))[0] for _ in range(3)]
            said += [(await post(connect, "/take", b"a" * 200, "X-Person: 7"))[0]]
            return [*said, (await post(connect, "/take", b"a"))[0]]

    assert asyncio.run(go()) == [413, 413, 429, 413, 200]
