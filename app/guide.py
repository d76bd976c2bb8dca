"""The Guide tab: what to look at, what 1 to 5 mean, which keys there are."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

from app.pictures import Example
from app.words import ANSWERS, MEANINGS
from trainer.records import Status

if TYPE_CHECKING:
    from app.session import Session

log = logging.getLogger("onedemo.page")

_KEYS = (
    (("1", "2", "3", "4", "5"), "rate the pair; the next one follows at once"),
    (("U",), "take your last rating back, as often as you like (also Backspace)"),
    (("S",), "skip this one"),
    (("Space",), "play it again from the start"),
)


class Guide:
    """The Guide tab of one session."""

    title = "Guide"

    def __init__(self, session: Session) -> None:
        self._pictures = session.page.pictures
        self._html = session.client.gui.add_html(guide_html({}))
        self._loading = False

    def show(self) -> None:
        """Fetches the examples the first time, without making anybody wait."""
        if not self._loading:
            self._loading = True
            threading.Thread(target=self._load, name="onedemo-guide", daemon=True).start()

    def hide(self) -> None:
        """Nothing to do: it does not change."""

    def refresh(self, status: Status) -> None:
        """Nothing to do: it does not change."""

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _load(self) -> None:
        try:
            self._html.content = guide_html(self._pictures.examples())
        except Exception:
            log.exception("the examples of the guide could not be made")


def guide_html(examples: dict[str, Example]) -> str:
    """The whole tab; without examples it still says what the numbers mean."""
    scale = "".join(
        f"<li><b>{value}</b><div><strong>{answer}</strong><span>{meaning}</span></div></li>"
        for value, (answer, meaning) in enumerate(zip(ANSWERS, MEANINGS, strict=True), start=1)
    )
    keys = "".join(
        f"<li><span>{''.join(f'<kbd>{key}</kbd>' for key in names)}</span>{text}</li>"
        for names, text in _KEYS
    )
    return (
        '<article class="od-guide"><header><h1>How to rate</h1><p>A robot is learning a move from one video. '
        "You see two short movements, about a third of a second each, both at real speed. Left: a moment of "
        "the video. Right: something the robot did. How alike are they? Your ratings tell the robot what to "
        "practise.</p><p>You need not know the move, or where in it a moment belongs: only these two "
        "movements count. At first the robot moves at random, so most pairs deserve a 1.</p></header>"
        f'<section><h2>What the numbers mean</h2><ol class="od-scale">{scale}</ol></section>'
        f"<section><h2>Examples from this demonstration</h2>{_examples_html(examples)}</section>"
        '<section class="od-two"><div><h2>What to look at</h2><ul class="od-points">'
        "<li><b>Pose</b>: are the limbs bent and turned alike?</li>"
        "<li><b>Direction</b>: does it rise, fall and turn the same way?</li>"
        "<li><b>Pace</b>: as fast, as slow?</li></ul>"
        "<p>Ignore the background, and where in the picture the robot is. Go by your first impression: "
        "there is no right answer to find, and a second or two is enough.</p></div>"
        f'<div><h2>Keys</h2><ul class="od-keys">{keys}</ul></div></section></article>'
    )


def _examples_html(examples: dict[str, Example]) -> str:
    if not examples:
        return '<p class="od-quiet" role="status">The examples are being made…</p>'
    captions = {
        "same": ("5", "Twice the same moment."),
        "near": ("4", "A moment that looks nearly alike"),
        "other": ("2–3", "A moment with something in common"),
        "far": ("1", "The moment that looks most different"),
    }
    cards = ""
    for name, (value, text) in captions.items():
        example = examples[name]
        times = "" if name == "same" else f" ({example.other:.2f} s instead of {example.at:.2f} s)."
        cards += (
            f'<figure class="od-example"><div><img src="/demo/examples/{name}.webp" alt=""></div>'
            f"<figcaption><b>{value}</b><span>{text}{times}</span></figcaption></figure>"
        )
    return (
        '<p class="od-quiet">Both sides are from the demonstration itself; '
        "the numbers are what we would give.</p>"
        f'<div class="od-examples">{cards}</div>'
    )
