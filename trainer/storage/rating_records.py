"""Ratings as plain values: the columns of their exports, and what ``onedemo.storage.ratings`` returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from onedemo.types import Segment

RATING_COLUMNS = (
    "id", "clip_id", "run", "demo", "rater", "value", "stage", "iteration", "created_at",
    "latency_ms", "snapshot", "predicted", "demo_step", "steps", "repeat", "mark_start", "mark_end",
    "choice", "score", "left_out",
)  # fmt: skip
"""Columns of the view ``ratings``, in order."""
SKIP_COLUMNS = (
    "id", "clip_id", "run", "demo", "rater", "reason", "stage", "iteration", "created_at", "latency_ms",
    "demo_step", "steps", "repeat", "snapshot", "predicted",
)  # fmt: skip
"""Of a skip, in order."""
HISTORY_COLUMNS = (
    "id", "clip_id", "pair_id", "run", "rater", "kind", "value", "repeat", "mark_start", "mark_end",
    "reason", "snapshot", "predicted", "latency_ms", "created_at", "by", "withdrawn",
)  # fmt: skip
"""Of an event that does not hold any more, or is about a rater, in order."""
LOOKED_BACK = 400
"""Events of a rater among which what may be taken back is looked for: every open page asks twice a second."""
MOST_REASON = 200
"""Characters of the reason for a skip, or why a rating was withdrawn."""


class Rating(NamedTuple):
    """One rating that holds: a row of the training set."""

    event: int
    clip: int
    demo_step: int
    value: int
    mark: tuple[int, int] | None
    """Where it goes wrong: first control step of the clip, step after the last; None: not said."""


class Answered(NamedTuple):
    """The last word of a rater on a clip."""

    clip: int
    rater: int
    kind: str
    """"rate", "skip" or "undo"."""
    repeat: bool
    """Whether it is the rater's second opinion."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RatedSegment:
    """One rating that holds, with what was rated: what a predictor is fitted on."""

    event: int
    demo_step: int
    segment: Segment
    value: int
    mark: tuple[int, int] | None = None
    """Where it goes wrong: first step, step after the last."""
    clip: int = 0
    """Its number; 0 where it has none."""


class LastAnswer(NamedTuple):
    """What a rater said last that holds: what undo takes back."""

    clip: int
    repeat: bool
    value: int | None
    """None: it was skipped."""
    mark: tuple[int, int] | None
    """As ``RatedSegment.mark``."""


class Given(NamedTuple):
    """A rating that holds, or that a researcher withdrew."""

    event: int
    clip: int
    rater: str
    value: int
    repeat: bool
    created_at: str
    withdrawn: str | None
    """Why it was withdrawn; None: it holds."""
    by: str | None
    """Who withdrew it; None: the command line, or it holds."""


class AlreadyAnswered(ValueError):
    """The rater's answer to a clip or pair holds already."""
