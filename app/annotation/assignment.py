"""Which clip next, and for whom. Pure: time, chance and the lists of clips come from outside.

A clip is leased to one page at a time, so that two people do not spend their time on the same one.
A lease ends after two minutes without a sign of life, or when the page closes. A few clips are asked
again without anybody knowing: of another person, which shows how far people agree, or of the same one,
which shows how steady they are.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass, field

from onedemo.storage.rating_records import Answered

LEASE_SECONDS = 120.0
MOST_RATERS = 3
"""So many people are asked the same clip at most."""
_MANY = 1000
"""Leases, from which on those that have ended are forgotten."""
REPEAT_AFTER = 15
"""Clips that a person has rated since, before one of them comes again: by then it is forgotten."""


@dataclass(frozen=True, slots=True)
class Ask:
    """A clip put before somebody."""

    clip: int
    kind: str = "fresh"
    """"fresh", or asked again: "shared" (others have rated it), "repeated" (the same person has)."""

    @property
    def repeat(self) -> bool:
        """Whether the answer is a second opinion."""
        return self.kind == "repeated"


@dataclass(frozen=True, slots=True)
class Seat:
    """One page of one person."""

    rater: int
    page: Hashable


def _same_person(one: Hashable, other: Hashable) -> bool:
    return isinstance(one, Seat) and isinstance(other, Seat) and one.rater == other.rater


@dataclass(frozen=True, slots=True)
class Lease:
    """Whose a clip is, and until when."""

    holder: Hashable
    until: float
    """Seconds, on the caller's clock."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Again:
    """How many clips are asked again."""

    shared: float = 0.10
    """Share of the clips that are shown to several people."""
    repeated: float = 0.04
    """Share of the clips that are shown to the same person once more."""

    def __post_init__(self) -> None:
        for name in ("shared", "repeated"):
            if not 0 <= getattr(self, name) <= 0.5:
                raise ValueError(f"the share of {name} clips must be in 0..0.5, got {getattr(self, name)}")

    def draw(self, rng: random.Random) -> str:
        """What is asked next: "fresh", "shared" or "repeated"."""
        kinds = ("fresh", "shared", "repeated")
        return rng.choices(kinds, (1.0, self.shared, self.repeated))[0]


def to_share(answered: Iterable[Answered], rater: int) -> list[int]:
    """Clips that others have rated lately and this rater has not, fewest raters first."""
    raters: dict[int, set[int]] = {}
    for answer in answered:
        if answer.kind == "rate" and not answer.repeat:
            raters.setdefault(answer.clip, set()).add(answer.rater)
    mine = {answer.clip for answer in answered if answer.rater == rater and answer.kind != "undo"}
    clips = [clip for clip, who in raters.items() if clip not in mine and len(who) < MOST_RATERS]
    return sorted(clips, key=lambda clip: len(raters[clip]))


def to_repeat(answered: Sequence[Answered], rater: int) -> list[int]:
    """Clips that this rater has rated once and some time ago, the oldest of the list first."""
    mine = [answer for answer in answered if answer.rater == rater and answer.kind != "undo"]
    done = {answer.clip for answer in mine if answer.repeat}
    firsts = [answer for answer in mine if not answer.repeat][REPEAT_AFTER:]
    return [answer.clip for answer in reversed(firsts) if answer.kind == "rate" and answer.clip not in done]


@dataclass
class Assignment:
    """The leases of one run, safe to use from many threads."""

    again: Again = field(default_factory=Again)
    """How many clips are asked again."""
    lease_seconds: float = LEASE_SECONDS
    """How long a clip stays with a page that shows no sign of life, seconds."""
    _leases: dict[int, Lease] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def take(
        self, holder: Hashable, clips: Iterable[int], *, now: float, avoid: Collection[int] = ()
    ) -> int | None:
        """Leases the first clip to a page that is free, or the page's own already.

        If there is none, one that another page of the same person holds: it may be gone without a word, as
        when a line breaks, and nobody should wait for themselves.

        A lease that the page has already runs on as it was, so an open page that nobody sits at
        does not keep a clip from others.

        Args:
            holder: The page that asks: a ``Seat``, or anything else for a page that is nobody else's.
            clips: To choose from, best first.
            now: Seconds, on the clock of the leases.
            avoid: Clips this page has dealt with, or has in hand.

        Returns:
            The clip, or None if there is none.
        """
        with self._lock:
            if len(self._leases) > _MANY:  # of clips that have gone, at pages that stay
                self._leases = {clip: lease for clip, lease in self._leases.items() if lease.until > now}
            mine = None
            for clip in clips:
                lease = self._leases.get(clip)
                own = lease is not None and lease.holder == holder
                if clip in avoid:
                    continue
                if not (lease is None or own or lease.until <= now):
                    if mine is None and _same_person(lease.holder, holder):
                        mine = clip
                    continue
                if not own:
                    self._leases[clip] = Lease(holder, now + self.lease_seconds)
                return clip
            if mine is not None:
                self._leases[mine] = Lease(holder, now + self.lease_seconds)
            return mine

    def hold(self, holder: Hashable, clip: int, *, now: float) -> None:
        """Leases a clip to a page from now on, whoever held it: it is on that page's screen now."""
        with self._lock:
            self._leases[clip] = Lease(holder, now + self.lease_seconds)

    def beside(self, clips: Collection[int], *, now: float) -> int:
        """How many clips that are not among these are on somebody's screen, or come there next."""
        with self._lock:
            return sum(lease.until > now and clip not in clips for clip, lease in self._leases.items())

    def release(self, holder: Hashable, clip: int | None = None) -> None:
        """Frees a clip of a page, or all of them if none is named."""
        with self._lock:
            for held in [c for c, lease in self._leases.items() if lease.holder == holder]:
                if clip is None or clip == held:
                    del self._leases[held]
