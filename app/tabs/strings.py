"""Words that several tabs use: the keys, and what they do."""

from onedemo.app.templates import render

Keys = tuple[tuple[tuple[str, ...], str], ...]
"""Keys, and what they do."""

_PLAYING: Keys = (
    (("Space",), "play it again from the start"),
    (("F",), "slow motion, on and off"),
    (("T",), "first pose and paths through the clip, on and off"),
    (("←", "→"), "one frame back or forward"),
)
_HELP: Keys = ((("?",), "show these keys"),)
RATE_KEYS: Keys = (
    (("1", "2", "3", "4", "5"), "rate the pair; the next one follows at once"),
    (("U",), "undo your last rating, and those before it (also Backspace)"),
    (("S",), "skip this pair; you may say why"),
    *_PLAYING,
    (("M",), "mark where it goes wrong: once at the start, once at the end"),
    *_HELP,
)
COMPARE_KEYS: Keys = (
    (("1",), "the left one is closer to the video"),
    (("2",), "about the same"),
    (("3",), "the right one is closer to the video"),
    (("U",), "undo your last answer, and those before it (also Backspace)"),
    (("S",), "skip these two; you may say why"),
    *_PLAYING,
    *_HELP,
)


def keys_dialog(keys: Keys) -> str:
    """Keys as a list, opened by "?"."""
    return str(render("parts.html:keys_dialog", keys=keys))
