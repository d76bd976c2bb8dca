"""What raters get wrong: error models on top of a rater that measures a distance.

Each is a pure function of a ``Look``, one clip as the rater sees it, and its strength; a look ends in
the chances of the five classes, from which the rating is drawn. The models follow the simulated
teachers of B-Pref (Lee et al. 2021, section 3), from pairs carried over to ratings.

With several, the order is that of ``ERRORS``: what the rater sees, how strict it is, what it presses.

Shapes: W control steps, four thresholds, five classes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from onedemo.errors import UserError

CLASSES = np.arange(1, 6)
BOUNDARIES = (4.5, 3.5, 2.5, 1.5)
"""Levels (see ``Look.level``) that the four thresholds stand for."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """One clip in the eyes of a rater."""

    distances: np.ndarray
    """How far the robot is from the demo at each step, (W,)."""
    thresholds: np.ndarray
    """Mean distances beyond which one point is taken off, (4,), ascending."""
    progress: float = 0.0
    """Share of its ratings that the rater has given before this one, 0 at the first, 1 at the last."""
    normal: float = 0.0
    """A standard normal number drawn for this rating."""
    weights: np.ndarray | None = None
    """What each step counts, (W,), any scale; None: all the same."""
    odds: np.ndarray | None = None
    """Chances of the classes 1..5, (5,); None: the class of ``level`` is certain."""
    declined: bool = False
    """The rater would rather not say."""

    @property
    def width(self) -> float:
        """Mean width of a class between the thresholds, units of distance."""
        return float(self.thresholds[-1] - self.thresholds[0]) / (len(self.thresholds) - 1)

    @property
    def distance(self) -> float:
        """The mean distance of the clip."""
        return float(np.average(self.distances, weights=self.weights))

    @property
    def level(self) -> float:
        """The rating before it is rounded to a class, 0.5..5.5.

        Piecewise linear in the distance: 4.5, 3.5, 2.5 and 1.5 at the thresholds, a class ``width`` wide
        beyond the first and the last.
        """
        t, width = self.thresholds, self.width
        return float(np.interp(self.distance, [t[0] - width, *t, t[-1] + width], [5.5, *BOUNDARIES, 0.5]))

    @property
    def chances(self) -> np.ndarray:
        """Chances of the classes 1..5, (5,)."""
        if self.odds is not None:
            return self.odds
        return (5 - np.sum(self.distance > self.thresholds) == CLASSES).astype(float)


def myopic(look: Look, gamma: float) -> Look:
    """The end of a clip counts most: step t of W weighs gamma^(W - 1 - t). Default 0.9: the last 80 ms."""
    return replace(look, weights=gamma ** np.arange(len(look.distances))[::-1].astype(float))


def harsh(look: Look, factor: float) -> Look:
    """Takes points off sooner: all thresholds times the factor, 0.8 by default."""
    return replace(look, thresholds=look.thresholds * factor)


def kind(look: Look, factor: float) -> Look:
    """Takes points off later: all thresholds times the factor, 1.25 by default."""
    return replace(look, thresholds=look.thresholds * factor)


def drift(look: Look, factor: float) -> Look:
    """From kind to harsh: thresholds times f at the first rating, 1 / f at the last, linear in between.

    The factor of rating k of n (from 0) is f + (1/f - f) k / (n - 1), f = 1.25 by default.
    """
    return replace(look, thresholds=look.thresholds * (factor + (1 / factor - factor) * look.progress))


def jitter(look: Look, spread: float) -> Look:
    """Boundaries move from rating to rating, all four by the same normal number.

    Its standard deviation is ``spread``, 0.25 by default, times the mean width of a class: a clip at a
    boundary gets either rating as often, one in the middle of a class another one time in twenty.
    """
    return replace(look, thresholds=look.thresholds + spread * look.width * look.normal)


def noisy(look: Look, beta: float) -> Look:
    """Boltzmann rational: p(k) ~ exp(-beta (level - k)^2), the squared distance from a class's centre.

    beta is 2 by default: a clip in the middle of class 3 gets a 3 with 78 %. Without bound it is the
    rater without noise, at 0 every rating is as likely.
    """
    energy = beta * (look.level - CLASSES) ** 2
    odds = np.exp(energy.min() - energy)
    return replace(look, odds=odds / odds.sum())


def mistake(look: Look, chance: float) -> Look:
    """A wrong key, with the chance given (0.1 by default): each of the four other ratings as likely.

    B-Pref flips the answer. Of five classes a slip of the finger hits any; ratings that are off by one
    are what ``noisy`` and ``jitter`` give.
    """
    return replace(look, odds=(1 - chance) * look.chances + chance * (1 - look.chances) / 4)


def skip(look: Look, share: float) -> Look:
    """Declines the clips it is least sure of: level nearer to a boundary than ``share`` / 2.

    If levels were spread evenly, that were the share (0.1 by default) of all clips. No chance is in it.
    """
    return replace(look, declined=bool(np.abs(look.level - np.array(BOUNDARIES)).min() < share / 2))


@dataclass(frozen=True, kw_only=True, slots=True)
class ErrorModel:
    """One kind of error and how strong it may be."""

    apply: Callable[[Look, float], Look]
    default: float
    low: float
    high: float


ERRORS = {
    "myopic": ErrorModel(apply=myopic, default=0.9, low=0.01, high=1.0),
    "harsh": ErrorModel(apply=harsh, default=0.8, low=0.1, high=1.0),
    "kind": ErrorModel(apply=kind, default=1.25, low=1.0, high=10.0),
    "drift": ErrorModel(apply=drift, default=1.25, low=0.1, high=10.0),
    "jitter": ErrorModel(apply=jitter, default=0.25, low=0.0, high=2.0),
    "noisy": ErrorModel(apply=noisy, default=2.0, low=0.0, high=1e6),
    "mistake": ErrorModel(apply=mistake, default=0.1, low=0.0, high=1.0),
    "skip": ErrorModel(apply=skip, default=0.1, low=0.0, high=0.9),
}
"""All error models, in the order in which they act."""

Errors = tuple[tuple[ErrorModel, float], ...]
"""Error models and their strengths, in the order in which they act."""


def parse_errors(parts: Sequence[str], rater: str) -> tuple[Errors, int | None]:
    """Error models from their names: ``["mistake:0.2", "jitter", "seed:3"]``.

    Args:
        parts: Each a key of ``ERRORS``, with ``:`` and its strength if not the default, or ``seed:N``.
        rater: The whole name they are from, for messages.

    Returns:
        The models in the order in which they act, and the seed if one is given.

    Raises:
        UserError: If a name is unknown or given twice, or a strength is not in its range.
    """
    strengths: dict[str, float] = {}
    seed: int | None = None
    for part in parts:
        name, colon, text = part.partition(":")
        if name in strengths or (name == "seed" and seed is not None):
            raise UserError(f"rater {rater!r}: {name!r} is given twice")
        if name == "seed":
            if not text.isdecimal():
                raise UserError(f"rater {rater!r}: seed must be a whole number, such as seed:3, got {part!r}")
            seed = int(text)
        elif name in ERRORS:
            model = ERRORS[name]
            strengths[name] = _strength(rater, name, text, model) if colon else model.default
        else:
            raise UserError(
                f"rater {rater!r}: unknown error model {name!r}; choose from: {', '.join(ERRORS)}, seed"
            )
    return tuple((model, strengths[name]) for name, model in ERRORS.items() if name in strengths), seed


def _strength(rater: str, name: str, text: str, model: ErrorModel) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not model.low <= value <= model.high:
        raise UserError(
            f"rater {rater!r}: {name} takes a number from {model.low:g} to {model.high:g}, got {text!r}"
        )
    return value
