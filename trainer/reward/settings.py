"""Settings of the similarity predictor and of practice under it. Light: the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass

from onedemo.core.ranges import at_least, one_of

KINDS = {"network": "onedemo.reward.two_branch_net", "metric": "onedemo.reward.learned_distance"}
"""Kind to module; each has ``fit(...)`` as below and ``restore(data, config, device)``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PredictorConfig:
    """What is fitted to the ratings, and how."""

    kind: str = "metric"
    """"network": the paper's; "metric": a distance between poses, with a weight for each part."""
    appearance: bool = True
    """Learn from own pictures what the robot looks like, and see poses in the demo's frames. Without it,
    or where the demo shows another body, the ratings alone say what a frame is like."""
    members: int = 3
    """Predictors fitted side by side on different draws of the ratings: where they disagree, ask."""
    sampling: str = "equal"
    """"equal": as many pairs of each rating in a batch; "random": as they come. Of "network"."""
    class_weights: bool = False
    """Weigh the loss of rare ratings more (the paper's third and fourth variant). Of "network"."""
    additional_layer: bool = True
    """One more fully connected layer before the softmax (the paper's last variant). Of "network"."""
    ordinal: bool = False
    """Ratings next to the one given count as half right. Of "network"; "metric" always knows the order."""
    hidden: int = 64
    """Width of every layer. Of "network"."""
    visual_dims: int = 24
    """Principal components of the demo's frame features that enter; 0: all features, as in the paper."""
    learning_rate: float = 0.03
    """Of stochastic gradient descent with momentum 0.9. Of "network"."""
    weight_decay: float = 1e-4
    """L2 penalty. Of "network"."""
    batch_clips: int = 60
    """Clips in a batch. Of "network"."""
    pairs_per_clip: int = 4
    """(frame, state-action) pairs drawn from each of them. Of "network"."""
    updates: int = 1500
    """Gradient steps of one fit. Of "network"."""
    reward: str = "expected"
    """"expected" rating, 1..5 in between; or "argmax", the most probable class."""

    def __post_init__(self) -> None:
        one_of("predictor.kind", self.kind, KINDS)
        if self.sampling not in ("equal", "random"):
            raise ValueError(f'predictor.sampling must be "equal" or "random", got {self.sampling!r}')
        if self.reward not in ("expected", "argmax"):
            raise ValueError(f'predictor.reward must be "expected" or "argmax", got {self.reward!r}')
        at_least("predictor", self, members=1, hidden=1, batch_clips=1, pairs_per_clip=1, updates=1)
        if self.visual_dims < 0:
            raise ValueError(f"predictor.visual_dims must be 0 or more, got {self.visual_dims}")
        if self.learning_rate <= 0:
            raise ValueError(f"predictor.learning_rate must be > 0, got {self.learning_rate}")


@dataclass(frozen=True, kw_only=True, slots=True)
class PracticeConfig:
    """Which rules an episode follows, and how far they go."""

    elastic: bool = True
    """The demo phase adapts to the robot; False: it runs in real time."""
    slack_seconds: float = 0.6
    """How far the adaptive phase may be from real time, either way."""
    bank_share: float = 0.5
    """Share of episodes that start in a random state that the predictor likes; 0: all stand."""
    give_up: float = 0.3
    """An episode ends when the running similarity falls below this share of that of the reset
    buffer's states, the most that the predictor gives; 0: never."""
    random_lanes: int = 64
    """Lanes of random states: the first clips and the reset buffer are picked from what happens there."""
    bank_tries: int = 8000
    """Random states that are compared with each moment of the demo to fill the reset buffer."""

    def __post_init__(self) -> None:
        at_least("practice", self, random_lanes=1, bank_tries=1)
        if not 0 <= self.bank_share <= 1:
            raise ValueError(f"practice.bank_share must be in 0..1, got {self.bank_share}")
        if not 0 <= self.give_up < 1:
            raise ValueError(f"practice.give_up must be in 0..1, got {self.give_up}")
        if self.slack_seconds < 0:
            raise ValueError(f"practice.slack_seconds must be at least 0, got {self.slack_seconds}")
