"""The HTML of a clip; ``static/player.js`` plays it."""

from __future__ import annotations

_CAPTIONS = {"left": "From the video", "right": "The robot"}


def example_address(name: str, sha256: str) -> str:
    """Where an example from a demo is; another demo's are elsewhere, as browsers keep them."""
    return f"/demo/examples/{name}.jpg?v={sha256[:8]}"


def player_html(
    source: str, fps: float, *sides: str, attributes: str = "", captions: dict[str, str] | None = None
) -> str:
    """Canvases onto which a clip is drawn.

    Args:
        source: Address of its picture, as ``onedemo.render.clip_image.compose_clip`` makes it.
        fps: Frames per second.
        sides: "left", "right", each with a caption, or "both" on one canvas.
        attributes: More attributes of the element.
        captions: Instead of the usual ones.
    """
    captions = captions or _CAPTIONS
    canvases = ""
    for side in sides:
        width, caption = (972, "Video and robot") if side == "both" else (480, captions[side])
        shown = "" if side == "both" else f"<figcaption>{caption}</figcaption>"
        canvases += (
            f'<figure class="od-side od-{side}">{shown}<div><canvas data-side="{side}" width="{width}" '
            f'height="360" role="img" aria-label="{caption}"></canvas></div></figure>'
        )
    return f'<div class="od-player" data-src="{source}" data-fps="{fps:g}" {attributes}>{canvases}</div>'
