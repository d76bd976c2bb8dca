"""The Gaussian policy, the value function and what they see.

The policy is trained in torch and acted with in NumPy: ``Policy.snapshot`` copies weights and
normaliser into a ``PolicySnapshot``, which never changes and may be used by any thread while
the trainer goes on.

Shapes: B any batch shape, o observations, f features, a actions, H demo steps (horizon).
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import nn

from onedemo.errors import UserError
from onedemo.rl.policy_inputs import (
    feature_size,
    policy_inputs,
    rows_of,
    state_features,
    time_features,
)
from onedemo.rl.settings import PolicyConfig

_CLIP = 10.0
"""Normalised inputs are clipped to +- this many standard deviations."""


@dataclass(frozen=True, slots=True)
class PolicySnapshot:
    """A policy that never changes: copies of weights and normaliser, in NumPy."""

    kind: str
    horizon: int
    weights: tuple[np.ndarray, ...]
    """Of each layer, (in, out), float32."""
    biases: tuple[np.ndarray, ...]
    """Of each layer, (out,), float32."""
    log_std: np.ndarray
    """(a,), float32."""
    mean: np.ndarray
    """Of the features, (f,), float64."""
    std: np.ndarray
    """Of the features, (f,), float64."""
    time: np.ndarray | None
    """Normalised inputs of each demo step, float32: they depend on nothing else. None without time."""
    angles: tuple[int, ...] = (1,)
    """Which observations are angles without end."""
    network: nn.Module | None = None
    """The network of the mean, a copy on an accelerator, which then acts; None: the weights above do."""

    def inputs(self, obs: np.ndarray, clock: np.ndarray) -> np.ndarray:
        """Normalised policy inputs of observations (..., o) at demo steps (...): (..., f), float32."""
        features = state_features(obs, self.kind, self.angles)
        width = features.shape[-1]
        state = _normalise(features, self.mean[:width], self.std[:width])
        if self.time is None:
            return state
        return np.concatenate([state, self.time[rows_of(clock, self.time)]], axis=-1)

    def act(self, inputs: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Actions for normalised inputs.

        Args:
            inputs: (..., f), float32.
            rng: Samples the Gaussian; None gives its mean (the deterministic mode).

        Returns:
            Actions, not clipped, (..., a), float32.
        """
        if self.network is not None:
            with torch.inference_mode():
                device = next(self.network.parameters()).device
                actions = self.network(torch.from_numpy(inputs).to(device)).cpu().numpy()
        else:
            x = inputs
            for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
                x = np.tanh(x @ weight + bias)
            actions = x @ self.weights[-1] + self.biases[-1]
        if rng is not None:
            noise = rng.standard_normal(actions.shape, np.float32)
            actions = actions + np.exp(self.log_std) * noise
        return actions


def _normalise(features: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    return np.clip((features - mean) / std, -_CLIP, _CLIP).astype(np.float32)


class Normaliser(nn.Module):
    """Running mean and variance of features (Chan et al. 1979, the pairwise update)."""

    mean: torch.Tensor
    var: torch.Tensor
    count: torch.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def update(self, features: np.ndarray) -> None:
        """Takes in a batch of features, (..., f)."""
        batch = torch.as_tensor(features, dtype=torch.float64, device=self.mean.device)
        batch = batch.reshape(-1, len(self.mean))
        total = self.count + len(batch)
        shift = batch.mean(0) - self.mean
        spread = batch.var(0, correction=0) * len(batch) + self.var * self.count
        self.var.copy_((spread + shift**2 * self.count * len(batch) / total) / total)
        self.mean.add_(shift * len(batch) / total)
        self.count.copy_(total)


class Policy(nn.Module):
    """Gaussian policy: a tanh network for the mean, a standard deviation that ignores the state.

    Args:
        config: Size and inputs.
        obs_size: o.
        action_size: a.
        horizon: Demo steps in an episode.
        seed: Of the initial weights.
        table: For kind "table", (H, k).
        angles: Which observations are angles without end, ascending.
    """

    def __init__(
        self,
        config: PolicyConfig,
        *,
        obs_size: int,
        action_size: int,
        horizon: int,
        seed: int,
        table: np.ndarray | None = None,
        angles: Sequence[int] = (1,),
    ) -> None:
        super().__init__()
        self.config = config
        self.obs_size = obs_size
        self.action_size = action_size
        self.horizon = horizon
        self.angles = tuple(angles)
        if (config.kind == "table") != (table is not None):
            raise ValueError('a table is needed by kind "table" and by no other')
        width = 0 if table is None else table.shape[1]
        self.table = None if table is None else np.array(table, np.float64)
        self.input_size = feature_size(obs_size, config.kind, width, len(self.angles))
        # A small last layer: the first policy is its noise, whatever the inputs.
        self.mean = mlp((self.input_size, *config.hidden, action_size), 0.01, seed)
        self.log_std = nn.Parameter(torch.full((action_size,), config.log_std))
        self.normaliser = Normaliser(self.input_size)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Mean actions of normalised inputs, (B, f) to (B, a)."""
        return self.mean(inputs)

    def log_prob_of(self, mean: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Log density of actions (B, a) around mean actions (B, a), in nats: (B,)."""
        z = (actions - mean) * torch.exp(-self.log_std)
        return (-0.5 * z**2 - self.log_std - 0.5 * math.log(2 * math.pi)).sum(-1)

    def observe(self, obs: np.ndarray, clock: np.ndarray) -> None:
        """Takes observations (..., o) at demo steps (...) into the running normaliser."""
        kind, horizon = self.config.kind, self.horizon
        self.normaliser.update(policy_inputs(obs, clock, horizon, kind, self.table, angles=self.angles))

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return self.log_std.device

    def snapshot(self, *, on_device: bool = False) -> PolicySnapshot:
        """The policy as it is now, in copies.

        Args:
            on_device: Let it act where the policy is, which pays with thousands of lanes on an
                accelerator; else in NumPy.
        """
        layers = [layer for layer in self.mean if isinstance(layer, nn.Linear)]
        mean = self.normaliser.mean.cpu().numpy().copy()
        std = np.sqrt(self.normaliser.var.cpu().numpy() + 1e-8)
        time = time_features(self.horizon, self.config.kind, self.table)
        if time is not None:
            width = time.shape[1]
            time = _normalise(time, mean[-width:], std[-width:])
        return PolicySnapshot(
            kind=self.config.kind,
            horizon=self.horizon,
            weights=tuple(layer.weight.detach().cpu().numpy().T.copy() for layer in layers),
            biases=tuple(layer.bias.detach().cpu().numpy().copy() for layer in layers),
            log_std=self.log_std.detach().cpu().numpy().copy(),
            mean=mean,
            std=std,
            time=time,
            angles=self.angles,
            network=copy.deepcopy(self.mean).requires_grad_(False) if on_device else None,
        )

    def to_dict(self) -> dict[str, Any]:
        """The whole policy as plain numbers and tensors, for ``torch.save``."""
        return {
            "kind": self.config.kind,
            "hidden": list(self.config.hidden),
            "obs_size": self.obs_size,
            "action_size": self.action_size,
            "horizon": self.horizon,
            "angles": list(self.angles),
            "table": None if self.table is None else torch.from_numpy(self.table.copy()),
            "state": {name: value.detach().cpu().clone() for name, value in self.state_dict().items()},
        }

    @classmethod
    def from_dict(cls, saved: dict[str, Any]) -> Policy:
        """The policy that ``to_dict`` saved."""
        policy = cls(
            PolicyConfig(kind=saved["kind"], hidden=tuple(saved["hidden"])),
            obs_size=saved["obs_size"],
            action_size=saved["action_size"],
            horizon=saved["horizon"],
            seed=0,
            table=None if saved["table"] is None else saved["table"].numpy(),
            angles=saved.get("angles", (1,)),
        )
        policy.load_state_dict(saved["state"])
        return policy


class ValueFunction(nn.Module):
    """V(s) of normalised inputs, in the units of the discounted reward.

    The network predicts normalised returns. When the running mean and deviation of the returns
    move, the last layer is rescaled so that the prediction stays what it was (PopArt, van Hasselt
    et al. 2016, eqs. 6-9): rewards may have any scale, and a learned reward may change it.

    Args:
        input_size: f.
        hidden: Widths of the tanh layers.
        seed: Of the initial weights.
        momentum: How much of the old mean and deviation stays at each update.
    """

    return_mean: torch.Tensor
    return_std: torch.Tensor
    updates: torch.Tensor

    def __init__(self, input_size: int, hidden: Sequence[int], *, seed: int, momentum: float = 0.8) -> None:
        super().__init__()
        # V = 0 at first, in any units: nothing depends on the scale of the rewards.
        self.net = mlp((input_size, *hidden, 1), 0.0, seed)
        self.momentum = momentum
        self.register_buffer("return_mean", torch.zeros(()))
        self.register_buffer("return_std", torch.ones(()))
        self.register_buffer("updates", torch.zeros(()))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """V, (B, f) to (B,)."""
        return self.normalised(inputs) * self.return_std + self.return_mean

    def normalised(self, inputs: torch.Tensor) -> torch.Tensor:
        """V in running standard deviations of the returns, (B, f) to (B,)."""
        return self.net(inputs).squeeze(-1)

    def rescale(self, returns: torch.Tensor) -> torch.Tensor:
        """Moves the running mean and deviation towards those of the returns, keeping V.

        Args:
            returns: Targets in reward units, (B,).

        Returns:
            The targets, normalised, (B,).
        """
        # The first batch sets the scale; from then on it moves slowly.
        keep = self.momentum if self.updates > 0 else 0.0
        mean = keep * self.return_mean + (1 - keep) * returns.mean()
        std = keep * self.return_std + (1 - keep) * returns.std(correction=0)
        std = std.clamp_min(1e-6)
        last = self.net[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            if self.updates > 0:
                last.weight.mul_(self.return_std / std)
                last.bias.mul_(self.return_std).add_(self.return_mean - mean).div_(std)
        self.return_mean.copy_(mean)
        self.return_std.copy_(std)
        self.updates.add_(1)
        return (returns - mean) / std


def check_device(device: str) -> None:
    """Raises UserError if torch cannot compute there, with what it can use."""
    if device == "cpu":
        return
    seen = [f"cuda:{n}" for n in range(torch.cuda.device_count())]
    if torch.device(device).index not in (None, *range(len(seen))) or not seen:
        there = ", ".join(["cpu", *seen])
        raise UserError(f"device {device}: this PyTorch cannot use it; choose one of: {there}")


def mlp(sizes: Sequence[int], last_gain: float, seed: int) -> nn.Sequential:
    """A tanh network with orthogonal weights (gain sqrt 2) and zero biases.

    Args:
        sizes: Inputs, hidden widths, outputs.
        last_gain: Gain of the last layer.
        seed: Of the weights; no global generator is touched.
    """
    generator = torch.Generator().manual_seed(seed)
    layers: list[nn.Module] = []
    for i, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
        last = i == len(sizes) - 2
        layer = cast(nn.Linear, nn.utils.skip_init(nn.Linear, fan_in, fan_out))
        gain = last_gain if last else math.sqrt(2)
        nn.init.orthogonal_(layer.weight, gain, generator)
        nn.init.zeros_(layer.bias)
        layers += [layer] if last else [layer, Tanh()]
    return nn.Sequential(*layers)


class Tanh(nn.Module):
    """Hyperbolic tangent; on the processor NumPy's, which is ten times as fast as PyTorch 2.13's.

    It took half of the time of a pass through these networks. Can be differentiated once.
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Of any shape, float32 or float64."""
        return torch.tanh(x) if x.device.type != "cpu" else _NumpyTanh.apply(x)  # type: ignore[no-any-return]


class _NumpyTanh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        y = torch.from_numpy(np.tanh(x.detach().numpy()))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(grad, y)
