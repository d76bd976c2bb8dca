"""Results as a table in the terminal, as JSON, and as a report in Markdown and HTML with charts."""

from __future__ import annotations

import html
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from trainer.bench.figures import Figure, Growth, Result, Skipped
from trainer.files import write_atomic
from trainer.priority import cores
from trainer.runs import program_version

_PACKAGES = (
    "mujoco", "gymnasium", "torch", "numpy", "viser", "opencv-python-headless", "envpool", "sb3-contrib",
    "mujoco-warp",
)  # fmt: skip


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
        "command": command,
        "version": program_version(),
        "seconds": round(seconds, 1),
        "machine": machine(),
        "ratios": {f.name: _round(f.value) for f in figures if f.unit == "x"},
        "figures": {f.name: {**asdict(f), "met": f.met} for f in figures},
        "growth": {g.name: asdict(g) for g in results if isinstance(g, Growth)},
        "skipped": {s.name: s.reason for s in results if isinstance(s, Skipped)},
    }


def machine() -> dict[str, Any]:
    """What the figures were taken on: cores, processor, versions."""
    packages = {}
    for name in _PACKAGES:
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "cores": cores(),
        "processor": _processor(),
        "python": platform.python_version(),
        "packages": packages,
    }


def table(results: Sequence[Result]) -> str:
    """The figures for a terminal, one line each; what was skipped at the end."""
    rows = [("", "median", "least - most", "reach", "")]
    for figure in results:
        if isinstance(figure, Figure):
            rows.append((_label(figure), _value(figure.value, figure.unit), _spread(figure), *_reach(figure)))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines += [f"{skip.name}: {_why(skip)}" for skip in results if isinstance(skip, Skipped)]
    return "\n".join(lines)


def write_report(out: Path, title: str, results: Sequence[Result], about: dict[str, Any]) -> None:
    """Writes ``report.md``, ``report.html``, ``results.json`` and one chart for each growth.

    Args:
        out: Directory; made if missing.
        title: Of the report.
        results: What was measured.
        about: As ``as_json`` gives.

    Raises:
        ImportError: If matplotlib (extra ``[bench]``) is missing and there is a growth to draw.
    """
    out.mkdir(parents=True, exist_ok=True)
    charts = [(growth, f"{growth.name}.svg") for growth in results if isinstance(growth, Growth)]
    for growth, file in charts:
        _draw(growth, out / file)
    write_atomic(out / "results.json", (json.dumps(about, indent=1) + "\n").encode())
    write_atomic(out / "report.md", _markdown(title, results, about, charts).encode())
    write_atomic(out / "report.html", _html(title, results, about, charts).encode())


_Charts = Sequence[tuple[Growth, str]]
_HEADS = ("what", "against", "median", "least to most", "reach", "")


def _rows(results: Sequence[Result]) -> list[tuple[str, ...]]:
    return [
        (f.what, f.against, _value(f.value, f.unit), _spread(f), *_reach(f))
        for f in results
        if isinstance(f, Figure)
    ]


def _markdown(title: str, results: Sequence[Result], about: dict[str, Any], charts: _Charts) -> str:
    lines = [
        f"# {title}",
        "",
        _facts(about),
        "",
        "| " + " | ".join(_HEADS) + " |",
        "|---" * len(_HEADS) + "|",
    ]
    lines += ["| " + " | ".join(row) + " |" for row in _rows(results)]
    lines += ["", "How the work was made equal, and how figures were taken:", ""]
    lines += [f"- **{f.name}**: {f.equal}." for f in results if isinstance(f, Figure) and f.equal]
    lines += ["", *(f"- **{s.name}**: {_why(s)}." for s in results if isinstance(s, Skipped)), ""]
    lines += [f"![{growth.title}]({file})" for growth, file in charts]
    return "\n".join(lines) + "\n"


def _html(title: str, results: Sequence[Result], about: dict[str, Any], charts: _Charts) -> str:
    def cells(tag: str, row: Sequence[str]) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row) + "</tr>"

    notes = {f.name: f.equal for f in results if isinstance(f, Figure) and f.equal}
    notes |= {s.name: f"{_why(s)}" for s in results if isinstance(s, Skipped)}
    items = "".join(f"<li><b>{name}</b>: {html.escape(note)}" for name, note in notes.items())
    pictures = "".join(f'<img src="{file}" alt="{html.escape(growth.title)}">' for growth, file in charts)
    facts = html.escape(_facts(about).replace("`", ""))
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>"
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1><p>{facts}</p>"
        f"<table><thead>{cells('th', _HEADS)}</thead><tbody>{''.join(cells('td', r) for r in _rows(results))}"
        f"</tbody></table><section>{pictures}</section><h2>How it was measured</h2><ul>{items}</ul></html>\n"
    )


_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:70rem;margin:3rem auto;padding:0 1.5rem;color:#1c2430}"
    "h1{font-size:1.6rem}table{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums}"
    "th,td{text-align:left;padding:.4rem .8rem .4rem 0;border-bottom:1px solid #e3e7ed;vertical-align:top}"
    "td:nth-child(n+3){white-space:nowrap}"
    "section{display:flex;flex-wrap:wrap;gap:1rem;margin:2rem 0}img{width:22rem;max-width:100%}"
    "li{margin:.4rem 0;font-size:.85rem;color:#566173}"
)


_MOST_TICKS = 6
_COLOURS = ("#2f5dc4", "#e0902f", "#0d8a72", "#9a4fb5")


def _draw(growth: Growth, file: Path) -> None:
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    pyplot.rcParams["svg.hashsalt"] = growth.name  # the same figures give the same file
    figure, axes = pyplot.subplots(figsize=(4.2, 2.9), layout="constrained")
    for (name, values), colour in zip(growth.y.items(), _COLOURS, strict=False):
        axes.plot(growth.x, values, marker="o", markersize=3.5, linewidth=1.8, color=colour, label=name)
    axes.set_xscale("log")
    every = -(-len(growth.x) // _MOST_TICKS)
    axes.set_xticks(growth.x[::every], labels=[_short(x) for x in growth.x[::every]])
    axes.minorticks_off()
    values = [value for line in growth.y.values() for value in line]
    if max(values) > 10 * min(values):
        axes.set_yscale("log")
    else:  # less than a decade: a logarithm would make much of little
        axes.set_ylim(0, 1.3 * max(values))
    axes.set(title=growth.title, xlabel=growth.x_label, ylabel=growth.y_label)
    axes.grid(alpha=0.25, which="both", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    if len(growth.y) > 1:
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(file, metadata={"Date": None})
    pyplot.close(figure)


def _short(size: float) -> str:
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if size >= unit:
            return f"{size / unit:g}{name}"
    return f"{size:g}"


def _facts(about: dict[str, Any]) -> str:
    machine = about["machine"]
    packages = ", ".join(f"{name} {number}" for name, number in machine["packages"].items())
    return (
        f"`{about['command']}`, onedemo {about['version']}, {about['seconds']:.0f} s on "
        f"{machine['cores']} cores ({machine['processor']}), Python {machine['python']}, {packages}. "
        "Ratios are medians over turns A B A B ...; least and most of all turns show the spread."
    )


def _why(skipped: Skipped) -> str:
    return f"{'failed' if skipped.failed else 'not run'}, {skipped.reason}"


def _label(figure: Figure) -> str:
    return f"{figure.name} ({figure.against})" if figure.against else figure.name


def _value(value: float, unit: str) -> str:
    return f"{_round(value):,g} {unit}"


def _spread(figure: Figure) -> str:
    return f"{_round(figure.low):,g} - {_round(figure.high):,g}"


def _reach(figure: Figure) -> tuple[str, str]:
    if figure.reach is None:
        return "", ""
    sign = ">=" if figure.at_least else "<="
    return f"{sign} {figure.reach:g}", "met" if figure.met else "missed"


def _round(value: float) -> float:
    """Three figures that count."""
    return float(f"{value:.3g}") if abs(value) < 1000 else round(value)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(": ", 1)[1] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"
