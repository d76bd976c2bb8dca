"""The markup of a clip; ``static/player.js`` plays it."""

from __future__ import annotations

from onedemo.app.templates import render
from onedemo.storage.run_directory import CLIP_FORMAT


def example_address(name: str, sha256: str) -> str:
    """Where an example from a demo is; another demo's are elsewhere, as browsers keep them."""
    return f"demo/examples/{name}.jpg?v={sha256[:8]}-{CLIP_FORMAT}"


def video_address(sha256: str) -> str:
    """Where the whole demo is."""
    return f"demo/video.webm?v={sha256[:8]}"


def player_html(source: str, fps: float, *sides: str) -> str:
    """Canvases onto which a clip is drawn.

    Args:
        source: Address of its picture, as ``onedemo.render.clip_image.compose_clip`` makes it.
        fps: Frames per second.
        sides: "left", "right", each with a caption, or "both" on one canvas.
    """
    return render("player.html:player", source=source, fps=fps, sides=sides)
