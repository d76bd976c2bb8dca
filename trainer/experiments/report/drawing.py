"""Charts of reports, as SVG. The same chart gives the same bytes.

Text stays text, in the fonts of the page it is shown on. Lines are named where they end, in their colour,
so that nobody has to look from a legend to a line and back; a narrow chart has its names underneath.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from onedemo.experiments.report.blocks import Bars, Chart, Line, number

COLOURS = ("#2f5dc4", "#d97a1d", "#0d8a72", "#9a4fb5", "#c23b55", "#5b7f1f", "#1f7fa8", "#8a6a3a")
MUTED = "#8a94a3"
"""For what is only there to compare with."""

_INK, _QUIET, _GRID = "#1c2430", "#566173", "#e3e7ed"
_WIDE, _HALF = (7.6, 4.1), (4.3, 3.3)
"""Inches of 72 points."""
_MOST_TICKS = 6
_FONT = "DejaVu Sans"
"""Comes with matplotlib, so that a chart is laid out alike everywhere; it is wider than what is shown."""
_PAGE_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, Helvetica, Arial, sans-serif"
_STYLE: Any = {
    "font.family": [_FONT],
    "font.size": 9,
    "svg.fonttype": "none",
    "axes.edgecolor": "#c6cdd8",
    "axes.labelcolor": _QUIET,
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlepad": 12,
    "axes.titlecolor": _INK,
    "grid.color": _GRID,
    "grid.linewidth": 0.8,
    "xtick.color": "#c6cdd8",
    "ytick.color": "#c6cdd8",
    "xtick.labelcolor": _QUIET,
    "ytick.labelcolor": _QUIET,
    "ytick.major.size": 0,
    "lines.solid_capstyle": "round",
    "lines.solid_joinstyle": "round",
}


def draw(chart: Chart | Bars) -> bytes:
    """The chart as SVG."""
    with matplotlib.rc_context(_STYLE | {"svg.hashsalt": chart.name}):
        figure = _bars(chart) if isinstance(chart, Bars) else _chart(chart)
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = re.sub(f"['\"]?{_FONT}['\"]?", _PAGE_FONTS, file.getvalue().decode())
    return text.encode()


def _chart(chart: Chart) -> Figure:
    size = _WIDE if chart.wide else _HALF
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    named = []
    for line, colour in zip(chart.lines, _colours(chart.lines), strict=True):
        _line(axes, line, colour)
        named.append((line.label, float(line.y[-1]), colour))
    _scales(axes, chart)
    for reference in chart.references:
        if reference.x is None:
            axes.axhline(reference.y, color=_QUIET, linewidth=1, linestyle=(0, (4, 3)), zorder=1.5)
            named.append((reference.label, reference.y, _QUIET))
        else:
            axes.plot(reference.x, reference.y, "D", color=_INK, markersize=6, zorder=5, clip_on=False)
            _name_point(axes, reference.label, reference.x, reference.y)
    axes.set_title(chart.title, fontsize=11 if chart.wide else 10)
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    axes.grid(axis="y")
    if len(named) > 1 and chart.wide:
        _name_ends(axes, named, height=size[1] * 72 - 75)
    elif len(named) > 1:
        keys = [Line2D([], [], color=colour, linewidth=2) for _, _, colour in named]
        labels = [label for label, _, _ in named]
        figure.legend(
            keys, labels, loc="outside lower left", ncols=1 + (max(map(len, labels)) < 22), frameon=False,
            fontsize=8.5, handlelength=1, labelcolor="linecolor",
        )  # fmt: skip
    return figure


def _line(axes: Any, line: Line, colour: str) -> None:
    if line.low is not None and line.high is not None:
        axes.fill_between(line.x, line.low, line.high, color=colour, alpha=0.13, linewidth=0)
    for each in line.each:
        axes.plot(line.x, each, color=colour, linewidth=0.7, alpha=0.4)
    style = {"linestyle": (0, (4, 2.5))} if line.dashed else {}
    marks = {"marker": "o", "markersize": 4.5, "markeredgecolor": "white", "markeredgewidth": 0.8}
    axes.plot(line.x, line.y, color=colour, linewidth=2, zorder=3, **style, **(marks if line.marks else {}))


def _scales(axes: Any, chart: Chart) -> None:
    xs = sorted({float(x) for line in chart.lines for x in line.x})
    if chart.log_x:
        axes.set_xscale("log")
        if len(xs) <= 3 * _MOST_TICKS:  # sizes that somebody chose
            xs = xs[:: -(-len(xs) // _MOST_TICKS)]
            axes.set_xticks(xs)
        axes.xaxis.set_minor_locator(NullLocator())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(_MOST_TICKS, steps=[1, 2, 2.5, 5, 10]))
        axes.margins(x=0.01)
    if chart.log_y:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(numticks=_MOST_TICKS))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        axes.yaxis.set_major_locator(MaxNLocator(_MOST_TICKS, steps=[1, 2, 2.5, 5, 10]))
        ys = [reference.y for reference in chart.references]
        low, high = min([axes.dataLim.y0, *ys]), max([axes.dataLim.y1, *ys])
        room = 0.06 * (high - low) or 1.0
        axes.set_ylim(0 if low >= 0 else low - room, high + room)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))


def _name_point(axes: Any, label: str, x: float, y: float) -> None:
    across = axes.transLimits.transform(axes.transScale.transform((x, y)))[0]
    side = -1 if across > 0.6 else 1
    axes.annotate(
        label, (x, y), xytext=(9 * side, 0), textcoords="offset points", fontsize=8.5, color=_INK,
        ha="left" if side > 0 else "right", va="center", zorder=6,
    )  # fmt: skip


def _name_ends(axes: Any, named: Sequence[tuple[str, float, str]], *, height: float) -> None:
    """Names at the right edge, as near to where the lines end as they can be without touching."""
    to_axes = axes.transScale + axes.transLimits
    ends = np.array([to_axes.transform((axes.get_xlim()[1], y))[1] for _, y, _ in named])
    order = np.argsort(ends, kind="stable")
    places = _apart(np.clip(ends[order], 0, 1), 12.5 / height)
    for index, place in zip(order, places, strict=True):
        label, _, colour = named[index]
        axes.annotate(
            label, (1, place), xycoords="axes fraction", xytext=(7, 0), textcoords="offset points",
            color=colour, va="center", ha="left", fontsize=8.5, annotation_clip=False,
        )  # fmt: skip


def _apart(places: np.ndarray, gap: float) -> np.ndarray:
    """Places, ascending, moved as little as keeps them a gap apart: groups that touch move as one."""
    groups: list[list[float]] = []  # of places less their rank's share of the gap: these must not descend
    for rank, place in enumerate(places):
        groups.append([place - rank * gap])
        while len(groups) > 1 and np.mean(groups[-2]) > np.mean(groups[-1]):
            last = groups.pop()
            groups[-1] += last
    level = np.concatenate([np.full(len(group), np.mean(group)) for group in groups])
    return level + gap * np.arange(len(places))


def _bars(bars: Bars) -> Figure:
    figure = Figure(figsize=(_WIDE[0], 1.2 + 0.34 * len(bars.labels)), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(len(bars.labels))[::-1]
    colours = [COLOURS[0] if label in bars.strong or not bars.strong else "#a9b3c2" for label in bars.labels]
    values = [0.0 if value is None else value for value in bars.values]
    axes.barh(rows, values, height=0.62, color=colours)
    for row, dots in zip(rows, bars.each, strict=False):
        axes.plot(
            dots, np.full(len(dots), row), "o", color=_INK, markersize=3.6, markeredgecolor="white",
            markeredgewidth=0.7, clip_on=False,
        )  # fmt: skip
    everything = [0.0, *values, *(dot for dots in bars.each for dot in dots)]
    least, most = min(everything), max(everything)
    if bars.reference is not None:
        most = max(most, bars.reference.y)
        axes.axvline(bars.reference.y, color=_QUIET, linewidth=1, linestyle=(0, (4, 3)))
        axes.annotate(
            bars.reference.label, (bars.reference.y, 1), xycoords=("data", "axes fraction"), xytext=(0, 2),
            textcoords="offset points", fontsize=8.5, color=_QUIET, ha="center", va="bottom",
        )  # fmt: skip
    for row, value in zip(rows, bars.values, strict=True):
        axes.annotate(
            "not run" if value is None else number(value), (1, row), xycoords=("axes fraction", "data"),
            xytext=(8, 0), textcoords="offset points", fontsize=8.5, va="center",
            color=_QUIET if value is None else _INK, annotation_clip=False,
        )  # fmt: skip
    axes.set_xlim(1.03 * least, 1.03 * (most or 1.0))
    axes.set_yticks(rows, labels=list(bars.labels))
    axes.tick_params(axis="y", labelcolor=_INK)
    axes.xaxis.set_major_locator(MaxNLocator(_MOST_TICKS, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    axes.set_title(bars.title, pad=20 if bars.reference is not None else 12)
    axes.set_xlabel(bars.x_label)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    return figure


def _colours(lines: Sequence[Line]) -> list[str]:
    free = iter([colour for colour in COLOURS if colour not in {line.colour for line in lines}] * len(lines))
    return [line.colour or next(free, MUTED) for line in lines]


def _short(value: float) -> str:
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"
