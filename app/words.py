"""Words that several tabs use."""

ANSWERS = ("Not at all", "A little", "Partly", "Mostly", "The same")
"""What 1 to 5 mean."""

MEANINGS = (
    "Nothing about the attempt reminds you of the demonstration.",
    "One thing fits, such as the direction, but the rest does not.",
    "You can see what is being tried: about half of it fits.",
    "Nearly right. The pose, the direction or the timing is a little off.",
    "You could take one for the other.",
)
"""The same, for the guide."""
