"""How many connections and pages there may be, and which one ends when there are more."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, TypeVar

from onedemo.app.network.rate_limit import MOST_PAGES, MOST_PAGES_EACH

_WANTED_DESCRIPTORS = 16_384

Item = TypeVar("Item", bound=Hashable)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How many connections there may be."""

    strangers: int
    """Without a session; as many more may wait in the lobby."""
    strangers_each: int
    """Of one address."""
    members: int
    """With a session."""
    members_each: int
    """Of one person."""
    pages: int
    """Open pages. Each has a connection of a member, and two more descriptors towards Viser."""

    @classmethod
    def of(cls, descriptors: int, *, addresses_known: bool = True) -> Limits:
        """What a process with so many file descriptors can afford: a quarter is left for everything else.

        Args:
            descriptors: As ``raise_descriptors`` gives it.
            addresses_known: Whether connections come from the people themselves, not from one proxy.
        """
        strangers = min(512, descriptors // 8)
        return cls(
            strangers=strangers,
            strangers_each=min(256, strangers // 2) if addresses_known else strangers,
            members=min(2048, descriptors // 4),
            members_each=8 * MOST_PAGES_EACH,  # a browser has six, and the page's own
            pages=min(MOST_PAGES, descriptors // 8),
        )


def raise_descriptors() -> int:
    """Lets the process have as many file descriptors as it may (up to 16,384); returns how many."""
    try:
        import resource
    except ImportError:  # Windows has no such limit; select() there takes 512
        return 512
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    wanted = _WANTED_DESCRIPTORS if hard == unlimited else min(hard, _WANTED_DESCRIPTORS)
    for most in (wanted, 10_240, 4096):  # some systems name a limit that they do not grant
        if soft != unlimited and soft < most <= wanted:
            with suppress(ValueError, OSError):
                resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
                break
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return _WANTED_DESCRIPTORS if soft == unlimited else soft


class Crowd(Generic[Item]):
    """Items by owner, with a limit in all and for each. A newcomer is always let in; an older one leaves.

    Args:
        most: In all.
        most_each: Of one owner.
    """

    def __init__(self, most: int, most_each: int) -> None:
        self._most, self._most_each = most, most_each
        self._of: dict[Hashable, dict[Item, None]] = {}
        self._count = 0

    def __iter__(self) -> Iterator[Item]:
        for of in tuple(self._of.values()):
            yield from tuple(of)

    def enter(self, whose: Hashable, item: Item) -> Item | None:
        """Lets an item in, as the newest; returns the one that has to leave for it, if any."""
        self.leave(whose, item)
        out = None
        if len(self._of.get(whose, ())) >= self._most_each:
            out = self._oldest(whose)
        elif self._count >= self._most:
            out = self._oldest(max(self._of, key=lambda one: len(self._of[one])))
        self._of.setdefault(whose, {})[item] = None
        self._count += 1
        return out

    def leave(self, whose: Hashable, item: Item) -> None:
        """Takes an item out, if it is in."""
        of = self._of.get(whose, {})
        if item in of:
            del of[item]
            self._count -= 1
            if not of:
                del self._of[whose]

    def _oldest(self, whose: Hashable) -> Item:
        item = next(iter(self._of[whose]))
        self.leave(whose, item)
        return item
