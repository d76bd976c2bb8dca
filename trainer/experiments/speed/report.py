"""What the speed benchmark gives, as a table in the terminal, as JSON, and as a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from onedemo.experiments.report.blocks import (
    Block,
    Bullets,
    Chart,
    Document,
    Heading,
    Line,
    Table,
    Text,
    number,
)
from onedemo.experiments.report.document import about, text_table, write
from onedemo.experiments.speed.figures import Figure, Growth, Result, Skipped


def as_json(results: Sequence[Result], *, command: str, seconds: float) -> dict[str, Any]:
    """Everything that was measured, ready for ``json.dump``.

    Args:
        results: Of all parts.
        command: What was typed.
        seconds: How long it took.

    Returns:
        ``ratios`` (name to median, those with unit "x"), ``figures`` (name to every detail),
        ``growth``, ``skipped`` (name to reason), and what it was measured on.
    """
    figures = [result for result in results if isinstance(result, Figure)]
    return {
        **about(command=command, seconds=seconds),
        "ratios": {f.name: _round(f.value) for f in figures if f.unit == "x"},
        "figures": {f.name: {**asdict(f), "met": f.met} for f in figures},
        "growth": {g.name: asdict(g) for g in results if isinstance(g, Growth)},
        "skipped": {s.name: s.reason for s in results if isinstance(s, Skipped)},
    }


def table(results: Sequence[Result]) -> str:
    """The figures for a terminal, one line each; what was skipped at the end."""
    rows = [
        (_label(figure), _value(figure.value, figure.unit), _spread(figure), *_reach(figure))
        for figure in results
        if isinstance(figure, Figure)
    ]
    lines = [text_table(("", "median", "least - most", "reach", ""), rows)]
    lines += [f"{skip.name}: {_why(skip)}" for skip in results if isinstance(skip, Skipped)]
    return "\n".join(lines)


def write_report(out: Path, title: str, results: Sequence[Result], about: dict[str, Any]) -> None:
    """Writes ``report.md``, ``results.json`` and one chart for each growth.

    Args:
        out: Directory; made if missing.
        title: Of the report.
        results: What was measured.
        about: As ``as_json`` gives.

    Raises:
        ImportError: If matplotlib (extra ``[bench]``) is missing and there is a growth to draw.
    """
    write(Document(title=title, about=about, blocks=_blocks(results)), out)


def _blocks(results: Sequence[Result]) -> list[Block]:
    figures = [result for result in results if isinstance(result, Figure)]
    rows = [(f.what, f.against, _value(f.value, f.unit), _spread(f), *_reach(f)) for f in figures]
    notes = [f"**{f.name}**: {f.equal}." for f in figures if f.equal]
    notes += [f"**{s.name}**: {_why(s)}." for s in results if isinstance(s, Skipped)]
    return [
        Text("Ratios are medians over turns A B A B ...; least and most of all turns show the spread."),
        Table(heads=("what", "against", "median", "least to most", "reach", ""), rows=rows),
        *(_chart(growth) for growth in results if isinstance(growth, Growth)),
        Heading("How the work was made equal, and how figures were taken"),
        Bullets(notes),
    ]


def _chart(growth: Growth) -> Chart:
    values = [value for line in growth.y.values() for value in line]
    return Chart(
        name=growth.name,
        title=growth.title,
        x_label=growth.x_label,
        y_label=growth.y_label,
        lines=[Line(label=name, x=growth.x, y=line, marks=True) for name, line in growth.y.items()],
        log_x=True,
        log_y=max(values) > 10 * min(values),  # less than a decade: a logarithm would make much of little
        wide=False,
    )


def _why(skipped: Skipped) -> str:
    return f"{'failed' if skipped.failed else 'not run'}, {skipped.reason}"


def _label(figure: Figure) -> str:
    return f"{figure.name} ({figure.against})" if figure.against else figure.name


def _value(value: float, unit: str) -> str:
    return f"{number(value)} {unit}"


def _spread(figure: Figure) -> str:
    return f"{number(figure.low)} - {number(figure.high)}"


def _reach(figure: Figure) -> tuple[str, str]:
    if figure.reach is None:
        return "", ""
    sign = ">=" if figure.at_least else "<="
    return f"{sign} {figure.reach:g}", "met" if figure.met else "missed"


def _round(value: float) -> float:
    """Three figures that count."""
    return float(f"{value:.3g}") if abs(value) < 1000 else round(value)
