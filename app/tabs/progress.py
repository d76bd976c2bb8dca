"""How far the robot is: which parts of the demo it is good at. HTML, pure."""

from __future__ import annotations

from markupsafe import Markup

from onedemo.app.templates import render


def timeline_html(row: dict | None, seconds: float) -> Markup:
    """Predicted rating along the demo.

    Args:
        row: The newest iteration; None before the first.
        seconds: Length of the demo.
    """
    if row is None or not row.get("timeline"):
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
