"""Settings of what raters are asked. Light: the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass

from onedemo.core.ranges import at_least, one_of

CHOICES: dict[str, dict[str, float]] = {
    "uniform": {"any": 1.0},
    "mix": {"high": 0.4, "disagreement": 0.3, "any": 0.3},
    "high": {"high": 1.0},
    "disagreement": {"disagreement": 1.0},
}
"""Ways to choose a round: the shares of clips rated highest, of those most disagreed on, and of any."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RatingsConfig:
    """What raters are asked. Defaults: the paper's section "Evaluation of learning from observations"."""

    pretrain: int = 200
    """Ratings of clips of a random policy, before the policy is trained."""
    online: int = 150
    """Ratings of clips of the policy in training."""
    clip_seconds: float = 0.3
    """Length of a clip."""
    starts: str = "random"
    """Where the clips before practice come from: "random" states of the robot, or, as in the paper, a
    random policy that starts "standing"."""
    pairing: str = "any"
    """Before practice a clip is asked beside "any" moment of the demo, or beside the same "time"."""
    choice: str = "mix"
    """Which of the possible clips are asked: "uniform"; those rated "high"; those of most "disagreement"
    between the predictor's members; or a "mix" of all three. All but the first spread over the demo."""
    rounds: int = 10
    """A simulated rater's first ratings come in so many rounds, with a refit after each."""
    queue: int = 12
    """Clips kept ready to be rated, at least: twice as many as people rate while the robot practises once."""
    stale_iterations: int = 10
    """A clip that nobody has rated expires after so many iterations: the policy has moved on."""
    online_share: float = 0.5
    """A simulated rater gives its online ratings evenly over this first share of the training."""

    def __post_init__(self) -> None:
        at_least("ratings", self, pretrain=1, online=0, rounds=1, queue=1, stale_iterations=1)
        if not 0.05 <= self.clip_seconds <= 5:
            raise ValueError(f"ratings.clip_seconds must be 0.05 to 5 s, got {self.clip_seconds}")
        one_of("ratings.starts", self.starts, ("random", "standing"))
        one_of("ratings.pairing", self.pairing, ("any", "time"))
        one_of("ratings.choice", self.choice, CHOICES)
        if not 0 < self.online_share <= 1:
            raise ValueError(f"ratings.online_share must be in (0, 1], got {self.online_share}")
