"""What a browser may say to the page: three kinds of messages, with the fields they have and no other.

Everything else that Viser would understand (uploads, a public tunnel, changes to any property of any
element, drawings it keeps and repeats to all) is not passed on.
"""

from __future__ import annotations

import math
from typing import Annotated

from msgspec import Meta, MsgspecError, Struct, msgpack

_Id = Annotated[str, Meta(min_length=1, max_length=64)]
_Text = Annotated[str, Meta(max_length=2000)]
_Pixels = Annotated[int, Meta(ge=0, le=100_000)]
_Point = tuple[float, float, float]


class _Known(Struct, forbid_unknown_fields=True, tag_field="type"):
    pass


class ViewerCameraMessage(_Known, tag="ViewerCameraMessage"):
    """Where somebody looks from."""

    wxyz: tuple[float, float, float, float]
    position: _Point
    fov: float
    near: float
    far: float
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Point
    up_direction: _Point


class Value(Struct, forbid_unknown_fields=True):
    """The new value of an input; no other of its properties."""

    value: bool | int | float | _Text


class GuiUpdateMessage(_Known, tag="GuiUpdateMessage"):
    """An input was changed or a button pressed."""

    uuid: _Id
    updates: Value


class CommandTriggerMessage(_Known, tag="CommandTriggerMessage"):
    """A key was pressed."""

    uuid: _Id


_decoder = msgpack.Decoder(ViewerCameraMessage | GuiUpdateMessage | CommandTriggerMessage)


def known(data: bytes) -> bool:
    """Whether a message may be passed on: of a known kind, with its fields, each in its range.

    Args:
        data: As the browser sent it, MessagePack.
    """
    try:
        message = _decoder.decode(data)
    except (MsgspecError, UnicodeDecodeError, ValueError, RecursionError, OverflowError):
        return False
    if isinstance(message, ViewerCameraMessage):
        lengths = (message.fov, message.near, message.far)
        numbers = (*message.wxyz, *message.position, *message.look_at, *message.up_direction, *lengths)
        return all(map(math.isfinite, numbers))
    if isinstance(message, GuiUpdateMessage):
        value = message.updates.value
        return not isinstance(value, float) or math.isfinite(value)
    return True
