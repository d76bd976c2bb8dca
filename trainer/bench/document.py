"""A report: a list of blocks, written as Markdown, HTML, JSON and charts in SVG, or as text for a terminal.

Texts and cells may hold the simplest Markdown: **bold**, `code` and [links](target).
"""

from __future__ import annotations

import html
import json
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Protocol

from trainer.bench.machine import commit, machine, now
from trainer.files import write_atomic

Cell = str | float | None


class Numbers(Protocol):
    """A sequence of numbers: a list, or an array of one dimension."""

    def __len__(self) -> int: ...  # noqa: D105
    def __getitem__(self, index: Any, /) -> Any: ...  # noqa: D105


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
    """Lower edge of a shaded band; as long as x."""
    high: Numbers | None = None
    each: Sequence[Numbers] | Numbers = ()
    """Thin lines beside it, such as one for each seed; each as long as x."""
    colour: str = ""
    """Of ``trainer.bench.drawing.COLOURS``, or any other; by the order of lines if empty."""
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
    def record(self) -> dict[str, Any]:
        """What ``results.json`` holds."""
        return plain({**self.about, **self.data})


def about(*, command: str, seconds: float | None = None, **more: Any) -> dict[str, Any]:
    """What every report says of itself.

    Args:
        command: What was typed.
        seconds: How long it took; None if that says nothing.
        more: Such as ``method_versions``, by name.
    """
    from trainer.runs import program_version

    source = commit()
    return {
        "command": command,
        "version": program_version(),
        **({"commit": source} if source else {}),
        "date": now(),
        **({"seconds": round(seconds, 1)} if seconds is not None else {}),
        "machine": machine(),
        **more,
    }


def write(document: Document, out: Path) -> None:
    """Writes ``report.md``, ``report.html``, ``results.json``, and each chart and picture.

    The same document gives the same files, byte by byte.

    Args:
        document: What is to be written.
        out: Directory; made if missing.

    Raises:
        ImportError: If matplotlib (extra ``[bench]``) is missing and there is a chart to draw.
    """
    out.mkdir(parents=True, exist_ok=True)
    for block in document.blocks:
        if isinstance(block, Picture):
            write_atomic(out / block.name, block.data)
        elif isinstance(block, Chart | Bars):
            from trainer.bench.drawing import draw

            write_atomic(out / _file(block), draw(block))
    write_atomic(out / "results.json", (json.dumps(document.record, indent=1) + "\n").encode())
    write_atomic(out / "report.md", _markdown(document).encode())
    write_atomic(out / "report.html", _html(document).encode())


def as_text(document: Document) -> str:
    """For a terminal; charts and pictures are left to the files."""
    parts = [f"{document.title}\n{'=' * len(document.title)}"]
    if document.about:
        parts.append(_wrap(_facts(document.about)))
    for block in document.blocks:
        match block:
            case Heading(text):
                parts.append(f"{text}\n{'-' * len(text)}")
            case Text(text):
                parts.append(_wrap(text))
            case Bullets(items):
                parts.append("\n".join(_wrap(item, "- ") for item in items))
            case Table():
                lines = [_wrap(block.title)] if block.title else []
                lines += [text_table(block.heads, block.rows), *(_wrap(note) for note in block.notes)]
                parts.append("\n".join(lines))
    return "\n\n".join(parts)


def text_table(heads: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table in columns, its heads in the first line."""
    right = _numeric(heads, rows)
    lines = [[_bare(_show(cell)) for cell in row] for row in (heads, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]

    def place(line: Sequence[str]) -> str:
        cells = zip(line, widths, right, strict=True)
        return "  ".join(cell.rjust(width) if end else cell.ljust(width) for cell, width, end in cells).rstrip()

    return "\n".join(place(line) for line in lines)


def number(value: float) -> str:
    """Three figures that count, and all those before the point."""
    if abs(value) >= 1000:
        return f"{round(value):,}"
    return f"{float(f'{value:.3g}'):g}"


def plain(value: Any) -> Any:
    """The same in what JSON knows: arrays as lists, numbers that are not finite as None.

    Raises:
        TypeError: If there is something else in it.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):  # NumPy's float64 is one
        return float(value) if math.isfinite(value) else None
    if hasattr(value, "tolist"):  # NumPy's other scalars and arrays, PyTorch's tensors
        return plain(value.tolist())
    raise TypeError(f"there is a {type(value).__name__}, which JSON does not know")


def _show(cell: Cell) -> str:
    if cell is None:
        return ""
    return cell if isinstance(cell, str) else number(cell)


_NUMBER = re.compile(r"(?:[<>]=|[<>≤≥≈±])?\s*[-+−]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?(?:\s|%|$)")
_NOTHING = ("", "–", "not run", "failed")


def _numeric(heads: Sequence[str], rows: Sequence[Sequence[Cell]]) -> list[bool]:
    """Which columns hold numbers."""
    columns = [[_bare(_show(row[i])) for row in rows] for i in range(len(heads))]
    shown = [[cell for cell in column if cell not in _NOTHING] for column in columns]
    return [bool(cells) and all(_NUMBER.match(cell) for cell in cells) for cells in shown]


def _facts(about: Mapping[str, Any]) -> str:
    machine = about["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    source = f" at commit {about['commit']}" if "commit" in about else ""
    seconds = f"{about['seconds']:,.0f} s " if "seconds" in about else ""
    methods = ", ".join(f"{kind} {number}" for kind, number in about.get("method_versions", {}).items())
    return (
        f"`{about['command']}`, onedemo {about['version']}{source}, {about['date'][:10]}, "
        f"{seconds}on {machine['cores']} cores ({machine['processor']}), Python {machine['python']}, {packages}"
        f"{f'; method versions: {methods}' if methods else ''}."
    )


def _file(figure: Figure) -> str:
    return figure.name if isinstance(figure, Picture) else f"{figure.name}.svg"


def _alt(figure: Figure) -> str:
    return figure.alt if isinstance(figure, Picture) else figure.title


def _is_wide(figure: Figure) -> bool:
    return isinstance(figure, Bars) or figure.wide


# Text


def _bare(text: str) -> str:
    """Without marks."""
    return re.sub(r"\*\*|`", "", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text))


def _wrap(text: str, bullet: str = "") -> str:
    return textwrap.fill(
        _bare(text), 100, initial_indent=bullet, subsequent_indent=" " * len(bullet), break_on_hyphens=False
    )


# Markdown


def _markdown(document: Document) -> str:
    parts = [f"# {document.title}"]
    if document.about:
        parts.append(_facts(document.about))
    for block in document.blocks:
        match block:
            case Heading(text):
                parts.append(f"## {text}")
            case Text(text):
                parts.append(text)
            case Bullets(items):
                parts.append("\n".join(f"- {item}" for item in items))
            case Table():
                parts += [f"**{block.title}**"] if block.title else []
                parts += [_markdown_table(block), *block.notes]
            case _:
                parts.append(f"![{_alt(block)}]({_file(block)})")
                parts += [f"*{block.note}*"] if block.note else []
    return "\n\n".join(parts) + "\n"


def _markdown_table(table: Table) -> str:
    def line(cells: Sequence[Cell]) -> str:
        return "| " + " | ".join(_show(cell).replace("|", "\\|").replace("\n", "<br>") for cell in cells) + " |"

    rule = "|".join("---:" if right else "---" for right in _numeric(table.heads, table.rows))
    return "\n".join([line(table.heads), f"|{rule}|", *(line(row) for row in table.rows)])


# HTML


def _html(document: Document) -> str:
    title = html.escape(document.title)
    facts = f"<p class=facts>{_inline(_facts(document.about))}</p>" if document.about else ""
    body = ""
    for are_figures, blocks in groupby(document.blocks, lambda block: isinstance(block, Figure)):
        inner = "\n".join(_html_block(block) for block in blocks)
        body += f"<div class=figures>\n{inner}\n</div>\n" if are_figures else f"{inner}\n"
    return (
        "<!doctype html>\n<html lang=en>\n<meta charset=utf-8>\n"
        '<meta name=viewport content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n<main>\n<h1>{title}</h1>\n{facts}\n{body}"
        "</main>\n</html>\n"
    )


def _html_block(block: Block) -> str:
    match block:
        case Heading(text):
            return f"<h2>{_inline(text)}</h2>"
        case Text(text):
            return f"<p>{_inline(text)}</p>"
        case Bullets(items):
            return "<ul>\n" + "".join(f"<li>{_inline(item)}</li>\n" for item in items) + "</ul>"
        case Table():
            return _html_table(block)
    note = f"<figcaption>{_inline(block.note)}</figcaption>" if block.note else ""
    kind = " class=wide" if _is_wide(block) else ""
    return f'<figure{kind}><img src="{html.escape(_file(block))}" alt="{html.escape(_alt(block))}">{note}</figure>'


def _html_table(table: Table) -> str:
    right = [" class=n" if numeric else "" for numeric in _numeric(table.heads, table.rows)]

    def line(tag: str, cells: Sequence[Cell]) -> str:
        placed = zip(cells, right, strict=True)
        return "<tr>" + "".join(f"<{tag}{end}>{_inline(_show(cell))}</{tag}>" for cell, end in placed) + "</tr>"

    caption = f"<caption>{_inline(table.title)}</caption>" if table.title else ""
    rows = "\n".join(line("td", row) for row in table.rows)
    notes = "".join(f"\n<p class=note>{_inline(note)}</p>" for note in table.notes)
    return (
        f"<div class=table><table>{caption}\n<thead>{line('th', table.heads)}</thead>\n"
        f"<tbody>\n{rows}\n</tbody></table></div>{notes}"
    )


def _inline(text: str) -> str:
    text = html.escape(text, quote=True)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)
    return re.sub(r"\[([^]]+)\]\(([^)\s]+)\)", r'<a href="\2">\1</a>', text).replace("\n", "<br>")


_STYLE = """
:root { color-scheme: light; }
body { margin: 0; background: #fff; color: #1c2430; font: 16px/1.6 system-ui, -apple-system, "Segoe UI",
  Roboto, Helvetica, Arial, sans-serif; }
main { max-width: 56rem; margin: 0 auto; padding: 4rem 1.5rem 6rem; }
h1 { font-size: 2rem; line-height: 1.2; letter-spacing: -.02em; margin: 0 0 1rem; }
h2 { font-size: 1.25rem; letter-spacing: -.01em; margin: 3.5rem 0 .75rem; }
p, li { max-width: 44rem; }
li { margin: .35rem 0; }
ul { padding-left: 1.1rem; }
.facts, .note, figcaption { color: #566173; font-size: .8125rem; line-height: 1.5; }
.facts { padding-bottom: 1.5rem; border-bottom: 1px solid #e3e7ed; margin-bottom: 2rem; max-width: none; }
code { font: .875em ui-monospace, "SF Mono", Menlo, Consolas, monospace; background: #f2f4f7;
  padding: .1em .3em; border-radius: 3px; }
a { color: #2f5dc4; }
.table { overflow-x: auto; margin: 1.5rem 0; }
table { border-collapse: collapse; font-size: .875rem; line-height: 1.45; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: .5rem; }
th { font-weight: 600; color: #566173; border-bottom: 1.5px solid #c6cdd8; vertical-align: bottom; }
th, td { text-align: left; padding: .45rem 1.5rem .45rem 0; }
td { border-bottom: 1px solid #e9ecf1; vertical-align: top; }
.n { text-align: right; }
td.n { white-space: nowrap; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(20rem, 1fr)); gap: 2rem 1.5rem;
  margin: 2rem 0; }
figure { margin: 0; }
figure.wide { grid-column: 1 / -1; }
figure img { display: block; width: 100%; height: auto; }
figure:not(.wide) img { max-width: 27rem; }
figcaption { margin-top: .5rem; max-width: 44rem; }
"""
