"""Words that several tabs use."""


def nobody_html(ratings: int, learned: int) -> str:
    """For researchers, if there are ratings but all are left out of training: what happens now."""
    if learned or not ratings:
        return ""
    return (
        '<p class="od-nobody" role="status"><b>Everybody is left out of training.</b> Nothing new is '
        "learned: the robot goes on practising with the last predictor it has, if it has one, and clips "
        "go on being asked. Take somebody in again on the Data tab, and the next iteration learns from "
        "their ratings.</p>"
    )


Keys = tuple[tuple[tuple[str, ...], str], ...]
"""Keys, and what they do."""

_PLAYING: Keys = (
    (("Space",), "play it again from the start"),
    (("F",), "slow motion, on and off"),
    (("←", "→"), "one picture back or on"),
)
_HELP: Keys = ((("?",), "show these keys"),)
RATE_KEYS: Keys = (
    (("1", "2", "3", "4", "5"), "rate the pair; the next one follows at once"),
    (("U",), "take your last rating back, as often as you like (also Backspace)"),
    (("S",), "skip this pair; you may say why"),
    *_PLAYING,
    (("M",), "mark where it goes wrong: once at the start, once at the end"),
    *_HELP,
)
COMPARE_KEYS: Keys = (
    (("1",), "the left one is nearer to the video"),
    (("2",), "both are alike"),
    (("3",), "the right one is nearer to the video"),
    (("U",), "take your last answer back, as often as you like (also Backspace)"),
    (("S",), "skip these two"),
    *_PLAYING,
    *_HELP,
)


def keys_html(keys: Keys = RATE_KEYS) -> str:
    """Keys as a list."""
    rows = "".join(
        f"<li><span>{''.join(f'<kbd>{key}</kbd>' for key in names)}</span>{text}</li>" for names, text in keys
    )
    return f'<ul class="od-keys">{rows}</ul>'


def keys_dialog(keys: Keys) -> str:
    """The same, opened by "?"."""
    return (
        f'<dialog class="od-help" aria-label="Keys"><h2>Keys</h2>{keys_html(keys)}'
        '<form method="dialog"><button class="od-button od-primary">Close</button></form></dialog>'
    )
