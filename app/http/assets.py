"""The files of the page: our static ones and Viser's HTML with them added."""

from __future__ import annotations

from pathlib import Path

import viser

from onedemo import static
from onedemo.app.templates import render

STATIC = Path(static.__file__).parent
SERVED = {".css", ".js", ".svg", ".png", ".webp"}
"""Kinds of files that may leave the static folder."""
PUBLIC = {"/static/login.css", "/static/icon.svg"}
"""What the login page needs, served without a session."""

_VISER_HTML = Path(viser.__file__).parent / "client" / "build" / "index.html"


def page_html() -> str:
    """Viser's page with our title, icon, style sheet and key handling.

    Raises:
        ValueError: If this version of Viser writes its head in another way.
    """
    html = _VISER_HTML.read_text()
    start, icon, rest = html.partition('<link\n      rel="icon"')
    _, end_of_icon, rest = rest.partition("/>")
    before, title, after = rest.partition("<title>Viser</title>")
    if not (icon and end_of_icon and title):
        raise ValueError("Viser's page has changed: no icon or title where they were")
    return "".join((start, before, render("head.html"), after))
