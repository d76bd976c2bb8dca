"""What a benchmark gives: figures with their spread, and how they are taken side by side.

Machines are shared and drift, so two things are compared by turns (A B A B ...), and the ratio is
taken within each turn: what slows the machine for a while slows both.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True, slots=True)
class Figure:
    """One line of a report: a median over repetitions, its spread, and what it should reach."""

    name: str
    """Key in the JSON, such as ``physics_vs_bare``."""
    what: str
    """What was measured, in words."""
    against: str = ""
    """What it is compared with; empty for a figure that stands alone."""
    unit: str
    """"x" for a ratio, else "s", "ms", "%", "MiB", "steps/s"."""
    value: float
    """The median."""
    low: float
    """Least of all repetitions."""
    high: float
    """Greatest of all repetitions."""
    reach: float | None = None
    """What it should reach; None if it is only reported."""
    at_least: bool = True
    """Whether ``reach`` is a lower bound, else an upper one."""
    equal: str = ""
    """How the work of the two sides was made equal, or how the figure was taken."""
    sides: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Every repetition of every side, by the side's name and unit."""

    @property
    def met(self) -> bool | None:
        """Whether the median reaches what it should; None if nothing is asked."""
        if self.reach is None:
            return None
        return self.value >= self.reach if self.at_least else self.value <= self.reach


@dataclass(frozen=True, kw_only=True, slots=True)
class Growth:
    """How a cost grows with a size: one small chart."""

    name: str
    """Key in the JSON."""
    title: str
    x_label: str
    y_label: str
    x: Sequence[float]
    """Sizes, ascending."""
    y: Mapping[str, Sequence[float]]
    """Cost at each size, by the name of the line."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Skipped:
    """A figure that could not be taken here, and why."""

    name: str
    reason: str
    failed: bool = False
    """Whether it should have been taken: an error, not something that this machine lacks."""


Result = Figure | Growth | Skipped


def by_turns(
    sides: Mapping[str, Callable[[], float]], turns: int, *, warm_up: bool = True
) -> dict[str, list[float]]:
    """Measures sides by turns: A B A B ...

    Args:
        sides: Each does one repetition and returns its figure (a rate or a time).
        turns: Repetitions of each.
        warm_up: Run each once before, without counting it.

    Returns:
        The repetitions of each side, in order.
    """
    if warm_up:
        for measure in sides.values():
            measure()
    taken: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(turns):
        for name, measure in sides.items():
            taken[name].append(measure())
    return taken


def ratio(
    name: str, what: str, *, ours: Sequence[float], theirs: Sequence[float], against: str,
    reach: float | None, equal: str, unit: str, at_least: bool = True,
) -> Figure:  # fmt: skip
    """Our figure over theirs, turn by turn.

    Args:
        name: Key in the JSON.
        what: What was measured.
        ours: One figure per turn.
        theirs: One figure per turn, as many.
        against: What theirs is.
        reach: What the ratio should reach.
        equal: How the work was made equal.
        unit: Of both sides, for the record.
        at_least: Whether ``reach`` is a lower bound.

    Raises:
        ValueError: If the sides have different numbers of turns, or none.
    """
    if len(ours) != len(theirs) or not ours:
        raise ValueError(f"{name}: {len(ours)} turns of ours, {len(theirs)} of theirs")
    pairs = zip(ours, theirs, strict=True)
    ratios = [a / b for a, b in pairs]
    return Figure(
        name=name, what=what, against=against, unit="x", value=statistics.median(ratios), low=min(ratios),
        high=max(ratios), reach=reach, at_least=at_least, equal=equal,
        sides={f"onedemo, {unit}": list(ours), f"{against}, {unit}": list(theirs)},
    )  # fmt: skip


def single(
    name: str, what: str, values: Sequence[float], *, unit: str, reach: float | None = None,
    at_least: bool = False, how: str = "",
) -> Figure:  # fmt: skip
    """A figure that stands alone: median and spread of its repetitions.

    Raises:
        ValueError: If there is no repetition.
    """
    if not values:
        raise ValueError(f"{name}: no repetition")
    return Figure(
        name=name, what=what, unit=unit, value=statistics.median(values), low=min(values), high=max(values),
        reach=reach, at_least=at_least, equal=how, sides={f"onedemo, {unit}": list(values)},
    )  # fmt: skip
