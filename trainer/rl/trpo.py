"""Trust region policy optimisation (Schulman et al. 2015) with generalised advantages.

One update: advantages from the value function, a natural-gradient direction by conjugate
gradient on Fisher-vector products, a step as long as the trust region allows, a backtracking
line search on the whole batch, then the value function's regression.

The update does not depend on the scale of the rewards: advantages are standardised and the value
function normalises its targets (``policy.ValueFunction``), so a learned reward may change scale.

Shapes: N lanes, T steps, B = N T samples, f inputs, a actions, P policy parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from onedemo.core import optimisers
from onedemo.rl.fisher import conjugate_gradient, fisher_product, mean_kl
from onedemo.rl.policy import Policy, ValueFunction
from onedemo.rl.settings import TrpoConfig
from onedemo.types import Rollouts


@dataclass(frozen=True, kw_only=True, slots=True)
class TrpoStats:
    """What one update did."""

    accepted: bool
    """Whether the line search found a step; if not, the policy is as before."""
    backtracks: int
    """How often the step was shortened."""
    kl: float
    """Mean KL(old || new) over the batch, nats."""
    improvement: float
    """Gain of the surrogate objective, in standard deviations of the advantage."""
    explained_variance: float
    """Of the returns by the value function before its fit: 1 is perfect, 0 a constant's."""
    value_loss: float
    """Mean squared error of the value function in its last epoch, in return deviations squared."""
    entropy: float
    """Of the policy after the step, nats."""
    std: float
    """Mean standard deviation of the actions after the step."""
    mean_reward: float
    """Of the batch, per step."""


class Trpo:
    """TRPO on one policy: owns the value function, its optimiser and its random numbers.

    Args:
        policy: Improved in place by ``update``.
        config: The step.
        seed: Of the value function's weights and of the subsamples.
        threads: With 2 or more, the value regression runs beside the policy's step. The numbers are
            the same: neither looks at what the other does.
    """

    def __init__(self, policy: Policy, config: TrpoConfig, *, seed: int, threads: int = 1) -> None:
        self.policy = policy
        self.config = config
        self.value = ValueFunction(policy.input_size, policy.config.hidden, seed=seed).to(policy.device)
        self._parameters = [*policy.mean.parameters(), policy.log_std]
        # Fused: one pass over the parameters; they are few, and the calls would cost more than the sums.
        self._adam = optimisers.Adam(self.value.parameters(), config.value_rate, fused=True)
        self._beside = ThreadPoolExecutor(1, "value", _one_thread) if threads > 1 else None
        self._generator = torch.Generator().manual_seed(seed)

    def update(self, rollouts: Rollouts, *, progress: float = 0.0) -> TrpoStats:
        """One TRPO step, then the value regression, then the policy's input normaliser.

        Args:
            rollouts: What the current policy did, with the reward of each step in any units.
            progress: How much of the training is over, 0..1; it moves the radius to ``final_kl``.

        Returns:
            What the step did.

        Raises:
            ValueError: If the rewards have the wrong shape or are not finite.
        """
        rewards_NT = rollouts.rewards
        if rewards_NT.shape != rollouts.clock.shape or not np.isfinite(rewards_NT).all():
            raise ValueError(f"rewards must be finite and {rollouts.clock.shape}, got {rewards_NT.shape}")
        final_kl = min(self.config.final_kl, self.config.max_kl)
        max_kl = self.config.max_kl + progress * (final_kl - self.config.max_kl)
        device = self.policy.device
        inputs_Bf = torch.from_numpy(rollouts.inputs).flatten(0, 1).to(device)
        actions_Ba = torch.from_numpy(rollouts.actions).flatten(0, 1).to(device)
        ended_NT = rollouts.terminated | rollouts.truncated
        values_NT, next_values_NT = self._values(rollouts, ended_NT)
        advantages_NT = gae(
            rewards_NT,
            values_NT,
            next_values_NT,
            rollouts.terminated,
            ended_NT,
            gamma=self.config.gamma,
            lam=self.config.lam,
        )
        returns_NT = advantages_NT + values_NT
        spread = advantages_NT.std() + 1e-8
        standard_NT = (advantages_NT - advantages_NT.mean()) / spread
        advantages_B = torch.from_numpy(standard_NT.astype(np.float32)).flatten().to(device)
        returns_B = torch.from_numpy(returns_NT.astype(np.float32)).flatten().to(device)
        # All that is random is drawn here, in one order, whichever of the two below runs first.
        sample = self._permutation(len(inputs_Bf))[: self.config.fisher_samples]
        orders = [self._permutation(len(inputs_Bf)) for _ in range(self.config.value_epochs)]
        regression = partial(self._fit_value, inputs_Bf, returns_B, orders)
        beside = self._beside.submit(regression) if self._beside is not None else None
        try:
            accepted, backtracks, kl, improvement = self._improve(
                inputs_Bf, actions_Ba, advantages_B, sample, max_kl
            )
        finally:  # whatever happens, nothing goes on behind the caller's back
            value_loss = regression() if beside is None else beside.result()
        self.policy.observe(rollouts.obs, rollouts.clock)
        log_std = self.policy.log_std.detach()
        return TrpoStats(
            accepted=accepted,
            backtracks=backtracks,
            kl=kl,
            improvement=improvement,
            explained_variance=float(1 - advantages_NT.var() / (returns_NT.var() + 1e-8)),
            value_loss=value_loss,
            entropy=float((log_std + 0.5 * np.log(2 * np.pi * np.e)).sum()),
            std=float(log_std.exp().mean()),
            mean_reward=float(rewards_NT.mean()),
        )

    def state_dict(self) -> dict[str, Any]:
        """Value function, Adam and generator (the policy saves itself), for ``torch.save``."""
        return {
            "value": {name: x.detach().clone() for name, x in self.value.state_dict().items()},
            "adam": self._adam.state_dict(),
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken."""
        self.value.load_state_dict(state["value"])
        self._adam.load_state_dict(state["adam"])
        for group in self._adam.param_groups:  # what was saved says how it was computed, too
            group["fused"] = True
        self._generator.set_state(state["generator"])

    def _permutation(self, count: int) -> torch.Tensor:
        return torch.randperm(count, generator=self._generator).to(self.policy.device)

    def _values(self, rollouts: Rollouts, ended_NT: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """V before and after each step: one pass, as the state after a step is the next one's."""
        with torch.no_grad():
            whole = np.concatenate([rollouts.inputs, rollouts.next_inputs[:, -1:]], axis=1)
            values_NT1 = self.value(torch.from_numpy(whole).to(self.policy.device)).cpu().numpy()
            next_values_NT = values_NT1[:, 1:].copy()
            if ended_NT.any():
                last = torch.from_numpy(rollouts.next_inputs[ended_NT]).to(self.policy.device)
                next_values_NT[ended_NT] = self.value(last).cpu().numpy()
        return values_NT1[:, :-1], next_values_NT

    def _improve(
        self,
        inputs_Bf: torch.Tensor,
        actions_Ba: torch.Tensor,
        advantages_B: torch.Tensor,
        sample: torch.Tensor,
        max_kl: float,
    ) -> tuple[bool, int, float, float]:
        config, policy = self.config, self.policy
        mean_Ba = policy(inputs_Bf)
        log_prob_B = policy.log_prob_of(mean_Ba, actions_Ba)
        old_mean_Ba, old_log_std = mean_Ba.detach(), policy.log_std.detach().clone()
        old_log_prob_B = log_prob_B.detach()

        def objective(log_prob_B: torch.Tensor) -> torch.Tensor:
            ratio_B = torch.exp(log_prob_B - old_log_prob_B)
            return (ratio_B * advantages_B).mean() + config.entropy_bonus * policy.log_std.sum()

        before = objective(log_prob_B)
        gradient_P = _flat(torch.autograd.grad(before, self._parameters))
        with torch.no_grad():
            fisher = fisher_product(policy, inputs_Bf[sample], config.damping)
            direction_P, left_P = conjugate_gradient(fisher, gradient_P, config.cg_iterations)
            curvature = direction_P @ (gradient_P - left_P)  # d F d, as F d is known by now
            if not torch.isfinite(curvature) or curvature <= 0:  # no gradient: nothing to improve
                return False, 0, 0.0, 0.0
            step_P = direction_P * torch.sqrt(2 * max_kl / curvature)
            old_P = parameters_to_vector(self._parameters).clone()
            for tries in range(config.backtracks):
                step = config.backtrack_factor**tries * step_P
                vector_to_parameters(old_P + step, self._parameters)
                mean_Ba = policy(inputs_Bf)
                gain = float(objective(policy.log_prob_of(mean_Ba, actions_Ba)) - before)
                kl = float(mean_kl(old_mean_Ba, old_log_std, mean_Ba, policy.log_std))
                if gain > 0 and kl <= max_kl:
                    return True, tries, kl, gain
            vector_to_parameters(old_P, self._parameters)
        return False, config.backtracks, 0.0, 0.0

    def _fit_value(
        self, inputs_Bf: torch.Tensor, returns_B: torch.Tensor, orders: Sequence[torch.Tensor]
    ) -> float:
        """Minibatch regression on the returns, one pass for each order of the samples."""
        targets_B = self.value.rescale(returns_B)
        losses: list[torch.Tensor] = []
        for order in orders:
            losses = []
            for index in order.split(self.config.value_batch):
                error = self.value.normalised(inputs_Bf[index]) - targets_B[index]
                loss = error.square().mean()
                self._adam.zero_grad()
                loss.backward()
                self._adam.step()
                losses.append(loss.detach())
        return float(torch.stack(losses).mean()) if losses else float("nan")


def gae(
    rewards_NT: np.ndarray,
    values_NT: np.ndarray,
    next_values_NT: np.ndarray,
    terminated_NT: np.ndarray,
    ended_NT: np.ndarray,
    *,
    gamma: float,
    lam: float,
) -> np.ndarray:
    """Advantage of each step (Schulman et al. 2016, eq. 16).

    Only a terminal state cuts the bootstrap. At the time limit the sum over later steps stops,
    but the value of the state that was reached still counts.

    Args:
        rewards_NT: Reward per step, (N, T).
        values_NT: V of the state before each step, (N, T).
        next_values_NT: V of the state after each step, before any reset, (N, T).
        terminated_NT: True where the step reached a terminal state, (N, T).
        ended_NT: True where the episode ended for any reason, (N, T).
        gamma: Discount per control step, in [0, 1].
        lam: Bias-variance trade-off, in [0, 1].

    Returns:
        Advantages, (N, T), float64, not normalised.

    Raises:
        ValueError: If the shapes disagree.
    """
    shapes = {x.shape for x in (rewards_NT, values_NT, next_values_NT, terminated_NT, ended_NT)}
    if len(shapes) != 1:
        raise ValueError(f"gae needs arrays of one shape (N, T), got {sorted(shapes)}")
    deltas_NT = rewards_NT + gamma * next_values_NT * ~terminated_NT - values_NT
    carry_NT = gamma * lam * ~ended_NT
    advantages_NT = np.empty(rewards_NT.shape)
    later_N = np.zeros(len(rewards_NT))
    for t in range(rewards_NT.shape[1] - 1, -1, -1):
        later_N = deltas_NT[:, t] + carry_NT[:, t] * later_N
        advantages_NT[:, t] = later_N
    return advantages_NT


def _one_thread() -> None:
    """For a thread that works beside another: the networks are too small to be split further."""
    torch.set_num_threads(1)


def _flat(tensors: tuple[torch.Tensor, ...]) -> torch.Tensor:
    return torch.cat([x.reshape(-1) for x in tensors])
