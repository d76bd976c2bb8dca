"""What may be a name: of demos and runs, which become files and addresses, and of people."""

from __future__ import annotations

import re
import unicodedata

from onedemo.errors import UserError

LONGEST = 64
_NAME = re.compile(r"[A-Za-z0-9_-]+")
_MISSING = frozenset(("NA", "N-A", "NULL", "null", "None", "NaN", "nan", "-nan", "-NaN"))
_IN_PEOPLE = frozenset(" -_.'@,()+&#")
"""Characters in a person's name besides letters and digits."""


def check_name(name: str, *, longest: int = LONGEST) -> str:
    """The name, which may become one part of a path and of a link, wherever it came from.

    Every name that was not chosen by the program goes through here where it becomes a path.

    Raises:
        UserError: Unless it is 1 to so many letters, digits, '-' or '_'.
    """
    if not (isinstance(name, str) and _NAME.fullmatch(name) and len(name) <= longest):
        raise UserError(f"a name is 1 to {longest} letters, digits, '-' or '_', got {_shown(str(name))}")
    return name


def check_new_name(name: str) -> None:
    """Raises UserError if that is what programs write for "no value": nobody and nothing new is called so.

    pandas and R would read it as missing in every export. What is called so already stays.
    """
    if name in _MISSING:
        raise UserError(
            f"{name!r} means a missing value to programs that read exports; choose another name, such as "
            f"{name}1"
        )


def check_description(title: str, note: str) -> None:
    """Raises UserError unless people may call something so and say that of it; "" is nothing."""
    for what, text, most in (("title", title, LONGEST), ("note", note, 500)):
        if not isinstance(text, str) or len(text) > most or not (text == "" or text.isprintable()):
            raise UserError(f"a {what} is up to {most} printable characters on one line")


def check_person(name: str) -> str:
    """A person's name as it is kept: letters of any script and digits, single spaces, and ``-_.'@,()+&#``.

    What draws no letter of its own (control characters, marks that turn the direction of text) and what
    means something to a page or a file system (``<``, ``/``) is in no name.

    Returns:
        The name, composed (Unicode NFC), so that what looks the same is the same.

    Raises:
        UserError: If it is no such name.
    """
    composed = unicodedata.normalize("NFC", name.strip(" "))
    fine = (
        1 <= len(composed) <= LONGEST
        and "  " not in composed
        and composed[0].isalnum()
        and all(c in _IN_PEOPLE or unicodedata.category(c)[0] in "LMN" for c in composed)
    )
    if not fine:
        raise UserError(
            f"a rater's name is 1 to {LONGEST} letters, digits, single spaces or any of -_.'@,()+&# "
            f"and begins with a letter or digit, got {_shown(name)}"
        )
    return composed


def _shown(name: str) -> str:
    return ascii(name[:80])
