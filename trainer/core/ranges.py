"""Checks of settings, in sentences that name the setting, what is right and what was given."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def one_of(key: str, value: str, choices: Iterable[str]) -> None:
    """Raises ValueError if the value of the setting ``key`` is none of the choices."""
    if value not in choices:
        raise ValueError(f"{key} must be one of {', '.join(choices)}, got {value!r}")


def at_least(section: str, settings: Any, **minima: int) -> None:
    """Raises ValueError if a setting of a section is below its minimum."""
    for name, minimum in minima.items():
        if getattr(settings, name) < minimum:
            raise ValueError(f"{section}.{name} must be at least {minimum}, got {getattr(settings, name)}")
