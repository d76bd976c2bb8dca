"""Settings of the policy and of its training. Light: the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass

from onedemo.core.ranges import at_least, one_of

KINDS = ("clock", "table", "pose", "raw")


@dataclass(frozen=True, kw_only=True, slots=True)
class PolicyConfig:
    """What the policy sees and how large it is."""

    kind: str = "clock"
    """"clock": pose, velocities and the demo clock as harmonics; "table": pose, velocities and
    what a table holds for the demo step (say, frame features); "pose": no time; "raw": the
    observation alone."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the tanh layers, of the policy and of the value function (2 x 64: the
    network of the human-preferences literature)."""
    log_std: float = 0.0
    """Initial log standard deviation of each action; actions reach from -1 to 1."""

    def __post_init__(self) -> None:
        one_of("policy.kind", self.kind, KINDS)
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"policy.hidden must be positive layer widths, got {self.hidden}")


@dataclass(frozen=True, kw_only=True, slots=True)
class TrpoConfig:
    """Trust-region step and value regression."""

    max_kl: float = 0.05
    """Trust-region radius, mean KL(old || new) over the batch, nats. Schulman et al. 2015 use 0.01;
    batches of 16 thousand steps and more bear longer steps."""
    final_kl: float = 0.01
    """The radius at the end of a training, nats, if that is less than ``max_kl``: it shrinks in proportion
    to what has been practised, so that the last steps refine and do not throw over."""
    gamma: float = 0.99
    """Discount per control step, in [0, 1)."""
    lam: float = 0.97
    """Bias-variance trade-off of the advantages, in [0, 1] (Schulman et al. 2016)."""
    cg_iterations: int = 10
    """Conjugate-gradient iterations (Schulman et al. 2015, appendix C)."""
    damping: float = 0.1
    """Added to the Fisher matrix's diagonal."""
    backtracks: int = 10
    """Tries of the line search."""
    backtrack_factor: float = 0.8
    """Each try is this times as long as the one before."""
    fisher_samples: int = 8192
    """Samples behind a Fisher-vector product (a subsample loses nothing: appendix C)."""
    value_epochs: int = 5
    """Passes of the value regression over the batch."""
    value_rate: float = 1e-3
    """Adam's step size in the value regression."""
    value_batch: int = 2048
    """Samples in a minibatch of the value regression."""
    entropy_bonus: float = 0.0
    """Added to the objective per nat of the policy's entropy, in standardised advantages."""

    def __post_init__(self) -> None:
        if self.max_kl <= 0:
            raise ValueError(f"trpo.max_kl must be > 0 nats, got {self.max_kl}")
        if not 0 < self.final_kl:
            raise ValueError(f"trpo.final_kl must be > 0 nats, got {self.final_kl}")
        if not 0 <= self.gamma < 1:
            raise ValueError(f"trpo.gamma must be in [0, 1), got {self.gamma}")
        if not 0 <= self.lam <= 1:
            raise ValueError(f"trpo.lam must be in [0, 1], got {self.lam}")
        if self.damping < 0:
            raise ValueError(f"trpo.damping must be >= 0, got {self.damping}")
        if not 0 < self.backtrack_factor < 1:
            raise ValueError(f"trpo.backtrack_factor must be between 0 and 1, got {self.backtrack_factor}")
        at_least("trpo", self, cg_iterations=1, backtracks=1, fisher_samples=1, value_batch=1)
        if self.value_epochs < 0 or self.value_rate <= 0:
            raise ValueError("trpo.value_epochs must be >= 0 and trpo.value_rate > 0")
