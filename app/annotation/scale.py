"""The rating scale: what 1 to 5 mean, and why a clip may be skipped."""

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
