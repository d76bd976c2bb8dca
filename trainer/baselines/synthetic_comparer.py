"""The simulated person behind learning from preferences: all that goes by the hand-coded reward there.

Shapes: N lanes, T control steps, W control steps a segment.
"""

from __future__ import annotations

import numpy as np

from onedemo.rl.rollouts import Transitions
from onedemo.sim.task_rewards import backflip_reward
from onedemo.types import Segment


class ComparisonBudgetSpent(Exception):
    """The comparer was asked once more than it agreed to."""


class Comparer:
    """Prefers the segment with more of a backflip, without error.

    Goes by the hand-coded backflip reward over what a segment shows: W - 1 steps from its first
    state to its last.

    Args:
        budget: Answers it will give, enforced here.
    """

    def __init__(self, *, budget: int) -> None:
        self.budget = budget
        self.given = 0

    def compare(self, first: Segment, second: Segment) -> float:
        """1 if the first is preferred, 0 if the second, 0.5 if they are equal.

        Raises:
            ComparisonBudgetSpent: If the budget is used up.
        """
        if self.given >= self.budget:
            raise ComparisonBudgetSpent(f"the budget of {self.budget} comparisons is spent")
        self.given += 1
        a, b = (float(backflip_reward(s.obs[1:], s.actions[:-1]).sum()) for s in (first, second))
        return 0.5 if a == b else float(a > b)


def agreement(rollouts: Transitions, rewards_NT: np.ndarray, length: int) -> float:
    """Correlation of a reward with the hand-coded one, summed over the W-step pieces of a batch; evaluation.

    Args:
        rollouts: The batch.
        rewards_NT: The reward of each step, (N, T).
        length: W.
    """
    true_NT = backflip_reward(rollouts.next_obs, rollouts.actions)
    pieces = rewards_NT.shape[1] // length
    sums = [x[:, : pieces * length].reshape(len(x) * pieces, length).sum(1) for x in (rewards_NT, true_NT)]
    return float(np.corrcoef(*sums)[0, 1])
