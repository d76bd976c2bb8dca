"""Templates of this folder, filled in."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

_ZERO = re.compile(r"[+-]0(\.0+)?")


@cache
def environment() -> Environment:
    """Autoescape everywhere; a value that is not given is an error, not an empty place."""
    found = Environment(
        loader=PackageLoader("onedemo.app", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        auto_reload=False,  # else the time of the file is looked up at every call
    )
    found.filters |= {"number": number, "steps": steps}
    return found


def render(template: str, /, **values: Any) -> Markup:
    """The markup of a template.

    Viser sends no ``Markup``: what goes into one of its handles is ``str(render(...))``.

    Args:
        template: Its file name, such as ``login.html``; ``watch.html:strip`` is its macro ``strip``,
            called with the values as keywords. A file is either a page or a collection of macros.
        values: What it names.

    Raises:
        jinja2.UndefinedError: If the template names a value that is not given.
    """
    name, _, macro = template.partition(":")
    found = environment().get_template(name)
    if not macro:
        return Markup(found.render(values))
    # Stripped: the style sheet asks whether a place is empty, and a line break would fill it.
    return Markup(getattr(found.module, macro)(**values).strip())


def number(value: float | None, form: str = "") -> str:
    """Filter: a number as ``format`` writes it; a dash where there is none, and no sign before a zero."""
    if value is None:
        return "–"
    text = format(value, form)
    return text[1:] if _ZERO.fullmatch(text) else text


def steps(count: int) -> str:
    """Filter: a number of control steps, in a few characters."""
    if count >= 1_000_000:
        return f"{count / 1_000_000:.2f} M"
    return f"{count / 1000:.0f} k" if count >= 10_000 else f"{count}"
