"""Words that several tabs use."""

ANSWERS = ("Not at all", "A little", "Partly", "Mostly", "The same")
"""What 1 to 5 mean."""

MEANINGS = (
    "Nothing about the robot reminds you of the video.",
    "One thing fits, such as the direction, but the rest does not.",
    "About half of it fits.",
    "Nearly right. The pose, the direction or the pace is a little off.",
    "You could take one for the other.",
)
"""The same, for the guide."""

REASONS = ("I cannot see enough", "It is too short to tell", "The picture is broken")
"""Why a clip may be skipped."""

KEYS = (
    (("1", "2", "3", "4", "5"), "rate the pair; the next one follows at once"),
    (("U",), "take your last rating back, as often as you like (also Backspace)"),
    (("S",), "skip this pair; you may say why"),
    (("Space",), "play it again from the start"),
    (("F",), "slow motion, on and off"),
    (("←", "→"), "one picture back or on"),
    (("M",), "mark where it goes wrong: once at the start, once at the end"),
    (("?",), "show these keys"),
)
"""What the keys of the Rate tab do."""


def keys_html() -> str:
    """The keys as a list."""
    rows = "".join(
        f"<li><span>{''.join(f'<kbd>{key}</kbd>' for key in names)}</span>{text}</li>" for names, text in KEYS
    )
    return f'<ul class="od-keys">{rows}</ul>'
