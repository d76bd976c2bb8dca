"""What a report is made of. Texts and cells may hold simple Markdown: **bold**, `code`, [links](target)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

Cell = str | float | None


class Numbers(Protocol):
    """A sequence of numbers: a list, or an array of one dimension."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: Any, /) -> Any: ...


@dataclass(frozen=True, slots=True)
class Heading:
    """Of a section."""

    text: str


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True, slots=True)
class Bullets:
    """A list."""

    items: Sequence[str]


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """Rows of texts and numbers; a number is shown with three figures that count, None as nothing."""

    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    title: str = ""
    notes: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Line:
    """One line of a chart."""

    label: str
    x: Numbers
    y: Numbers
    low: Numbers | None = None
    """Edges of a shaded band; each as long as x."""
    high: Numbers | None = None
    each: Sequence[Numbers] | Numbers = ()
    """Thin lines beside it, such as one for each seed; each as long as x."""
    colour: str = ""
    """Of ``onedemo.experiments.report.drawing.COLOURS``, or any other; by the order of lines if empty."""
    dashed: bool = False
    marks: bool = False
    """A dot at each point."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Reference:
    """Something to compare with: a point, or a level where x is None."""

    label: str
    y: float
    x: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Chart:
    """Lines over a common axis."""

    name: str
    """Of the file, ``<name>.svg``."""
    title: str
    x_label: str
    """With its unit."""
    y_label: str
    lines: Sequence[Line]
    references: Sequence[Reference] = ()
    log_x: bool = False
    log_y: bool = False
    wide: bool = True
    """As wide as the page, else half."""
    note: str = ""
    """Under it: what band and thin lines are."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Bars:
    """One figure of several things, as bars that lie, with a dot for each seed."""

    name: str
    title: str
    x_label: str
    """With its unit."""
    labels: Sequence[str]
    values: Sequence[float | None]
    """None where there is no figure."""
    each: Sequence[Sequence[float]] = ()
    """Dots on each bar."""
    reference: Reference | None = None
    """Its y is drawn across all bars."""
    strong: Sequence[str] = ()
    """Labels of bars in the leading colour; all if empty."""
    note: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """A picture, such as a strip of frames or a moving WebP."""

    name: str
    """Of the file, with its ending."""
    data: bytes
    alt: str
    """What is to be seen, for those who cannot."""
    note: str = ""
    wide: bool = True


Figure = Chart | Bars | Picture
Block = Heading | Text | Bullets | Table | Figure


@dataclass(frozen=True, kw_only=True, slots=True)
class Document:
    """A report."""

    title: str
    blocks: Sequence[Block]
    about: Mapping[str, Any] = field(default_factory=dict)
    """What was typed, and when, where and with what it was run: see ``about``."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """Everything in figures, ready for JSON."""

    @property
    def facts(self) -> str:
        """What it says of itself, in one sentence; empty if nothing is known."""
        about = self.about
        if not about:
            return ""
        machine = about["machine"]
        packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
        source = f" at commit {about['commit']}" if about["commit"] else ""
        seconds = f"{about['seconds']:,.0f} s " if "seconds" in about else ""
        methods = ", ".join(f"{kind} {number}" for kind, number in about.get("method_versions", {}).items())
        return (
            f"`{about['command']}`, onedemo {about['version']}{source}, {about['date'][:10]}, "
            f"{seconds}on {machine['cores']} cores ({machine['processor']}), "
            f"Python {machine['python']}, {packages}"
            f"{f'; method versions: {methods}' if methods else ''}."
        )


def number(value: float) -> str:
    """Three figures that count, and all those before the point; a dash for what is not finite."""
    if not math.isfinite(value):
        return "–"
    if abs(value) >= 1000:
        return f"{round(value):,}"
    return f"{float(f'{value:.3g}'):g}"


def shown(cell: Cell) -> str:
    """A cell as text."""
    if cell is None:
        return ""
    return cell if isinstance(cell, str) else number(cell)


_NUMBER = re.compile(r"(?:[<>]=|[<>≤≥≈±])?\s*[-+−]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?(?:\s|%|$)")
_NOTHING = ("", "–", "not run", "failed")


def numeric_columns(heads: Sequence[str], rows: Sequence[Sequence[Cell]]) -> list[bool]:
    """Which columns hold numbers, and are set to the right."""
    columns = [[bare(shown(row[i])) for row in rows] for i in range(len(heads))]
    something = [[cell for cell in column if cell not in _NOTHING] for column in columns]
    return [bool(cells) and all(_NUMBER.match(cell) for cell in cells) for cells in something]


def bare(text: str) -> str:
    """A text without its marks."""
    return re.sub(r"\*\*|`", "", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text))


def file_name(figure: Figure) -> str:
    """Of a chart or picture, beside the report."""
    return figure.name if isinstance(figure, Picture) else f"{figure.name}.svg"


def alt_text(figure: Figure) -> str:
    """What is to be seen."""
    return figure.alt if isinstance(figure, Picture) else figure.title
