"""The paper's similarity predictor: the two-branch network of its figure 2.

Frame features enter one branch, state and action go through two fully connected ReLU layers in the
other; both are concatenated and pass a fully connected layer, one additional fully connected layer and
a softmax over the five ratings. It is trained on single (frame, state-action) pairs, each with the
rating of its clip, with batches that hold equally many pairs of each rating.

Shapes: n clips, W control steps a clip, F demo frames, V visual dims, S standard dims, of a hopper 15.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from onedemo.core import optimisers
from onedemo.errors import UserError
from onedemo.reward.model import CLASSES, FitStats, Lens, PredictorConfig, Snapshot, View
from onedemo.reward.segment_marks import split_marks
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import without_turns
from onedemo.storage.rating_records import RatedSegment

_JUDGED_CLIPS = 2000
"""Clips behind ``FitStats.accuracy``, at most: a refit must not grow with the ratings."""
_BOOTSTRAP = 0.85
"""Share of the clips that each of several members sees."""
_TUNED = 0.3
"""Share of the learning rate with which a network from another move is fine-tuned: its ratings are many
more than the new ones, so what it knows should not be thrown about."""
_ORDINAL_FALL = 1.5
"""Nats by which a rating is less right than the one next to it that is nearer to the one given."""


def standard_inputs(obs: np.ndarray, actions: np.ndarray, robot: str = "hopper") -> np.ndarray:
    """State and action as the predictor sees them.

    Angles without an end, such as a torso's, enter as sine and cosine, because a robot after one turn looks
    as before it; velocities are scaled to the size of the rest; actions are clipped to what the motors apply.

    Args:
        obs: Observations, (..., o).
        actions: Actions, (..., a).
        robot: Name of the robot.

    Returns:
        (..., S), float32.
    """
    of = robot_named(robot)
    seen = without_turns(of, obs)
    at, speeds = np.split(seen, [seen.shape[-1] - of.velocities], axis=-1)
    return np.concatenate([at, _SPEED * speeds, np.clip(actions, -1, 1)], axis=-1).astype(np.float32)


def standard_size(robot: str) -> int:
    """S of a robot."""
    of = robot_named(robot)
    return of.obs_size + len(of.angles) + of.action_size


_SPEED = 0.2
"""A metre or radian per second, beside positions."""


class SimilarityNet(nn.Module):
    """The two-branch network. Concatenation and the layer after it are written as a sum of two maps.

    ``W [v; s] + b = W_v v + (W_s s + b)``: the same function, but the visual part depends on the
    frame alone and can be worked out once per demo.
    """

    def __init__(
        self, visual_dims: int, standard_dims: int, config: PredictorConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        hidden = config.hidden
        self.standard = nn.Sequential(
            _linear(standard_dims, hidden), nn.ReLU(), _linear(hidden, hidden), nn.ReLU()
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


class NetworkSnapshot(Snapshot):
    """One or more fitted networks.

    Args:
        number: 1, 2, ... within a run.
        config: How they were fitted.
        nets: The networks; not to be changed afterwards.
        visual: Visual inputs of the demo's frames, (F, V).
        mean: Mean of the standard inputs they were fitted on, (S,).
        std: Their standard deviation, (S,).
        lens: How the visual inputs were made; None if that is not known.
        robot: Name of the robot.
    """

    def __init__(
        self, *, number: int, config: PredictorConfig, nets: Sequence[SimilarityNet], visual: np.ndarray,
        mean: np.ndarray, std: np.ndarray, lens: Lens | None, robot: str,
    ) -> None:  # fmt: skip
        super().__init__(number=number, config=config)
        self.nets = [net.eval().requires_grad_(False) for net in nets]
        self.mean, self.std = mean, std
        self.lens, self._robot = lens, robot
        self._visual = visual
        self._device = nets[0].fuse_visual.weight.device
        seen = torch.from_numpy(visual).to(self._device)
        self._folded = [net.fuse_visual(seen) for net in self.nets]

    def member_probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """As ``Snapshot.member_probabilities``."""
        standard = standard_inputs(obs, actions, self._robot)
        inputs = torch.from_numpy((standard - self.mean) / self.std).to(self._device)
        index = torch.from_numpy(np.ascontiguousarray(frames).astype(np.int64)).to(self._device)
        with torch.inference_mode():
            members = []
            for net, folded in zip(self.nets, self._folded, strict=True):
                fused = net.fuse_standard(net.standard(inputs)) + folded[index]
                members.append(functional.softmax(net.head(fused), dim=-1).cpu().numpy())
        return np.stack(members)

    def beside(self, view: View) -> NetworkSnapshot:
        """As ``Snapshot.beside``; the view is through this snapshot's lens."""
        return NetworkSnapshot(
            number=0, config=self.config, nets=self.nets, visual=view.visual, mean=self.mean, std=self.std,
            lens=self.lens, robot=self._robot,
        )  # fmt: skip

    def tensors(self) -> dict[str, Any]:
        """Weights, scales and lens."""
        arrays = {"visual": self._visual, "mean": self.mean, "std": self.std}
        if self.lens is not None:
            arrays |= {"lens_mean": self.lens.mean, "lens_axes": self.lens.axes}
        nets = [{name: x.cpu() for name, x in net.state_dict().items()} for net in self.nets]
        return {
            "nets": nets,
            "robot": self._robot,
            **{name: torch.from_numpy(array) for name, array in arrays.items()},
        }


def restore(data: dict[str, Any], config: PredictorConfig, device: str) -> NetworkSnapshot:
    """The snapshot whose ``tensors`` are in ``data``."""
    nets = []
    for weights in data["nets"] if "nets" in data else [data["net"]]:
        net = SimilarityNet(data["visual"].shape[1], len(data["mean"]), config, torch.Generator())
        net.load_state_dict(weights)
        nets.append(net.to(device))
    lens = None
    if "lens_mean" in data:  # snapshots of before one could start from another have none
        lens = Lens(mean=data["lens_mean"].numpy(), axes=data["lens_axes"].numpy())
    return NetworkSnapshot(
        number=data["number"], config=config, nets=nets, visual=data["visual"].numpy(),
        mean=data["mean"].numpy(), std=data["std"].numpy(), lens=lens,
        robot=data.get("robot", "hopper"),
    )  # fmt: skip


def fit(
    ratings: Sequence[RatedSegment], frames: np.ndarray, view: View, config: PredictorConfig,
    *, number: int, seed: int, device: str = "cpu", start: Snapshot | None = None,
) -> tuple[NetworkSnapshot, FitStats]:  # fmt: skip
    """Fits ``config.members`` networks. Arguments and result as ``predictor.fit``.

    With a start, member i begins with the weights of the start's member i (and its input scales), and
    all of them are fine-tuned, as in the paper.
    """
    assert start is None or isinstance(start, NetworkSnapshot), "predictor.fit has checked it"
    generator = torch.Generator().manual_seed(seed)
    ratings, frames = split_marks(ratings, frames)
    obs, actions = (np.stack([getattr(r.segment, name) for r in ratings]) for name in ("obs", "actions"))
    inputs = standard_inputs(obs, actions, view.robot)
    mean, std = inputs.mean(axis=(0, 1)), inputs.std(axis=(0, 1)) + 0.05
    if start is not None:
        mean, std = start.mean, start.std
    standard_nWS = torch.from_numpy((inputs - mean) / std).to(device)
    # Looked up frame by frame: with many ratings the visual inputs of all pairs would fill the memory.
    frames_nW = torch.from_numpy(frames.astype(np.int64)).to(device)
    visual_FV = torch.from_numpy(view.visual).to(device)
    classes_n = torch.tensor([r.value - 1 for r in ratings])
    nets, losses = [], []
    for member in range(config.members):
        net = SimilarityNet(view.visual.shape[1], inputs.shape[-1], config, generator).to(device)
        if start is not None:
            _take_weights(net, start, member)
        rate = config.learning_rate * (1.0 if start is None else _TUNED)
        loss = _fit_one(net, standard_nWS, frames_nW, visual_FV, classes_n, config, rate, generator, device)
        nets.append(net)
        losses.append(loss)
    snapshot = NetworkSnapshot(
        number=number, config=config, nets=nets, visual=view.visual, mean=mean, std=std,
        lens=view.lens, robot=view.robot,
    )  # fmt: skip
    some = slice(None, None, -(-len(ratings) // _JUDGED_CLIPS))
    chosen = snapshot.probabilities(frames[some], obs[some], actions[some]).mean(axis=1).argmax(axis=-1)
    hit = float((chosen == classes_n[some].numpy()).mean())
    return snapshot, FitStats(loss=float(np.mean(losses)), accuracy=hit)


def _take_weights(net: SimilarityNet, start: NetworkSnapshot, member: int) -> None:
    weights = start.nets[member % len(start.nets)].state_dict()
    if weights["fuse_visual.weight"].shape != net.fuse_visual.weight.shape:
        raise UserError(
            f"the predictor to start from sees {weights['fuse_visual.weight'].shape[1]} numbers of a frame, "
            f"this run {net.fuse_visual.weight.shape[1]}: use the same encoder and predictor.visual_dims"
        )
    net.load_state_dict(weights)


def _fit_one(
    net: SimilarityNet, standard_nWS: torch.Tensor, frames_nW: torch.Tensor, visual_FV: torch.Tensor,
    classes_n: torch.Tensor, config: PredictorConfig, rate: float, generator: torch.Generator, device: str,
) -> float:  # fmt: skip
    """Trains one network; its mean loss over the last tenth of the updates."""
    optimiser = optimisers.SGD(
        net.parameters(), lr=rate, momentum=0.9, weight_decay=config.weight_decay, fused=True
    )
    counts = torch.bincount(classes_n, minlength=CLASSES)
    weights = class_weights(counts).to(device) if config.class_weights else None
    chance_n = (1.0 / counts[classes_n]) if config.sampling == "equal" else torch.ones(len(classes_n))
    if config.members > 1:
        seen_n = torch.rand(len(classes_n), generator=generator) < _BOOTSTRAP
        chance_n = torch.where(seen_n, chance_n, 0.0) if seen_n.any() else chance_n
    clips, pairs = config.updates * config.batch_clips, config.pairs_per_clip
    drawn = torch.multinomial(chance_n, clips, replacement=True, generator=generator)
    steps = torch.randint(standard_nWS.shape[1], (clips, pairs), generator=generator)
    drawn, steps = drawn.to(device), steps.to(device)
    targets_n5 = _targets(classes_n, config.ordinal).to(device)
    losses = []
    for update, (clip, step) in enumerate(
        zip(drawn.split(config.batch_clips), steps.split(config.batch_clips), strict=True)
    ):
        # The learning rate falls to 0 along half a cosine (Loshchilov and Hutter 2017, eq. 5).
        fall = 0.5 * (1 + math.cos(math.pi * update / config.updates))
        optimiser.param_groups[0]["lr"] = rate * fall
        pair = (clip[:, None], step)
        logits = net(visual_FV[frames_nW[pair]], standard_nWS[pair]).flatten(0, 1)
        target = targets_n5[clip].repeat_interleave(pairs, dim=0)
        target = target if config.ordinal else target.argmax(dim=-1)
        loss = functional.cross_entropy(logits, target, weight=weights)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.detach())
    return float(torch.stack(losses[-max(1, config.updates // 10) :]).mean())


def _targets(classes_n: torch.Tensor, ordinal: bool) -> torch.Tensor:
    """Probability of each rating that the loss asks for, (n, 5).

    Ordinal: it falls by a factor with each step away from the rating given (the soft labels of Diaz and
    Marathe 2019, with the distance between ranks as the metric).
    """
    if not ordinal:
        return functional.one_hot(classes_n, CLASSES).float()
    away = (torch.arange(CLASSES)[None] - classes_n[:, None]).abs().float()
    return functional.softmax(-_ORDINAL_FALL * away, dim=-1)


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
