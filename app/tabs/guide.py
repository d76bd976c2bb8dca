"""The Guide tab: the whole move, what 1 to 5 mean, what to look at, words and keys."""

from __future__ import annotations

import logging
import threading

from markupsafe import Markup

from onedemo.app.annotation.examples import Examples
from onedemo.app.annotation.scale import ANSWERS, MEANINGS, WORDS
from onedemo.app.tabs.clip_player import example_address, player_html, video_address
from onedemo.app.tabs.context import TabContext
from onedemo.app.tabs.strings import RATE_KEYS
from onedemo.app.templates import render
from onedemo.errors import UserError
from onedemo.types import Demo, Status

log = logging.getLogger("onedemo.page")


class Guide:
    """The Guide tab of one session."""

    title = "Guide"

    def __init__(self, context: TabContext) -> None:
        self._pictures = context.pictures
        self._researcher = context.rater.role == "researcher"
        self._html = context.client.gui.add_html(str(self._drawn_with(None)))
        self._shown = False
        self._examples: Examples | None = None

    def show(self) -> None:
        """Fetches the examples, without making anybody wait."""
        self._shown = True
        self._follow()

    def hide(self) -> None:
        """Does not look for others any more."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """There are more examples once the robot was looked at."""
        if self._shown:
            self._follow()

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _follow(self) -> None:
        examples = self._pictures.chosen()
        if examples is not self._examples:
            self._examples = examples
            threading.Thread(target=self._load, args=(examples,), name="onedemo-guide", daemon=True).start()

    def _load(self, examples: Examples) -> None:
        try:
            self._pictures.examples()
            self._html.content = str(self._drawn_with(examples))
        except UserError:  # the demo's video is gone: logged, and said on top of the page
            pass
        except Exception:
            log.exception("the examples of the guide could not be made")

    def _drawn_with(self, examples: Examples | None) -> Markup:
        return guide_html(self._pictures.demo, examples, researcher=self._researcher)


def guide_html(demo: Demo, examples: Examples | None, *, researcher: bool) -> Markup:
    """The whole tab.

    Args:
        demo: What is to be learned.
        examples: Of ratings; None while they are not made yet.
        researcher: Whether it explains the words of the researcher's tabs, too.
    """
    cards = [
        (player_html(example_address(example.name, demo.sha256), demo.fps, "both"), example)
        for example in (examples.guide if examples is not None else ())
    ]
    words = [(word, text) for word, text, everybody in WORDS if everybody or researcher]
    return render(
        "guide.html:guide", scale=list(zip(ANSWERS, MEANINGS, strict=True)), cards=cards, words=words,
        video=video_address(demo.sha256), loading=examples is None, keys=RATE_KEYS,
    )  # fmt: skip
