"""The Guide tab: what to look at, what 1 to 5 mean, which keys there are."""

from __future__ import annotations

import logging
import threading

from markupsafe import Markup

from onedemo.app.annotation.scale import ANSWERS, MEANINGS
from onedemo.app.tabs.clip_player import example_address, player_html
from onedemo.app.tabs.context import TabContext
from onedemo.app.tabs.strings import RATE_KEYS
from onedemo.app.templates import render
from onedemo.errors import UserError
from onedemo.types import Status

log = logging.getLogger("onedemo.page")


class Guide:
    """The Guide tab of one session."""

    title = "Guide"

    def __init__(self, context: TabContext) -> None:
        self._pictures = context.pictures
        self._html = context.client.gui.add_html(str(guide_html(None)))
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
            self._html.content = str(guide_html(self._pictures.demo.fps, self._pictures.demo.sha256))
        except UserError:  # the demo's video is gone: logged, and said on top of the page
            pass
        except Exception:
            log.exception("the examples of the guide could not be made")


_EXAMPLES = (
    ("same", "5", "The same moment twice."),
    ("near", "4", "Moments that look nearly alike."),
    ("other", "2–3", "Moments with something in common."),
    ("far", "1", "Moments with nothing in common."),
)


def guide_html(fps: float | None, sha256: str = "") -> Markup:
    """The whole tab.

    Args:
        fps: Frames per second of the examples; None while they are not made yet.
        sha256: Of the demo.
    """
    examples = [
        (Markup(player_html(example_address(name, sha256), fps, "both")), rating, text)
        for name, rating, text in _EXAMPLES
        if fps is not None
    ]
    scale = list(zip(ANSWERS, MEANINGS, strict=True))
    return render("guide.html:guide", scale=scale, examples=examples, keys=RATE_KEYS)
