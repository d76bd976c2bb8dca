"""What a browser says when somebody answers: one request, which names what was on screen and the page.

A press has a number of its own, by which one that is sent again is known: it is carried out once.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import DecodeError, Meta, Struct, json

_Number = Annotated[int, Meta(gt=0, lt=2**53)]
_Token = Annotated[str, Meta(min_length=1, max_length=64)]
_Value = Annotated[int, Meta(ge=1, le=5)]
_Picture = Annotated[int, Meta(ge=0, lt=10_000)]


class Press(Struct, kw_only=True, forbid_unknown_fields=True, tag_field="press"):
    """What every press has."""

    page: _Token
    """The page at which it was made, as drawn in its markup."""
    id: _Token
    """Made by the browser, another for each press."""


class Rate(Press, tag="rate"):
    """A rating, with the stretch of pictures that was marked: the first, and the one after the last."""

    clip: _Number
    value: _Value
    mark: tuple[_Picture, _Picture] | None = None


class Skip(Press, tag="skip"):
    """No rating."""

    clip: _Number


class _Reason(Press):
    """Why something was skipped."""

    reason: Annotated[str, Meta(max_length=200)]

    def __post_init__(self) -> None:
        if not self.reason.strip() or not self.reason.isprintable():
            raise ValueError("a reason is one line of text")


class Explain(_Reason, tag="reason"):
    """Why the clip was skipped that was skipped last."""

    clip: _Number


class ExplainPair(_Reason, tag="pair reason"):
    """The same of a pair."""

    pair: _Number


class Undo(Press, tag="undo"):
    """Takes back what was said last, which was about this clip."""

    clip: _Number


class Compare(Press, tag="compare"):
    """What is said of a pair; "undo" takes that back."""

    pair: _Number
    answer: Literal["left", "equal", "right", "skip", "undo"]


class Practise(Press, tag="practise"):
    """A rating of a practice clip, or on to the next one, or to the real ones."""

    exercise: Annotated[int, Meta(ge=0, lt=100)]
    do: _Value | Literal["next", "leave"]


class PageGone(Exception):
    """The page at which something was pressed is not open any more."""


_decoder = json.Decoder(Rate | Skip | Explain | ExplainPair | Undo | Compare | Practise)


def read_press(body: bytes) -> Press:
    """A press, from JSON.

    Raises:
        ValueError: If it is none: of an unknown kind, or with fields missing, too many or out of range.
    """
    try:
        return _decoder.decode(body)
    except (DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None
