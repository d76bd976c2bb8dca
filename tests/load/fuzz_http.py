"""Hostile input by the hundred thousand against a real front on the loopback, with a page open.

    .venv/bin/python tests/load/fuzz_http.py [--quick] [--seed N] [--json FILE]

Three kinds: WebSocket messages (with an annotator's session, and without any), HTTP requests, video files
for ``demo add``. Promised: the server answers throughout, nobody's data change, nothing is left open or
grows. Ends with one line of figures and, where a promise was broken, exit status 1 and the bytes that did
it in hex. The messages are derived from those that a page sends, with the identities of a live page.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import hashlib
import json
import logging
import os
import random
import re
import sqlite3
import sys
import tempfile
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, redirect_stderr
from pathlib import Path

import aiohttp
import msgspec
import viser
from data.videos import KINDS

from helpers.fake_trainer import StandIn
from onedemo.app.annotation.assignment import Again
from onedemo.app.http.server import Front
from onedemo.app.http.tokens import issue_link, read_secret
from onedemo.app.network.bind import Listening
from onedemo.app.services.demo_images import Pictures
from onedemo.app.ui.app import Page
from onedemo.demos.library import import_video
from onedemo.demos.sandboxed_decoder import Limits
from onedemo.errors import UserError

FULL = {"messages": 100_000, "requests": 10_000, "videos": 500}
QUICK = {"messages": 1_000, "requests": 200, "videos": 6}
ANSWER_SECONDS = 10.0
"""A server that has not answered by then hangs."""
PAGES_AT_ONCE = 3
MOST_GROWTH_MB = 150
"""Of resident memory, after the first tenth of each kind, over the whole."""


class Findings:
    """What was counted, and which promises were broken."""

    def __init__(self) -> None:
        self.counts: dict[str, float] = {}
        self.broken: list[str] = []

    def count(self, what: str, by: float = 1) -> None:
        self.counts[what] = self.counts.get(what, 0) + by

    def fail(self, what: str, data: bytes = b"") -> None:
        self.broken.append(f"{what}{': ' + data[:400].hex() if data else ''}")


class Tracebacks(logging.Handler):
    """Whatever ends in a traceback in the log is a promise broken."""

    def __init__(self, findings: Findings) -> None:
        super().__init__()
        self._findings = findings

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and record.exc_info[1] is not None:
            self._findings.fail(f"{record.name} logged {record.exc_info[1]!r}: {record.getMessage()[:200]}")


@contextmanager
def serving(directory: Path):
    """A front with a page and a trainer that does not learn: (page, front, url, link of an annotator)."""
    trainer = StandIn(directory)
    page = Page(
        trainer,
        pictures=Pictures(trainer.demo, read=lambda _: trainer.frames),
        again=Again(shared=0, repeated=0),
    )
    front = Front(page, Listening(port=0))
    try:
        url = front.start()
        rater = trainer.store.accounts.ensure("bo", "annotator")
        trainer.store.accounts.set_practised(rater.id)
        trainer.store.ratings.rate(1, rater.id, 4, 900)
        yield page, url, issue_link(trainer.store, read_secret(directory), rater, url)
    finally:
        front.close()
        page.close()
        trainer.store.close()


def state(database: Path) -> str:
    """A digest of every row of every table; the audit log alone may grow: it tells of the attack."""
    digest = hashlib.sha256()
    with closing(sqlite3.connect(database)) as db:
        names = [
            n for (n,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")
        ]
        for name in sorted(set(names) - {"audit", "sqlite_sequence"}):
            for row in db.execute(f'SELECT * FROM "{name}" ORDER BY 1'):
                digest.update(repr((name, row)).encode())
    return digest.hexdigest()


def usage() -> dict[str, int]:
    gc.collect()
    status = Path("/proc/self/status").read_text()
    return {
        "rss_mb": int(re.search(r"VmRSS:\s+(\d+)", status)[1]) // 1024,
        "threads": threading.active_count(),
        "files": len(os.listdir("/proc/self/fd")),
    }


class Health(threading.Thread):
    """Asks the server five times a second whether it is well."""

    def __init__(self, url: str, findings: Findings) -> None:
        super().__init__(daemon=True)
        self._url, self._findings, self._ended = url, findings, threading.Event()
        self.slowest = 0.0

    def run(self) -> None:
        asyncio.run(self._ask())

    async def _ask(self) -> None:
        timeout = aiohttp.ClientTimeout(total=ANSWER_SECONDS)
        async with aiohttp.ClientSession(timeout=timeout) as session:
            while not self._ended.is_set():
                start = time.monotonic()
                try:
                    async with session.get(self._url + "/healthz") as answer:
                        if answer.status != 200 or not (await answer.json())["ok"]:
                            self._findings.fail(f"health says {answer.status}")
                except (aiohttp.ClientError, TimeoutError) as error:
                    self._findings.fail(f"health does not answer: {error!r}")
                self.slowest = max(self.slowest, time.monotonic() - start)
                await asyncio.sleep(0.2)

    def end(self) -> None:
        self._ended.set()
        self.join()


# --- what is sent ---------------------------------------------------------------------------------

HOSTILE = (
    None, True, False, 0, -1, 6, 2**31, 2**63 - 1, -(2**63), float("nan"), float("inf"), -0.0, 1e308, "", "1",
    "\0", "\u202e", "../../etc/passwd", "<script>alert(1)</script>", "' OR 1=1 --", "x" * 5000, "\ud7ff", b"",
    b"\xff" * 300, [], [[]] * 50, {}, {"value": 5}, {"__class__": "x"},
)  # fmt: skip


def nested(depth: int):
    value: object = 1
    for _ in range(depth):
        value = [value]
    return value


def known_kinds() -> dict[str, list[str]]:
    """Every message type that Viser knows, with its fields."""
    kinds = viser._messages.Message._subclass_from_type_string()
    return {name: list(getattr(kind, "__dataclass_fields__", {})) for name, kind in kinds.items()}


def page_messages(handles: list[str]) -> list[dict]:
    """What a page sends, with the handles of a live one."""
    camera = {
        "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [3.0, 3.0, 3.0], "fov": 1.3,
        "near": 0.01, "far": 1000.0, "image_height": 900, "image_width": 1200, "look_at": [0.0, 0.0, 0.0],
        "up_direction": [0.0, 0.0, 1.0],
    }  # fmt: skip
    updates = [{"type": "GuiUpdateMessage", "uuid": u, "updates": {"value": 3}} for u in handles]
    return [camera, *updates, {"type": "CommandTriggerMessage", "uuid": "0" * 36}]


def hostile_message(rng: random.Random, originals: list[dict], kinds: dict[str, list[str]]) -> bytes:
    """One message. None is a press that the page offers, so none may change anything."""
    way = rng.random()
    if way < 0.45:  # one that the page sends, with other values in its places
        message = dict(rng.choice(originals))
        for _ in range(rng.randint(1, 3)):
            name = rng.choice(list(message))
            if name == "updates" and rng.random() < 0.7:
                key = rng.choice(("value", "visible", "disabled", "content", "_order", "__init__", ""))
                message[name] = {key: rng.choice(HOSTILE)}
            elif name != "type" or rng.random() < 0.1:
                message[name] = rng.choice(HOSTILE)
        return msgspec.msgpack.encode(message)
    if way < 0.85:  # any that Viser knows
        name = rng.choice(list(kinds))
        message = {"type": name} | {field: rng.choice(HOSTILE) for field in kinds[name]}
        return msgspec.msgpack.encode(message)
    if way < 0.95:  # bytes of a real one, broken
        return mutated(rng, msgspec.msgpack.encode(rng.choice(originals)))
    return rng.choice(
        (
            rng.randbytes(rng.randint(0, 200)),
            msgspec.msgpack.encode(nested(900)),
            b"\xdf\xff\xff\xff\xff",
            b"\xc1",
        )
    )


def mutated(rng: random.Random, data: bytes) -> bytes:
    """Bytes flipped, cut out, doubled or put in."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(out) + 1)
        way = rng.random()
        if way < 0.6 and at < len(out):
            out[at] = rng.choice((0, 255, 127, 128, rng.randrange(256), out[at] ^ 1 << rng.randrange(8)))
        elif way < 0.75:
            del out[at : at + rng.randint(1, max(1, len(out) // 4))]
        elif way < 0.9:
            out[at:at] = out[at : at + rng.randint(1, 64)]
        else:
            out[at:at] = rng.randbytes(rng.randint(1, 16))
    return bytes(out)


def hostile_request(rng: random.Random, cookie: str, own: str = "") -> bytes:
    """One HTTP request, from an annotator or a stranger, whole or broken; ``own`` is the front's origin."""
    paths = (
        "/", "/login?token=x", "/login", "/healthz", "/r/2", "/r/1", "/r/2/press", "/r/1/do", "/r/2/do",
        "/clips/1.jpg", "/pairs/1.jpg", "/demo/frames/3.jpg", "/rollouts/1.webm", "/export.csv", "/preview",
        "/segments.parquet", "/card.md", "/static/page.css", "/static/..%2f..%2fpyproject.toml",
        "/clips/%00.jpg", "/clips/99999999999999999999.jpg", "/demos", "//", "/r/000000002", "*", "http://x/",
        f"/static/{'a' * 300}.css", "/static/%ed%a0%80.js", "/preview?value=%C2%B2", "/skips.csv?run=%C2%B2",
        f"/preview?value={'9' * 30}", f"/card.md?run={'%F0%9F%98%80' * 80}", "/preview?" + "run=&" * 2000,
        f"/rollouts/{'9' * 9}.jpg", "/login?token=%ff%fe", "/login?token=" + "a" * 8000, "/r/%D9%A2",
    )  # fmt: skip
    methods = ("GET", "POST", "PUT", "DELETE", "HEAD", "OPTIONS", "TRACE", "CONNECT", "PATCH", "G\0T", "")
    bodies = (
        b"", b"{}", b"[" * 3000, b'{"press": "rate", "clip": 1e999}',
        b'{"press": "rate", "page": "x", "id": "1", "clip": 1, "value": 3, "mark": [0, 1]}', b"\xff\xfe",
        b'{"do": "exclude", "rater": 2}', b'{"do": "new run"}', b"x" * 70_000, b'{"a":' * 3000, b"9" * 6000,
        b'{"do": "exclude", "rater": %d}' % 2**70, b'{"do": "open run", "run": "%s"}' % (b"\xc3\xa9" * 90),
        b'{"do": "new run", "demo": "", "method": "", "name": "", "predictor_from": "", "seed": %d}' % 2**70,
        b'{"press": "rate", "page": "x", "id": "1", "value": 3, "clip": %d}' % 2**70,
        zlib.compress(b"token=" + bytes(1 << 20)), b"token=%ff%fe&token=" + b"%00" * 200, b"&" * 1000,
        b"--b\r\n" + b"X: y\r\n" * 3000 + b"\r\n", b"--b\r\n\r\n--b--\r\n", b"--b\r\nX\r\n\r\n",
        b'--b\r\nContent-Disposition: form-data; name="name"\r\n\r\n1\r\n' * 500,
        b'--b\r\nContent-Disposition: form-data; name="video"; filename*=x\'\'%ff\r\n\r\n1\r\n--b--\r\n',
        b"--b\r\nContent-Type: multipart/mixed; boundary=c\r\n\r\n--c\r\n\r\n--c--\r\n--b--\r\n",
    )  # fmt: skip
    codings = ("gzip", "deflate", "br", "zstd", "no-such", "", "gzip, gzip", "identity")
    charsets = ("utf-8", "punycode", "utf-7", "idna", "no-such", "\0", "undefined", "zlib", "utf-16", '"')
    kinds = (
        "application/json", "application/x-www-form-urlencoded", "multipart/form-data; boundary=b",
        "multipart/form-data", "multipart/form-data; boundary=" + "b" * 100, "a", "\xff",
        "text/plain; charset",
    )  # fmt: skip
    protocols = ("viser-v1.1.1", "{", "a b", "\xe9", ",,", "x" * 500, "viser-v" + "9" * 300, "\x7f")
    extras = (
        "Origin: http://evil.example", "Upgrade: websocket", "Transfer-Encoding: chunked", "X\0: y",
        ": empty", "Transfer-Encoding: gzip, chunked", "X-Onedemo-Rater: 1", "Range: bytes=-1",
        "If-Range: \xff", f"Range: bytes={'9' * 5000}-", "Expect: 100-continue", "Expect: \xff",
        "X-Forwarded-For: \xff", "If-None-Match: \xff", "If-Modified-Since: Mon, 99 Jan 99999 99:99:99 GMT",
        "Cookie: " + "a=b; " * 999, "Cookie: \xff=\xfe; onedemo-1-=\0", *["X: y"] * 3,
    )  # fmt: skip
    # Most have one thing wrong, and get as far as that; the others have many.
    odd = rng.choice((0.02, 0.02, 0.3))

    def one(fine: str, wrong: tuple) -> str:
        return rng.choice(wrong) if rng.random() < odd else fine

    more = one("", ("?", "/", "%", "%2e%2e/", "?run=", "\t", "\u00e9")) + one("", ("A", "AAA", "A" * 9000))
    body = rng.choice(bodies) if rng.random() < 0.5 else b""
    method = one("POST" if body else "GET", methods)
    lines = [
        f"{method} {rng.choice(paths)}{more} HTTP/{one('1.1', ('1.0', '9', ''))}",
        f"Host: {one(own[7:], ('evil.example', '', 'a' * 3000))}",
        "Connection: close",
        f"Content-Length: {one(str(len(body)), (-1, 10**12, 'x'))}",
    ]
    if rng.random() < 0.6:
        lines.append(f"Cookie: {one(cookie, ('a=' + 'b' * rng.randint(0, 6000),))}")
    if rng.random() < 0.8:
        lines.append(f"Origin: {own}")
    if rng.random() < 0.6:
        lines.append(f"Content-Type: {rng.choice(kinds)}{one('', tuple(f'; charset={c}' for c in charsets))}")
    if rng.random() < odd:
        lines.append(f"Content-Encoding: {rng.choice(codings)}")
    if rng.random() < 0.15:
        lines += [f"Sec-WebSocket-Protocol: {rng.choice(protocols)}", "Sec-WebSocket-Version: 13"]
        lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Connection: Upgrade", "Upgrade: websocket"]
    lines += [extra for extra in extras if rng.random() < odd]
    data = "\r\n".join(lines).encode("utf-8", "surrogateescape") + b"\r\n\r\n" + body
    return mutated(rng, data) if rng.random() < odd else data


# --- sending it -----------------------------------------------------------------------------------


async def log_in(link: str) -> tuple[str, str]:
    """(Cookie header, address of the page) of a link."""
    async with aiohttp.ClientSession() as session, session.get(link, allow_redirects=False) as answer:
        cookie = answer.headers["Set-Cookie"].split(";")[0]
        return cookie, answer.headers["Location"]


async def send_messages(
    url: str, place: str, cookie: str, page: Page, rng: random.Random, count: int, findings: Findings
) -> None:
    """Sends hostile messages on as many sockets as it takes, each until the server closes it."""
    kinds, sent = known_kinds(), 0
    headers = {"Origin": url, "Cookie": cookie}
    refused = [(url + place, {"Origin": url}), (url + place, headers | {"Origin": "http://evil.example"})]
    timeout = aiohttp.ClientTimeout(total=ANSWER_SECONDS)
    async with aiohttp.ClientSession(timeout=timeout) as session:
        for address, how in refused:
            try:
                await session.ws_connect(address, headers=how)
                findings.fail(f"a socket opened with {how}")
            except aiohttp.WSServerHandshakeError:
                findings.count("sockets refused")
        busy = 0
        while sent < count and len(findings.broken) < 20:
            before = set(page._sessions)
            try:
                socket = await session.ws_connect(
                    url + place, headers=headers, protocols=[f"viser-v{viser.__version__}"]
                )
            except aiohttp.WSServerHandshakeError as error:
                busy += 1
                if error.status not in (429, 503) or busy > 200:
                    findings.fail(f"no socket after {sent} messages: {error!r}")
                    return
                await asyncio.sleep(0.1)  # those that were closed are still being cleared away
                continue
            except (aiohttp.ClientError, TimeoutError) as error:
                findings.fail(f"no socket after {sent} messages: {error!r}")
                return
            busy = 0
            findings.count("sockets")
            async with socket:
                await asyncio.wait_for(socket.receive(), ANSWER_SECONDS)
                originals = page_messages(handles(page, set(page._sessions) - before))
                reader = asyncio.ensure_future(drain(socket))
                for _ in range(200):
                    if socket.closed or reader.done() or sent >= count:
                        break
                    data = hostile_message(rng, originals, kinds)
                    try:
                        await asyncio.wait_for(socket.send_bytes(data), ANSWER_SECONDS)
                    except (ConnectionError, aiohttp.ClientError):
                        break
                    except TimeoutError:
                        findings.fail("a message was not taken", data)
                    sent += 1
                    findings.count("messages")
                    if sent % 8 == 0:
                        await asyncio.sleep(0)
                await socket.close()
                await reader


async def drain(socket) -> None:
    async for _ in socket:
        pass


def handles(page: Page, new: set[int]) -> list[str]:
    """What the page of a client that has just come listens to, without its presses."""
    clients = page._server.get_clients()
    return [uuid for n in new if n in clients for uuid in list(clients[n].gui._gui_input_handle_from_uuid)]


async def send_requests(port: int, cookie: str, rng: random.Random, count: int, findings: Findings) -> None:
    """Sends hostile requests, eight at a time, from many addresses: of one, so many strangers are slowed."""

    async def one(data: bytes, number: int) -> None:
        local = (
            (f"127.0.{number // 25_000}.{2 + number // 100 % 250}", 0) if sys.platform == "linux" else None
        )
        reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=local)
        try:
            writer.write(data)
            await writer.drain()
            try:
                answer = await asyncio.wait_for(reader.read(64), 0.5)
            except TimeoutError:  # it was promised more than it got: it must let go when none comes
                findings.count("requests never finished")
                writer.write_eof()
                answer = await asyncio.wait_for(reader.read(64), ANSWER_SECONDS)
            status = answer[9:12].decode("ascii", "replace") if answer.startswith(b"HTTP/") else "none"
            findings.count(f"answers {status[0] + 'xx' if status[0].isdigit() else status}")
            if status.startswith("5") and status not in ("501", "503"):
                findings.fail(f"answered {status}", data)
        except TimeoutError:
            findings.fail("a request was not answered", data)
        except ConnectionError:
            findings.count("answers none")
        finally:
            writer.close()
        findings.count("requests")

    own = f"http://127.0.0.1:{port}"
    for start in range(0, count, 8):
        numbers = range(start, min(start + 8, count))
        await asyncio.gather(*(one(hostile_request(rng, cookie, own), number) for number in numbers))


_MUTATED = {
    "h264.mp4", "hevc.mp4", "av1.webm", "vp9.webm", "mpeg4.avi", "mjpeg.avi", "interlaced.ts", "mpeg2.mxf",
    "h264.flv", "fast.gif", "delays.apng", "delays.webp", "prores.mov", "raw.y4m", "vp9.ivf", "wmv2.wmv",
}  # fmt: skip


def add_videos(directory: Path, rng: random.Random, count: int, findings: Findings) -> None:
    """Brings mutated videos in: each becomes a demo or is refused in one sentence."""
    directory.mkdir()
    originals = {kind.file: directory / kind.file for kind in KINDS if kind.file in _MUTATED}
    for kind in KINDS:
        if kind.file in originals:
            kind.make(originals[kind.file])
    jobs = []
    for number in range(count):
        file = rng.choice(list(originals))
        jobs.append((number, Path(file).suffix, mutated(rng, originals[file].read_bytes())))

    def one(job: tuple[int, str, bytes]) -> None:
        number, suffix, data = job
        file = directory / f"{number}{suffix}"
        file.write_bytes(data)
        try:
            import_video(
                file,
                name=f"v{number}",
                demos_dir=directory / "demos",
                limits=Limits(cpu_seconds=10, wall_seconds=30),
            )
            findings.count("videos taken")
        except UserError as error:
            findings.count("videos refused")
            if "\n" in str(error) or "takes longer" in str(error):
                findings.fail(f"a video was refused with {error}", data)
        except Exception as error:
            findings.fail(f"a video raised {error!r}", data)
        file.unlink()

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, jobs))
    for left in (directory / "demos").glob(".import-*"):
        findings.fail(f"{left} was left behind")


def attack(directory: Path, sizes: dict[str, int], seed: int) -> Findings:
    """Everything, one kind after the other."""
    findings, start = Findings(), time.monotonic()
    rng = random.Random(seed)
    logging.getLogger().handlers = [Tracebacks(findings)]
    with serving(directory) as (page, url, link):
        port, database = int(url.rsplit(":", 1)[1]), page.trainer.store.path
        cookie, place = asyncio.run(log_in(link))
        before = state(database)
        health = Health(url, findings)
        health.start()

        def messages(count: int) -> None:
            async def several() -> None:
                shares = [count // PAGES_AT_ONCE + (n < count % PAGES_AT_ONCE) for n in range(PAGES_AT_ONCE)]
                senders = [
                    send_messages(url, place, cookie, page, random.Random(rng.random()), share, findings)
                    for share in shares
                ]
                await asyncio.gather(*senders)

            asyncio.run(several())

        def requests(count: int) -> None:
            asyncio.run(send_requests(port, cookie, rng, count, findings))

        messages(sizes["messages"] // 10)  # what is made once is no growth
        requests(sizes["requests"] // 10)
        time.sleep(1)
        at_first = usage()
        messages(sizes["messages"] - sizes["messages"] // 10)
        requests(sizes["requests"] - sizes["requests"] // 10)
        add_videos(directory / "videos", rng, sizes["videos"], findings)
        deadline = time.monotonic() + 10
        while (at_last := usage()) and time.monotonic() < deadline:
            if at_last["files"] <= at_first["files"] + 2 and at_last["threads"] <= at_first["threads"] + 2:
                break
            time.sleep(0.5)  # what was closed is still being cleared away
        health.end()
        if state(database) != before:
            findings.fail("the database was changed")
        with closing(sqlite3.connect(database)) as db:
            if (said := db.execute("PRAGMA integrity_check").fetchone()[0]) != "ok":
                findings.fail(f"the integrity check says {said}")
    for what, most in (("rss_mb", MOST_GROWTH_MB), ("threads", 40), ("files", 10)):
        grown = at_last[what] - at_first[what]
        findings.counts[f"{what} before"], findings.counts[f"{what} after"] = at_first[what], at_last[what]
        if grown > most:
            findings.fail(f"{what} grew from {at_first[what]} to {at_last[what]}")
    findings.counts["slowest health, s"] = round(health.slowest, 2)
    findings.counts["seconds"] = round(time.monotonic() - start, 1)
    return findings


def main() -> int:
    """Runs it and prints one line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory, open(os.devnull, "w") as quiet, redirect_stderr(quiet):
        findings = attack(Path(directory) / "data", QUICK if arguments.quick else FULL, arguments.seed)
    for line in findings.broken[:20]:
        print("BROKEN", line)
    told = {"seed": arguments.seed, **findings.counts, "broken": findings.broken}
    if arguments.json:
        arguments.json.write_text(json.dumps(told, indent=1) + "\n")
    print(", ".join(f"{key} {value:g}" for key, value in findings.counts.items()), end="; ")
    print(f"promises broken {len(findings.broken)}")
    return bool(findings.broken)


if __name__ == "__main__":
    sys.exit(main())
