"""The files of the page: our static ones, Viser's HTML with them added, and what of it may run.

Viser's client is one HTML file: a short script unpacks the client from an attribute of its own element and
runs it. The policy of the page names both by their digests, so nothing else that is inline runs, whatever
gets into the page.
"""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from pathlib import Path

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

_VISER_HTML = Path(viser.__file__).parent / "client" / "build" / "index.html"
_LOADER = re.compile(r'<script data-p="([^"]*)" data-ss="(\d+)" data-cs="(\d+)">(.*?)</script>', re.DOTALL)
"""The script of Viser's HTML: what it unpacks, bytes of style sheet and script in that, and itself."""
_DIGITS = "!#$%()*+,-./0123456789:;=?@ABCDEFGHIJKLMNOPQRSTUVWXYZ[\\]^_abcdefghijklmnopqrstuvwxyz{|}~"
"""Of the numbers to the base 88 in which it is packed: five for four bytes."""


def page_html() -> str:
    """Viser's page with our title, icon, style sheets and scripts, which run before its own.

    Its body begins before Viser's script: what is said while that loads can be seen.

    Raises:
        ValueError: If this version of Viser writes its head in another way.
    """
    html = _VISER_HTML.read_text()
    start, icon, rest = html.partition('<link\n      rel="icon"')
    _, end_of_icon, rest = rest.partition("/>")
    before, title, after = rest.partition("<title>Viser</title>")
    script, end_of_head, body = after.partition("</head>")
    _, start_of_body, body = body.partition("<body>")
    if not (icon and end_of_icon and title and end_of_head and start_of_body):
        raise ValueError("Viser's page has changed: no icon, title or body where they were")
    return "".join((start, before, render("head.html"), script, body))


@cache
def viser_scripts() -> tuple[str, str]:
    """The two scripts of Viser's page: the one that unpacks, and the client that it unpacks.

    Raises:
        ValueError: If this version of Viser packs its client in another way.
    """
    found = _LOADER.search(_VISER_HTML.read_text())
    if found is None or f'"{_DIGITS}"'.replace("\\", "\\\\") not in found[4]:
        raise ValueError("Viser's page has changed: its client is not packed as it was")
    packed, style, script, loader = found[1], int(found[2]), int(found[3]), found[4]
    # An unfinished group counts as if its missing digits and bytes were zero at the front.
    number = _DIGITS.index
    unpacked = bytearray()
    for start in range(0, len(packed), 5):
        group, value = packed[start : start + 5], 0
        for digit in group:
            value = value * len(_DIGITS) + number(digit)
        unpacked += value.to_bytes(len(group), "big")[1:]
    client = zstandard.ZstdDecompressor().decompressobj().decompress(unpacked)
    if len(client) != style + script:
        raise ValueError("Viser's page has changed: its client is not packed as it was")
    return loader, client[style:].decode()


@cache
def page_policy() -> str:
    """Content-Security-Policy of the page.

    Viser needs WebAssembly, workers and pictures that it makes itself (blob:, data:), and writes styles; a
    video that somebody chooses to send is played before it is sent (media-src blob:). Viser
    would run JavaScript that its server sends, and sort Gaussian splats with generated code: both need
    unsafe-eval, and stay off. Its files, the socket included, come from here alone.

    Raises:
        ValueError: As ``viser_scripts``.
    """
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in viser_scripts()]
    scripts = " ".join(f"'sha256-{digest}'" for digest in digests)
    return (
        f"default-src 'none'; script-src 'self' 'wasm-unsafe-eval' {scripts}; script-src-attr 'none'; "
        "worker-src blob:; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "media-src 'self' blob:; font-src 'self' data:; "
        "connect-src 'self' data: blob:; form-action 'self'; base-uri 'none'; "
        "object-src 'none'; frame-ancestors 'none'"
    )
