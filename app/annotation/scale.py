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

PAIR_REASONS = ("I cannot see enough", "Too short to tell", "A picture is broken")
"""Why a pair may be skipped."""

WORDS = (
    ("Clip", "A third of a second of what the robot did, beside as much of the video.", True),
    ("Rating", "How alike the two sides of a clip are, from 1 to 5.", True),
    ("Mark", "The part of a clip where it goes wrong, as you dragged it on the bar below the clip.", True),
    ("Practice", "The robot tries the move again and again, steered by what was learned from ratings.", True),
    ("Iteration", "One round of practice. The newest clips show what the robot did in the last one.", True),
    ("Used for training", "Ratings that something is learned from. They count towards the target.", True),
    ("Repeat", "A clip that the same person was asked a second time, to see how steady ratings are. "
     "It is kept, and not used for training.", True),
    ("Skipped", "A clip that somebody would not rate. It is no rating.", True),
    ("Excluded", "All ratings of somebody whom a researcher takes out of training. They are kept, and others "
     "are asked in their place.", True),
    ("Withdrawn", "One rating that a researcher has taken back, with a reason.", False),
    ("Before and during practice", "Clips of random motion come before the robot practises (stage "
     "pretrain in the CSV), clips of what it has learned during practice (stage online).", False),
    ("Reward model", "What predicts ratings. When it has learned from new ones it is a new version.", False),
    ("Predicted rating", "What the reward model would rate a movement, 1 to 5.", False),
    ("Rollout", "One attempt of the robot from start to end.", False),
    ("Control step", "The shortest time in which the robot can change what it does: 8 ms.", False),
    ("True reward", "Points by a formula written for this move. Shown where there is one, never used for "
     "training.", False),
    ("Agreement", "How far several people rate the same clips alike: 1 is perfect, 0 chance.", False),
)  # fmt: skip
"""Words of the page: what each means, and whether annotators meet it, too."""
