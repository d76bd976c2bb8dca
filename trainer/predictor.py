"""The similarity predictor: from a demo frame and a robot's state and action to a rating of 1 to 5.

The network of the paper's figure 2. Frame features enter one branch, state and action go through two
fully connected ReLU layers in the other; both are concatenated and pass a fully connected layer, one
additional fully connected layer and a softmax over the five ratings. It is trained on single
(frame, state-action) pairs, each with the rating of its clip, with batches that hold equally many
pairs of each rating.

Shapes: n clips, W control steps a clip, F demo frames, V visual dims, S = 15 standard dims.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from trainer.files import write_atomic
from trainer.store import RatedSegment

CLASSES = 5
STANDARD_DIMS = 15
_JUDGED_CLIPS = 2000
"""Clips behind ``FitStats.accuracy``, at most: a refit must not grow with the ratings."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PredictorConfig:
    """The network and how it is fitted. Defaults: the paper's best variant, "additional layer"."""

    sampling: str = "equal"
    """"equal": as many pairs of each rating in a batch; "random": as they come."""
    class_weights: bool = False
    """Weigh the loss of rare ratings more (the paper's third and fourth variant)."""
    additional_layer: bool = True
    """One more fully connected layer before the softmax (the paper's last variant)."""
    hidden: int = 64
    """Width of every layer."""
    visual_dims: int = 24
    """Principal components of the demo's frame features that enter; 0: all features, as in the paper."""
    learning_rate: float = 0.03
    """Of stochastic gradient descent with momentum 0.9."""
    weight_decay: float = 1e-4
    """L2 penalty."""
    batch_clips: int = 60
    """Clips in a batch."""
    pairs_per_clip: int = 4
    """(frame, state-action) pairs drawn from each of them."""
    updates: int = 1500
    """Gradient steps of one fit."""
    reward: str = "expected"
    """"expected" rating, 1..5 in between; or "argmax", the most probable class."""

    def __post_init__(self) -> None:
        if self.sampling not in ("equal", "random"):
            raise ValueError(f'predictor.sampling must be "equal" or "random", got {self.sampling!r}')
        if self.reward not in ("expected", "argmax"):
            raise ValueError(f'predictor.reward must be "expected" or "argmax", got {self.reward!r}')
        for name in ("hidden", "batch_clips", "pairs_per_clip", "updates"):
            if getattr(self, name) < 1:
                raise ValueError(f"predictor.{name} must be at least 1, got {getattr(self, name)}")
        if self.visual_dims < 0:
            raise ValueError(f"predictor.visual_dims must be 0 or more, got {self.visual_dims}")
        if self.learning_rate <= 0:
            raise ValueError(f"predictor.learning_rate must be > 0, got {self.learning_rate}")


def standard_inputs(obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """State and action as the predictor sees them.

    The torso angle enters as sine and cosine, because a robot after one turn looks as before it;
    velocities are scaled to the size of the rest; actions are clipped to what the motors apply.

    Args:
        obs: Observations, (..., 11).
        actions: Actions, (..., 3).

    Returns:
        (..., S), float32.
    """
    angle = obs[..., 1:2]
    parts = (
        obs[..., :1],
        np.sin(angle),
        np.cos(angle),
        obs[..., 2:5],
        0.2 * obs[..., 5:],
        np.clip(actions, -1, 1),
    )
    return np.concatenate(parts, axis=-1).astype(np.float32)


def visual_inputs(features: np.ndarray, dims: int) -> np.ndarray:
    """Frame features as the predictor sees them: centred, and turned onto their principal components.

    Departs from the paper, which feeds all 4096 features: with a few hundred ratings, the few
    directions in which one demo's frames differ are all that can be learned from. No rating and no
    state enters. ``dims=0`` keeps every feature, standardised.

    Args:
        features: Frame features of the demo, (F, D).
        dims: Components to keep, V; 0 keeps D.

    Returns:
        (F, V), float32, of about unit variance in the first component.
    """
    centred = features.astype(np.float64) - features.mean(axis=0)
    if dims == 0:
        return (centred / (centred.std(axis=0) + 1e-6)).astype(np.float32)
    # By the frames' inner products: a demo has fewer frames than a frame has features.
    squares, vectors = np.linalg.eigh(centred @ centred.T)
    order = np.argsort(squares)[::-1][: min(dims, features.shape[1])]
    components = vectors[:, order] * np.sqrt(np.maximum(squares[order], 0.0))
    # The sign of an eigenvector is open: fix it, so that two machines agree on what a snapshot's inputs mean.
    components *= np.where(
        components[np.abs(components).argmax(axis=0), np.arange(components.shape[1])] < 0, -1, 1
    )
    return (components / (components[:, 0].std() + 1e-12)).astype(np.float32)


class SimilarityNet(nn.Module):
    """The two-branch network. Concatenation and the layer after it are written as a sum of two maps.

    ``W [v; s] + b = W_v v + (W_s s + b)``: the same function, but the visual part depends on the
    frame alone and can be worked out once per demo.
    """

    def __init__(self, visual_dims: int, config: PredictorConfig, generator: torch.Generator) -> None:
        super().__init__()
        hidden = config.hidden
        self.standard = nn.Sequential(
            _linear(STANDARD_DIMS, hidden), nn.ReLU(), _linear(hidden, hidden), nn.ReLU()
        )
        self.fuse_visual = _linear(visual_dims, hidden, bias=False)
        self.fuse_standard = _linear(hidden, hidden)
        layers: list[nn.Module] = [nn.ReLU()]
        if config.additional_layer:
            layers += [_linear(hidden, hidden), nn.ReLU()]
        self.head = nn.Sequential(*layers, _linear(hidden, CLASSES))
        for module in self.modules():
            if isinstance(module, nn.Linear):
                bound = module.in_features**-0.5
                nn.init.uniform_(module.weight, -bound, bound, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def forward(self, visual: torch.Tensor, standard: torch.Tensor) -> torch.Tensor:
        """Logits of the five ratings, (..., 5), for visual (..., V) and standard inputs (..., S)."""
        return self.head(self.fuse_visual(visual) + self.fuse_standard(self.standard(standard)))


class Snapshot:
    """An immutable, numbered predictor for one demo: what scores rollouts.

    Args:
        number: 1, 2, ... within a run.
        config: How it was fitted.
        net: The fitted network; not to be changed afterwards.
        visual: Visual inputs of the demo's frames, (F, V).
        mean: Mean of the standard inputs it was fitted on, (S,).
        std: Their standard deviation, (S,).
    """

    def __init__(
        self, *, number: int, config: PredictorConfig, net: SimilarityNet, visual: np.ndarray,
        mean: np.ndarray, std: np.ndarray,
    ) -> None:  # fmt: skip
        self.number = number
        self.config = config
        self._net = net.eval().requires_grad_(False)
        self._visual = visual
        self._mean, self._std = mean, std
        self._device = net.fuse_visual.weight.device
        self._folded = net.fuse_visual(torch.from_numpy(visual).to(self._device))

    def probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Probability of each rating.

        Args:
            frames: Index of the demo frame shown, (...), integers.
            obs: Observations of the robot, (..., 11).
            actions: Its actions, (..., 3).

        Returns:
            (..., 5), float32, for ratings 1 to 5.
        """
        inputs = (standard_inputs(obs, actions) - self._mean) / self._std
        flat = torch.from_numpy(inputs.reshape(-1, STANDARD_DIMS)).to(self._device)
        index = torch.from_numpy(np.ascontiguousarray(frames).reshape(-1).astype(np.int64)).to(self._device)
        with torch.inference_mode():
            fused = self._net.fuse_standard(self._net.standard(flat)) + self._folded[index]
            probabilities = functional.softmax(self._net.head(fused), dim=-1)
        return probabilities.cpu().numpy().reshape(*frames.shape, CLASSES)

    def ratings(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The predicted rating of each pair, (...), 1..5: the reward. Arguments as ``probabilities``."""
        probabilities = self.probabilities(frames, obs, actions)
        if self.config.reward == "argmax":
            return probabilities.argmax(axis=-1).astype(np.float32) + 1.0
        return probabilities @ np.arange(1, CLASSES + 1, dtype=np.float32)

    def save(self, path: Path) -> None:
        """Writes the snapshot, whole or not at all."""
        buffer = io.BytesIO()
        torch.save(
            {
                "number": self.number,
                "config": asdict(self.config),
                "net": {name: x.cpu() for name, x in self._net.state_dict().items()},
                "visual": torch.from_numpy(self._visual),
                "mean": torch.from_numpy(self._mean),
                "std": torch.from_numpy(self._std),
            },
            buffer,
        )
        write_atomic(path, buffer.getvalue())

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> Snapshot:
        """Reads what ``save`` wrote, onto a torch device; runs no code from the file."""
        data = torch.load(path, weights_only=True)
        config = PredictorConfig(**data["config"])
        net = SimilarityNet(data["visual"].shape[1], config, torch.Generator())
        net.load_state_dict(data["net"])
        return cls(
            number=data["number"], config=config, net=net.to(device), visual=data["visual"].numpy(),
            mean=data["mean"].numpy(), std=data["std"].numpy(),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class FitStats:
    """How a fit went, on the ratings it was fitted on."""

    loss: float
    """Cross-entropy of the last tenth of the updates, nats."""
    accuracy: float
    """Share of clips whose most probable rating, averaged over the clip, is the one given; of 2,000
    clips spread evenly where there are more."""


def fit(
    ratings: Sequence[RatedSegment], frames: np.ndarray, visual: np.ndarray, config: PredictorConfig,
    *, number: int, seed: int, device: str = "cpu",
) -> tuple[Snapshot, FitStats]:  # fmt: skip
    """Fits a predictor from scratch on all ratings: the same ratings and seed give the same weights.

    Args:
        ratings: n rated segments, all of W steps.
        frames: Index of the demo frame at each step of each segment, (n, W).
        visual: Visual inputs of the demo's frames, (F, V).
        config: How.
        number: The snapshot's number.
        seed: Of the initial weights and of the batches.
        device: Where torch computes; what is drawn at random is the same everywhere.

    Returns:
        The snapshot and how the fit went.

    Raises:
        ValueError: If there is no rating.
    """
    if not ratings:
        raise ValueError("a similarity predictor needs at least one rating")
    generator = torch.Generator().manual_seed(seed)
    obs, actions = (np.stack([getattr(r.segment, name) for r in ratings]) for name in ("obs", "actions"))
    inputs = standard_inputs(obs, actions)
    mean, std = inputs.mean(axis=(0, 1)), inputs.std(axis=(0, 1)) + 0.05
    standard_nWS = torch.from_numpy((inputs - mean) / std).to(device)
    # Looked up frame by frame: with many ratings the visual inputs of all pairs would fill the memory.
    frames_nW = torch.from_numpy(frames.astype(np.int64)).to(device)
    visual_FV = torch.from_numpy(visual).to(device)
    classes_n = torch.tensor([r.value - 1 for r in ratings])
    net = SimilarityNet(visual.shape[1], config, generator).to(device)
    optimiser = torch.optim.SGD(
        net.parameters(), lr=config.learning_rate, momentum=0.9, weight_decay=config.weight_decay, fused=True
    )
    counts = torch.bincount(classes_n, minlength=CLASSES)
    weights = class_weights(counts).to(device) if config.class_weights else None
    chance_n = (1.0 / counts[classes_n]) if config.sampling == "equal" else torch.ones(len(ratings))
    clips, pairs = config.updates * config.batch_clips, config.pairs_per_clip
    drawn = torch.multinomial(chance_n, clips, replacement=True, generator=generator)
    steps = torch.randint(standard_nWS.shape[1], (clips, pairs), generator=generator)
    drawn, steps, classes_n = drawn.to(device), steps.to(device), classes_n.to(device)
    losses = []
    for update, (clip, step) in enumerate(
        zip(drawn.split(config.batch_clips), steps.split(config.batch_clips), strict=True)
    ):
        # The learning rate falls to 0 along half a cosine (Loshchilov and Hutter 2017, eq. 5).
        fall = 0.5 * (1 + math.cos(math.pi * update / config.updates))
        optimiser.param_groups[0]["lr"] = config.learning_rate * fall
        pair = (clip[:, None], step)
        logits = net(visual_FV[frames_nW[pair]], standard_nWS[pair])
        target = classes_n[clip].repeat_interleave(pairs)
        loss = functional.cross_entropy(logits.flatten(0, 1), target, weight=weights)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.detach())
    snapshot = Snapshot(number=number, config=config, net=net, visual=visual, mean=mean, std=std)
    some = slice(None, None, -(-len(ratings) // _JUDGED_CLIPS))
    with torch.inference_mode():
        logits = net(visual_FV[frames_nW[some]], standard_nWS[some])
        chosen = functional.softmax(logits, dim=-1).mean(dim=1).argmax(dim=-1)
    hit = (chosen == classes_n[some]).float().mean().item()
    tail = torch.stack(losses[-max(1, config.updates // 10) :])
    return snapshot, FitStats(loss=float(tail.mean()), accuracy=hit)


def class_weights(counts: torch.Tensor) -> torch.Tensor:
    """Weight of each class in the loss: the inverse of its share, at most 10; 0 for an absent class.

    Args:
        counts: Ratings of each class, (5,).

    Returns:
        (5,), float32.
    """
    present = counts > 0
    weights = counts.sum() / (present.sum() * counts.clamp(min=1).float())
    return torch.where(present, weights, torch.zeros(())).clamp(max=10.0)


def _linear(inputs: int, outputs: int, bias: bool = True) -> nn.Linear:
    """A layer without values yet: the usual initialisation would draw from torch's global generator."""
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, bias=bias)
    assert isinstance(layer, nn.Linear)
    return layer
