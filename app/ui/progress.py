"""How far the robot is: which parts of the demo it is good at, and its best rollouts so far. HTML, pure."""

from __future__ import annotations

from collections.abc import Sequence

_SHOWN = 12
"""Iterations in the gallery."""


def timeline_html(rows: Sequence[dict], seconds: float) -> str:
    """Predicted rating along the demo, of the newest iteration that has one.

    Args:
        rows: Iterations, oldest first.
        seconds: Length of the demo.
    """
    row = next((row for row in reversed(rows) if row.get("timeline")), None)
    if row is None:
        return '<section class="od-parts od-empty"></section>'
    parts = row["timeline"]
    cells, known = "", [part for part in parts if part is not None]
    for index, part in enumerate(parts):
        start, end = (seconds * k / len(parts) for k in (index, index + 1))
        title = f"{start:.1f} to {end:.1f} s: " + ("not reached" if part is None else f"{part:.1f}")
        if part is None:
            cells += f'<i data-none title="{title}"></i>'
        else:
            cells += f'<i style="--od-rated:{round(100 * (part - 1) / 4)}%" title="{title}"></i>'
    if known:
        weakest = seconds * (parts.index(min(known)) + 0.5) / len(parts)
        told = f"between {min(known):.1f} and {max(known):.1f}; weakest at {weakest:.1f} s"
        if missing := parts.count(None):
            told += f"; {seconds * missing / len(parts):.1f} s not reached (dashed)"
    else:
        told = "no part was reached"
    dashes = "<i data-none></i> not reached" if None in parts else ""
    return (
        '<section class="od-parts"><h3>Predicted rating along the video '
        f"<small>iteration {row['number']:,}; {told}</small></h3>"
        f'<div class="od-cells" role="img" aria-label="Predicted rating along the video: {told}">'
        f"{cells}</div>"
        f'<p class="od-scale-note"><span>0 s</span><span class="od-legend">1 <i></i> 5{dashes}</span>'
        f"<span>{seconds:.1f} s</span></p></section>"
    )


def chosen(numbers: Sequence[int], most: int = _SHOWN) -> list[int]:
    """Iterations to be shown: the newest first, then ever older ones, spread evenly."""
    if len(numbers) <= most:
        return list(reversed(numbers))
    last = len(numbers) - 1
    return [numbers[round(last * (most - 1 - k) / (most - 1))] for k in range(most)]


def gallery_html(rows: Sequence[dict], version: str) -> str:
    """The best rollout of some iterations: a filmstrip each, which opens as a video.

    Args:
        rows: Iterations, oldest first.
        version: Of the run's pictures, as ``pictures.version_of``.
    """
    best = {row["number"]: row["best"] for row in rows if row.get("best") is not None}
    if not best:
        return ""
    cards = "".join(
        f'<li><button type="button" data-video="/rollouts/{number}.webm?v={version}" '
        f'aria-label="Play the best rollout of iteration {number}">'
        f'<img src="/rollouts/{number}.jpg?v={version}" alt="" loading="lazy" '
        'width="960" height="120"></button>'
        f"<p><b>Iteration {number:,}</b> predicted rating {best[number]:.1f} "
        f'<a href="/rollouts/{number}.webm?v={version}" download="onedemo-iteration-{number}.webm">'
        "Download video</a></p></li>"
        for number in chosen(list(best))
    )
    return (
        '<section class="od-gallery"><h3>Best rollout of an iteration <small>the newest first</small></h3>'
        f"<ol>{cards}</ol></section>"
    )


PLAYER = (
    '<dialog class="od-film" aria-label="Best rollout of an iteration">'
    "<video controls playsinline loop></video>"
    '<form method="dialog"><button class="od-button od-primary">Close</button></form></dialog>'
)
