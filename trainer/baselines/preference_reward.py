"""A reward learned from comparisons of two segments (Christiano et al. 2017, sections 2.2.3 and 2.2.4).

Several small networks, each fitted on its own bootstrap sample of the comparisons; their mean is the
reward, their disagreement says which pair to ask about next. Nothing here knows what is compared for:
this module sees segments and preferences.

Shapes: K members of the ensemble, n comparisons or pairs of 2 segments, W control steps a segment,
o observations, a actions, S standard inputs, B pairs in a minibatch, C of the W steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from onedemo.core import optimisers
from onedemo.reward.two_branch_net import standard_inputs, standard_size
from onedemo.types import Segment

Pair = tuple[Segment, Segment]
_STANDARD_DIMS = standard_size("hopper")


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardConfig:
    """The ensemble and how it is fitted. Defaults: Christiano et al. 2017, appendix A.1, unless noted."""

    members: int = 3
    """K: networks in the ensemble."""
    hidden: tuple[int, int] = (64, 64)
    """Widths of the two layers, leaky ReLU of slope 0.01."""
    noise: float = 0.1
    """Chance that an answer is a coin toss: p becomes (1 - noise) p + noise / 2."""
    updates: int = 300
    """Gradient steps of one fit (ours: the paper trains on while people answer)."""
    batch: int = 32
    """B: pairs in a gradient step, of each member (ours)."""
    stride: int = 8
    """A gradient step looks at every 8th control step of a segment, from one drawn at random: 15 a
    second, as a person would see them (ours; neighbouring control steps are nearly alike)."""
    rate: float = 5e-3
    """Adam's step size at the start; it falls to 0 (ours)."""
    decay: float = 1.0
    """Weights shrink by this share of the step size (ours, and fixed: the paper adjusts it until the
    loss on held-out comparisons is 1.1 to 1.5 times that on the others)."""

    def __post_init__(self) -> None:
        for name in ("members", "updates", "batch", "stride"):
            if getattr(self, name) < 1:
                raise ValueError(f"reward.{name} must be at least 1, got {getattr(self, name)}")
        if len(self.hidden) != 2 or min(self.hidden) < 1:
            raise ValueError(f"reward.hidden must be two positive widths, got {self.hidden}")
        if not 0 <= self.noise < 1:
            raise ValueError(f"reward.noise must be in [0, 1), got {self.noise}")
        if self.rate <= 0 or self.decay < 0:
            raise ValueError("reward.rate must be > 0 and reward.decay >= 0")


@dataclass(frozen=True, kw_only=True, slots=True)
class Comparison:
    """Two segments and which of them was preferred."""

    pair: Pair
    """Two segments of W steps."""
    preference: float
    """1: the first, 0: the second, 0.5: neither."""

    def __post_init__(self) -> None:
        if self.preference not in (0.0, 0.5, 1.0):
            raise ValueError(f"a preference is 0, 0.5 or 1, got {self.preference}")


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardFit:
    """How a fit went."""

    loss: float
    """Cross-entropy over each member's own comparisons, nats; ln 2 is guessing."""
    unseen_loss: float
    """Over the comparisons that its bootstrap left out, about 1 in e; NaN if there are none."""
    unseen_accuracy: float
    """Share of those, ties aside, whose preferred segment gets the higher sum; NaN if there are none."""


class RewardEnsemble:
    """An immutable learned reward.

    Args:
        nets: The fitted networks; not to be changed afterwards.
        mean: Of each member's output over the compared steps, (K,).
        std: Its standard deviation, (K,).
        scale: Standard deviation of the mean over the members so normalised.
    """

    def __init__(self, nets: _Nets, *, mean: torch.Tensor, std: torch.Tensor, scale: float) -> None:
        self._nets = nets.requires_grad_(False)
        self._mean, self._std, self._scale = mean, std, scale

    def rewards(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The reward of steps: members independently normalised, averaged, of unit deviation.

        Args:
            obs: Observation before each step, (..., o).
            actions: Action of each step, not clipped, (..., a).

        Returns:
            (...), float32.
        """
        inputs = standard_inputs(obs, actions)
        flat = torch.from_numpy(inputs.reshape(-1, _STANDARD_DIMS))
        with torch.inference_mode():
            out_Kn = (self._nets(flat.expand(len(self._mean), -1, -1)) - self._mean[:, None]) / self._std[
                :, None
            ]
            return (out_Kn.mean(0) / self._scale).numpy().reshape(inputs.shape[:-1])

    def probabilities(self, pairs: Sequence[Pair]) -> np.ndarray:
        """Each member's probability that the first of two segments is preferred (eq. 1).

        Args:
            pairs: n pairs of segments of W steps.

        Returns:
            (K, n).
        """
        with torch.inference_mode():
            return torch.sigmoid(_margins(self._nets, _inputs(pairs))).numpy()


def most_disputed(ensemble: RewardEnsemble, pairs: Sequence[Pair], count: int) -> list[Pair]:
    """The pairs on whose preference the members disagree most (section 2.2.4).

    Args:
        ensemble: The reward as it is now.
        pairs: Candidates.
        count: How many to take; all of them if there are fewer.

    Returns:
        Pairs of the highest variance over the members, in falling order.
    """
    if not pairs:
        return []
    variance_n = ensemble.probabilities(pairs).var(axis=0)
    return [pairs[i] for i in np.argsort(-variance_n, kind="stable")[:count]]


def fit_reward(
    comparisons: Sequence[Comparison], config: RewardConfig, *, seed: int
) -> tuple[RewardEnsemble, RewardFit]:
    """Fits an ensemble from scratch: the same comparisons and seed give the same weights.

    Every member maximises the likelihood of the preferences under a Bradley-Terry model on the
    sums of its rewards over the two segments, on comparisons drawn with replacement.

    Args:
        comparisons: n of them, all segments of W steps.
        config: How.
        seed: Of weights, bootstraps and minibatches.

    Returns:
        The reward and how the fit went.

    Raises:
        ValueError: If there is no comparison.
    """
    if not comparisons:
        raise ValueError("a reward needs at least one comparison")
    generator = torch.Generator().manual_seed(seed)
    x_n2WS = _inputs([c.pair for c in comparisons])
    target_n = torch.tensor([c.preference for c in comparisons], dtype=torch.float32)
    n, steps, K = len(comparisons), x_n2WS.shape[2], config.members
    nets = _Nets(K, config.hidden, generator)
    optimiser = optimisers.AdamW(nets.parameters(), config.rate, weight_decay=config.decay, foreach=True)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.updates)
    bags_Kn = torch.randint(n, (K, n), generator=generator)
    stride = min(config.stride, steps)
    for _ in range(config.updates):
        drawn_KB = bags_Kn.gather(1, torch.randint(n, (K, min(config.batch, n)), generator=generator))
        phase = int(torch.randint(stride, (), generator=generator))
        margins_KB = _margins(nets, x_n2WS[:, :, phase::stride][drawn_KB])
        loss = _losses(margins_KB, target_n[drawn_KB], config.noise).mean(1).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        fall.step()
    with torch.no_grad():
        out_KN = nets(x_n2WS.reshape(-1, _STANDARD_DIMS).expand(K, -1, -1))
        mean_K, std_K = out_KN.mean(1), out_KN.std(1).clamp_min(1e-6)
        scale = ((out_KN - mean_K[:, None]) / std_K[:, None]).mean(0).std().clamp_min(1e-6)
        margins_Kn = _difference(out_KN.reshape(K, n, 2, steps))
        losses_Kn = _losses(margins_Kn, target_n.expand(K, n), config.noise)
    unseen_Kn = torch.ones(K, n, dtype=torch.bool).scatter_(1, bags_Kn, False)
    decided_Kn = unseen_Kn & (target_n != 0.5)
    right_Kn = (margins_Kn > 0) == (target_n > 0.5)
    stats = RewardFit(
        loss=float(losses_Kn.gather(1, bags_Kn).mean()),
        unseen_loss=float(losses_Kn[unseen_Kn].mean()),
        unseen_accuracy=float(right_Kn[decided_Kn].float().mean()),
    )
    return RewardEnsemble(nets, mean=mean_K, std=std_K, scale=float(scale)), stats


class _Nets(nn.Module):
    """K networks of the same shape side by side: one batched product a layer."""

    def __init__(self, members: int, hidden: tuple[int, int], generator: torch.Generator) -> None:
        super().__init__()
        sizes = (_STANDARD_DIMS, *hidden, 1)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(sizes):
            weight = torch.empty(members, fan_in, fan_out)
            nn.init.uniform_(weight, -(fan_in**-0.5), fan_in**-0.5, generator=generator)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(members, 1, fan_out)))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Outputs (K, n) for inputs (K, n, S)."""
        x = inputs
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x if layer == 0 else functional.leaky_relu(x, 0.01), weight)
        return x.squeeze(-1)


def _margins(nets: _Nets, inputs: torch.Tensor) -> torch.Tensor:
    """Log odds that the first of two segments is preferred.

    Args:
        nets: K members.
        inputs: (K, n, 2, C, S), or (n, 2, C, S) where all members see the same.

    Returns:
        (K, n).
    """
    K = len(nets.weights[0])
    if inputs.dim() == 4:
        inputs = inputs.expand(K, *inputs.shape)
    shape = inputs.shape[1:4]
    return _difference(nets(inputs.reshape(K, -1, _STANDARD_DIMS)).reshape(K, *shape))


def _difference(out: torch.Tensor) -> torch.Tensor:
    """Difference of the two sums, (K, n), of outputs (K, n, 2, C).

    An output is W times the reward of its step, so a sum of rewards is a mean of outputs: the size of
    a gradient step then does not depend on the length of a segment.
    """
    sums = out.mean(-1)
    return sums[..., 0] - sums[..., 1]


def _losses(margins: torch.Tensor, targets: torch.Tensor, noise: float) -> torch.Tensor:
    """Cross-entropy of each preference, nats; same shape."""
    p = (1 - noise) * torch.sigmoid(margins) + noise / 2
    return functional.binary_cross_entropy(p, targets, reduction="none")


def _inputs(pairs: Sequence[Pair]) -> torch.Tensor:
    """Standard inputs of n pairs, (n, 2, W, S)."""
    obs, actions = (
        np.stack([[getattr(segment, name) for segment in pair] for pair in pairs])
        for name in ("obs", "actions")
    )
    return torch.from_numpy(standard_inputs(obs, actions))
