"""A report as a page of HTML, which needs nothing but its pictures beside it."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from itertools import groupby

from onedemo.experiments.report.blocks import (
    Block,
    Bullets,
    Cell,
    Document,
    Figure,
    Heading,
    Table,
    Text,
    alt_text,
    file_name,
    is_wide,
    numeric_columns,
    shown,
)


def as_html(document: Document) -> str:
    """The whole page."""
    title = html.escape(document.title)
    facts = f"<p class=facts>{_inline(document.facts)}</p>" if document.facts else ""
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
    kind = " class=wide" if is_wide(block) else ""
    source, alt = html.escape(file_name(block)), html.escape(alt_text(block))
    return f'<figure{kind}><img src="{source}" alt="{alt}">{note}</figure>'


def _html_table(table: Table) -> str:
    right = [" class=n" if numeric else "" for numeric in numeric_columns(table.heads, table.rows)]

    def line(tag: str, cells: Sequence[Cell]) -> str:
        placed = zip(cells, right, strict=True)
        return (
            "<tr>" + "".join(f"<{tag}{end}>{_inline(shown(cell))}</{tag}>" for cell, end in placed) + "</tr>"
        )

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
table { border-collapse: collapse; font-size: .875rem; line-height: 1.45;
  font-variant-numeric: tabular-nums; }
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
