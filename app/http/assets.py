"""The files of the page: our static ones, Viser's client taken out of its one HTML file, and what may run.

Viser ships its client as a single HTML file: a short script unpacks style sheet and client from an attribute
of its own element and runs them inline. Here they are unpacked once and served as files: a browser keeps
them, compiled, where the one file came and was compiled anew at each load, and no script is inline.
"""

from __future__ import annotations

import gzip
import hashlib
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import viser
import zstandard

from onedemo import static
from onedemo.app.templates import render

STATIC = Path(static.__file__).parent
SERVED = {".css", ".js", ".svg", ".png", ".webp"}
"""Kinds of files that may leave the static folder."""
PUBLIC = {"login.css", "icon.svg"}
"""What the login page needs, served without a session."""
POLICY = (
    "default-src 'none'; img-src 'self'; style-src 'self'; script-src-attr 'none'; form-action 'self'; "
    "base-uri 'none'; object-src 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of everything but the page."""
PAGE_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; script-src-attr 'none'; "
    "worker-src blob:; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "media-src 'self' blob:; font-src 'self' data:; connect-src 'self' data: blob:; form-action 'self'; "
    "base-uri 'none'; object-src 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of the page.

Viser needs WebAssembly, workers and pictures that it makes itself (blob:, data:), and writes styles; a
video that somebody chooses to send is played before it is sent (media-src blob:). Viser
would run JavaScript that its server sends, and sort Gaussian splats with generated code: both need
unsafe-eval, and stay off. Its files, the socket included, come from here alone.
"""

_VISER_HTML = Path(viser.__file__).parent / "client" / "build" / "index.html"
_LOADER = re.compile(r'<script data-p="([^"]*)" data-ss="(\d+)" data-cs="(\d+)">(.*?)</script>', re.DOTALL)
"""The script of Viser's HTML: what it unpacks, bytes of style sheet and script in that, and itself."""
_DECODER = re.compile(r'gzWasm="([^"]*)"')
"""In that script: the decoder of zstd, with which the client reads messages, too."""
_DIGITS = "!#$%()*+,-./0123456789:;=?@ABCDEFGHIJKLMNOPQRSTUVWXYZ[\\]^_abcdefghijklmnopqrstuvwxyz{|}~"
"""Of the numbers to the base 88 in which both are packed: five for four bytes."""
_SHARE_DECODER = (
    "globalThis.__viserZstdWasm = await WebAssembly.compileStreaming("
    'fetch(new URL("zstd.wasm", import.meta.url)));\n'
)
"""What Viser's own loader does before the client begins."""


class Packed(NamedTuple):
    """A file of Viser's client as it is sent."""

    body: bytes
    """Packed with gzip: no browser of ours does without."""
    kind: str


@cache
def viser_files() -> dict[str, Packed]:
    """Viser's client by the names of its files: style sheet, script, and the decoder that it needs.

    Raises:
        ValueError: If this version of Viser packs its client in another way.
    """
    found = _LOADER.search(_VISER_HTML.read_text())
    decoder = found and _DECODER.search(found[4])
    if not (found and decoder) or f'"{_DIGITS}"'.replace("\\", "\\\\") not in found[4]:
        raise ValueError("Viser's page has changed: its client is not packed as it was")
    style = int(found[2])
    client = zstandard.ZstdDecompressor().decompressobj().decompress(_from_base_88(found[1]))
    if len(client) != style + int(found[3]):
        raise ValueError("Viser's page has changed: its client is not packed as it was")
    wasm = gzip.decompress(_from_base_88(decoder[1].replace("\\\\", "\\")))
    return {
        "viser.css": _packed(client[:style], "text/css"),
        "viser.js": _packed(_SHARE_DECODER.encode() + client[style:], "text/javascript"),
        "zstd.wasm": _packed(wasm, "application/wasm"),
    }


@cache
def page_html() -> str:
    """The head of Viser's page with our title, icon, style sheets and scripts, which run before Viser's.

    Raises:
        ValueError: As ``viser_files``.
    """
    digest = hashlib.sha256(b"".join(file.body for file in viser_files().values())).hexdigest()
    return str(render("page.html", viser=digest[:16]))


def _packed(data: bytes, kind: str) -> Packed:
    return Packed(gzip.compress(data, compresslevel=9, mtime=0), kind)


def _from_base_88(packed: str) -> bytes:
    number = np.zeros(128, np.uint64)
    number[[ord(digit) for digit in _DIGITS]] = np.arange(len(_DIGITS))
    # An unfinished group counts as if its missing digits and bytes were zero at the front.
    left = len(packed) % 5
    whole = "!" * (-len(packed) % 5)
    whole = packed[: len(packed) - left] + whole * bool(left) + packed[len(packed) - left :]
    digits = number[np.frombuffer(whole.encode(), np.uint8)].reshape(-1, 5)
    unpacked = (digits @ 88 ** np.arange(4, -1, -1, dtype=np.uint64)).astype(">u4").tobytes()
    return unpacked[: len(unpacked) - 4] + unpacked[len(unpacked) - left + 1 :] if left else unpacked
