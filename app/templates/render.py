"""Templates of this folder, filled in."""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup


@cache
def environment() -> Environment:
    """Autoescape everywhere; a value that is not given is an error, not an empty place."""
    return Environment(
        loader=PackageLoader("onedemo.app", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, /, **values: Any) -> Markup:
    """The markup of a template.

    Args:
        template: Its file name, such as ``watch.html``; ``watch.html:figures`` is its macro ``figures``,
            called with the values as keywords.
        values: What it names.

    Raises:
        jinja2.UndefinedError: If the template names a value that is not given.
    """
    name, _, macro = template.partition(":")
    found = environment().get_template(name)
    if not macro:
        return Markup(found.render(values))
    return Markup(getattr(found.module, macro)(**values))
