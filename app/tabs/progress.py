"""How far the robot is: which parts of the demo it is good at, and its best rollouts so far. HTML, pure."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from onedemo.app.templates import render

_SHOWN = 12
"""Iterations in the gallery."""


def timeline_html(rows: Sequence[dict], seconds: float) -> Markup:
    """Predicted rating along the demo, of the newest iteration that has one.

    Args:
        rows: Iterations, oldest first.
        seconds: Length of the demo.
    """
    row = next((row for row in reversed(rows) if row.get("timeline")), None)
    if row is None:
        return render("watch.html:no_timeline")
    parts = row["timeline"]
    known = [part for part in parts if part is not None]
    cells = []
    for index, part in enumerate(parts):
        start, end = (seconds * k / len(parts) for k in (index, index + 1))
        percent, rating = (None, "not reached") if part is None else (round(25 * (part - 1)), f"{part:.1f}")
        cells.append((percent, f"{start:.1f} to {end:.1f} s: {rating}"))
    if known:
        weakest = seconds * (parts.index(min(known)) + 0.5) / len(parts)
        told = f"between {min(known):.1f} and {max(known):.1f}; weakest at {weakest:.1f} s"
        if missing := parts.count(None):
            told += f"; {seconds * missing / len(parts):.1f} s not reached (dashed)"
    else:
        told = "no part was reached"
    return render(
        "watch.html:timeline", iteration=row["number"], cells=cells, told=told, missing=None in parts,
        seconds=seconds,
    )  # fmt: skip


def chosen(numbers: Sequence[int], most: int = _SHOWN) -> list[int]:
    """Iterations to be shown: the newest first, then ever older ones, spread evenly."""
    if len(numbers) <= most:
        return list(reversed(numbers))
    last = len(numbers) - 1
    return [numbers[round(last * (most - 1 - k) / (most - 1))] for k in range(most)]


def gallery_html(rows: Sequence[dict], version: str) -> Markup:
    """The best rollout of some iterations: a filmstrip each, which opens as a video.

    Args:
        rows: Iterations, oldest first.
        version: Of the run's pictures, as ``pictures.version_of``.
    """
    best = {row["number"]: row["best"] for row in rows if row.get("best") is not None}
    cards = [(number, best[number]) for number in chosen(list(best))]
    return render("watch.html:gallery", cards=cards, version=version)
