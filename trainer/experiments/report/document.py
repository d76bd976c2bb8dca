"""A report, written as Markdown, JSON and charts in SVG, or as text for a terminal."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from onedemo.core.files import write_atomic
from onedemo.experiments.report.blocks import (
    Bars,
    Bullets,
    Cell,
    Chart,
    Document,
    Heading,
    Picture,
    Table,
    Text,
    alt_text,
    bare,
    file_name,
    numeric_columns,
    shown,
)
from onedemo.experiments.report.machine import machine, now, program


def about(*, command: str, seconds: float | None = None, **more: Any) -> dict[str, Any]:
    """What every report says of itself.

    Args:
        command: What was typed.
        seconds: How long it took; None if that says nothing.
        more: Such as ``method_versions``, by name.
    """
    return {
        "command": command,
        **program(),
        "date": now(),
        **({"seconds": round(seconds, 1)} if seconds is not None else {}),
        "machine": machine(),
        **more,
    }


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


def record(document: Document) -> dict[str, Any]:
    """Everything in figures: what ``results.json`` holds."""
    return plain({**document.about, **document.data})


def write(document: Document, out: Path) -> None:
    """Writes ``report.md``, ``results.json``, and each chart and picture.

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
            from onedemo.experiments.report.drawing import draw

            write_atomic(out / file_name(block), draw(block))
    write_atomic(out / "results.json", (json.dumps(record(document), indent=1) + "\n").encode())
    write_atomic(out / "report.md", _markdown(document).encode())


def as_text(document: Document) -> str:
    """For a terminal; charts and pictures are left to the files."""
    parts = [f"{document.title}\n{'=' * len(document.title)}"]
    if document.facts:
        parts.append(_wrap(document.facts))
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
    right = numeric_columns(heads, rows)
    lines = [[bare(shown(cell)) for cell in row] for row in (heads, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]

    def place(line: Sequence[str]) -> str:
        cells = zip(line, widths, right, strict=True)
        return "  ".join(
            cell.rjust(width) if end else cell.ljust(width) for cell, width, end in cells
        ).rstrip()

    return "\n".join(place(line) for line in lines)


def _wrap(text: str, bullet: str = "") -> str:
    return textwrap.fill(
        bare(text), 100, initial_indent=bullet, subsequent_indent=" " * len(bullet), break_on_hyphens=False
    )


def _markdown(document: Document) -> str:
    parts = [f"# {document.title}"]
    if document.facts:
        parts.append(document.facts)
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
                parts.append(f"![{alt_text(block)}]({file_name(block)})")
                parts += [f"*{block.note}*"] if block.note else []
    return "\n\n".join(parts) + "\n"


def _markdown_table(table: Table) -> str:
    def line(cells: Sequence[Cell]) -> str:
        return (
            "| " + " | ".join(shown(cell).replace("|", "\\|").replace("\n", "<br>") for cell in cells) + " |"
        )

    rule = "|".join("---:" if right else "---" for right in numeric_columns(table.heads, table.rows))
    return "\n".join([line(table.heads), f"|{rule}|", *(line(row) for row in table.rows)])
