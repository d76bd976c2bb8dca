"""The Guide tab: what to look at, what 1 to 5 mean, which keys there are."""

from __future__ import annotations

import logging
import threading

from onedemo.app.annotation.scale import ANSWERS, MEANINGS
from onedemo.app.ui.clip_player import example_address, player_html
from onedemo.app.ui.context import TabContext
from onedemo.app.ui.strings import keys_html
from onedemo.types import Status

log = logging.getLogger("onedemo.page")


class Guide:
    """The Guide tab of one session."""

    title = "Guide"

    def __init__(self, context: TabContext) -> None:
        self._pictures = context.pictures
        self._html = context.client.gui.add_html(guide_html(None))
        self._loading = False

    def show(self) -> None:
        """Fetches the examples the first time, without making anybody wait."""
        if not self._loading:
            self._loading = True
            threading.Thread(target=self._load, name="onedemo-guide", daemon=True).start()

    def hide(self) -> None:
        """Nothing to do: it holds nothing."""

    def refresh(self, status: Status) -> None:
        """Nothing to do: it does not change."""

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _load(self) -> None:
        try:
            self._pictures.examples()
            self._html.content = guide_html(self._pictures.demo.fps, self._pictures.demo.sha256)
        except Exception:
            log.exception("the examples of the guide could not be made")


def guide_html(fps: float | None, sha256: str = "") -> str:
    """The whole tab.

    Args:
        fps: Frames per second of the examples; None while they are not made yet.
        sha256: Of the demo.
    """
    scale = "".join(
        f"<li><b>{value}</b><div><strong>{answer}</strong><span>{meaning}</span></div></li>"
        for value, (answer, meaning) in enumerate(zip(ANSWERS, MEANINGS, strict=True), start=1)
    )
    shown = _examples_html(fps, sha256) if fps is not None else _NO_EXAMPLES
    return (
        '<article class="od-guide"><header><h1>How to rate</h1><p>A robot is learning a move from one video. '
        "You see two short movements, about a third of a second each, at real speed: a moment of the video, "
        "and beside it something the robot did. How alike are they? Your ratings tell the robot what to "
        "practise.</p><p>You need not know the move, or where in it a moment belongs: only these two "
        "movements count. At first the robot moves at random, and many pairs have little in "
        "common: those deserve a 1.</p></header>"
        f'<section><h2>What the numbers mean</h2><ol class="od-scale">{scale}</ol></section>'
        f"<section><h2>Examples from this video</h2>{shown}</section>"
        '<section class="od-two"><div><h2>What to look at</h2><ul class="od-points">'
        "<li><b>Pose</b>: are the limbs bent and turned alike?</li>"
        "<li><b>Direction</b>: does it rise, fall and turn the same way?</li>"
        "<li><b>Pace</b>: as fast, as slow?</li></ul>"
        "<p>Ignore the background; how high the robot is counts. Go by your first impression: "
        "there is no right answer to find, and a second or two is enough.</p>"
        '<p><button type="button" class="od-button" data-key="alt+a">Practise again</button></p></div>'
        f"<div><h2>Keys</h2>{keys_html()}</div></section></article>"
    )


_NO_EXAMPLES = '<p class="od-quiet" role="status">The examples are being made…</p>'


def _examples_html(fps: float, sha256: str) -> str:
    captions = {
        "same": ("5", "Twice the same moment."),
        "near": ("4", "Moments that look nearly alike."),
        "other": ("2–3", "Moments with something in common."),
        "far": ("1", "Moments with nothing in common."),
    }
    cards = ""
    for name, (value, text) in captions.items():
        cards += (
            f'<figure class="od-example">{player_html(example_address(name, sha256), fps, "both")}'
            f"<figcaption><b>{value}</b><span>{text}</span></figcaption></figure>"
        )
    return (
        '<p class="od-quiet">Both sides are moments of the video; '
        "the numbers are roughly what we would give.</p>"
        f'<div class="od-examples">{cards}</div>'
    )
