"""A learned distance: the rating falls with the weighted distance between demo and robot.

What a demo frame shows of the robot (``trainer/appearance.py``) is compared with the robot's own pose
and motion. The ratings say how much each part of the difference matters, and at which distances a
point is lost:

    d(f, s)  = sqrt(sum_i w_i (track_i(f) - body_i(s))^2 + e)            distance of frame and state
    P(y > k) = sigmoid(g (t_k - mean of d over the clip)),  t_1 > t_2 > t_3 > t_4

the ordered logit of McCullagh 1980 (proportional odds) on a distance. 23 numbers in all, so a few dozen
ratings fit it; a network of thousands has to learn first that near is like.

A fit that starts from the numbers of another move (they say what the rater looks at, not what the demo
shows) is pulled to them, the less the more ratings there are.

Shapes: n clips, W control steps a clip, F demo frames, B = 18 body numbers (pose and motion), M members.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from trainer import body
from trainer.appearance import Track
from trainer.errors import UserError
from trainer.predictor import CLASSES, FitStats, PredictorConfig, Snapshot, View
from trainer.store import RatedSegment

_UPDATES = 300
_RATE = 0.03
_EVERY = 2
"""Every so many steps of a clip enter a fit: neighbours are alike."""
_PRIOR = np.repeat([-1.0, -2.0], body.POSE)
"""Log weights before any rating: a difference in pose counts more than one in motion."""
_PULL = 0.003
"""Of the penalty that holds log weights near the prior."""
_TRUST = 2.0
"""Of the penalty that holds all numbers near those of a start, over the number of ratings. As a prior it
is a standard deviation of 0.5: another move's weights are taken to be right within a factor of 1.6."""
_MOST, _LEAST = 3.0, 0.3
"""Limits of a class's weight in the loss; classes are weighed to count equally."""
_JUDGED_CLIPS = 2000


class MetricSnapshot(Snapshot):
    """Fitted distances.

    Args:
        number: 1, 2, ... within a run.
        config: How they were fitted.
        track: The demo.
        log_weights: Of each part of the difference, (M, B).
        thresholds: Distances at which ratings 5, 4, 3 and 2 end, ascending, (M, 4).
        steepness: g of each member, (M,).
    """

    def __init__(
        self, *, number: int, config: PredictorConfig, track: Track, log_weights: np.ndarray,
        thresholds: np.ndarray, steepness: np.ndarray,
    ) -> None:  # fmt: skip
        super().__init__(number=number, config=config)
        self.log_weights, self.thresholds, self.steepness = log_weights, thresholds, steepness
        self._track = track
        self._demo = np.concatenate([track.pose, track.motion], axis=-1)
        self._weights = np.exp(log_weights).T.astype(np.float32)

    def member_probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """As ``Snapshot.member_probabilities``; what the motors do does not matter."""
        distance = np.sqrt(np.square(self._demo[frames] - _body(obs)) @ self._weights + _TINY)
        above = self.steepness[:, None] * (self.thresholds - distance[..., None])
        above = 1 / (1 + np.exp(-np.clip(above, -30, 30)))  # (..., M, 4): P(y >= 5), ... P(y >= 2)
        whole = np.concatenate([np.zeros_like(above[..., :1]), above, np.ones_like(above[..., :1])], -1)
        return np.moveaxis(np.diff(whole, axis=-1)[..., ::-1], -2, 0).astype(np.float32)

    def beside(self, view: View) -> MetricSnapshot:
        """As ``Snapshot.beside``."""
        if view.track is None:
            raise UserError(
                "a predictor of kind 'metric' compares poses, and this demo shows no robot it knows"
            )
        return MetricSnapshot(
            number=0, config=self.config, track=view.track, log_weights=self.log_weights,
            thresholds=self.thresholds, steepness=self.steepness,
        )  # fmt: skip

    def tensors(self) -> dict[str, Any]:
        """The fitted numbers and the demo's track."""
        arrays = {
            "pose": self._track.pose, "motion": self._track.motion, "log_weights": self.log_weights,
            "thresholds": self.thresholds, "steepness": self.steepness,
        }  # fmt: skip
        return {name: torch.from_numpy(np.asarray(array)) for name, array in arrays.items()}


def restore(data: dict[str, Any], config: PredictorConfig, device: str) -> MetricSnapshot:
    """The snapshot whose ``tensors`` are in ``data``; it computes in NumPy whatever the device."""
    names = ("log_weights", "thresholds", "steepness")
    return MetricSnapshot(
        number=data["number"], config=config,
        track=Track(pose=data["pose"].numpy(), motion=data["motion"].numpy()),
        **{name: data[name].numpy() for name in names},
    )  # fmt: skip


def fit(
    ratings: Sequence[RatedSegment], frames: np.ndarray, view: View, config: PredictorConfig,
    *, number: int, seed: int, device: str = "cpu", start: Snapshot | None = None,
) -> tuple[MetricSnapshot, FitStats]:  # fmt: skip
    """Fits ``config.members`` distances by Adam, each on a bootstrap. As ``predictor.fit``.

    With a start, member i begins with the numbers of the start's member i and is pulled back to them.
    """
    assert start is None or isinstance(start, MetricSnapshot), "predictor.fit has checked it"
    assert view.track is not None, "a metric compares poses"
    generator = torch.Generator().manual_seed(seed)
    demo = np.concatenate([view.track.pose, view.track.motion], axis=-1)
    obs = np.stack([r.segment.obs[::_EVERY] for r in ratings])
    squares_nWB = torch.from_numpy(np.square(demo[frames[:, ::_EVERY]] - _body(obs)).astype(np.float32))
    classes_n = torch.tensor([r.value - 1 for r in ratings])
    counts = torch.bincount(classes_n, minlength=CLASSES).float()
    weights_n = (len(ratings) / (CLASSES * counts)).clamp(_LEAST, _MOST)[classes_n]
    members, losses = [], []
    for k in range(config.members):
        chosen = torch.arange(len(ratings))
        if config.members > 1:
            chosen = torch.randint(len(ratings), (len(ratings),), generator=generator)
        member, loss = _fit_one(squares_nWB[chosen], classes_n[chosen], weights_n[chosen], _known(start, k))
        members.append(member)
        losses.append(loss)
    log_weights, thresholds, steepness = (np.stack(column) for column in zip(*members, strict=True))
    snapshot = MetricSnapshot(
        number=number, config=config, track=view.track, log_weights=log_weights, thresholds=thresholds,
        steepness=steepness,
    )  # fmt: skip
    some = slice(None, None, -(-len(ratings) // _JUDGED_CLIPS))
    judged = [r.segment for r in ratings[some]]
    probabilities = snapshot.probabilities(
        frames[some], np.stack([s.obs for s in judged]), np.stack([s.actions for s in judged])
    )
    hit = probabilities.mean(axis=1).argmax(axis=-1) == classes_n[some].numpy()
    return snapshot, FitStats(loss=float(np.mean(losses)), accuracy=float(hit.mean()))


def _known(start: MetricSnapshot | None, member: int) -> tuple[torch.Tensor, ...] | None:
    """The free numbers of a start's member, as ``_fit_one`` has them."""
    if start is None:
        return None
    member %= len(start.steepness)
    thresholds = torch.from_numpy(start.thresholds[member].astype(np.float32))
    return (
        torch.from_numpy(start.log_weights[member].astype(np.float32)),
        thresholds[:1],
        thresholds.diff().clamp_min(_TINY).expm1().log(),  # softplus backwards
        torch.tensor([float(np.log(start.steepness[member]))]),
    )


def _fit_one(
    squares_nWB: torch.Tensor, classes_n: torch.Tensor, weights_n: torch.Tensor,
    known: tuple[torch.Tensor, ...] | None,
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], float]:  # fmt: skip
    prior = torch.from_numpy(_PRIOR.astype(np.float32))
    first = prior, torch.tensor([0.9]), torch.zeros(CLASSES - 2), torch.ones(1)
    numbers = [x.clone().requires_grad_() for x in known or first]
    log_weights, first_threshold, gaps, log_steepness = numbers
    optimiser = torch.optim.Adam(numbers, _RATE, fused=True)
    loss = torch.zeros(())
    for _ in range(_UPDATES):
        thresholds = _ascending(first_threshold, gaps)
        distance_n = (squares_nWB @ log_weights.exp() + _TINY).sqrt().mean(dim=1)
        logits = log_steepness.exp() * (thresholds - distance_n[:, None])
        above = torch.sigmoid(logits.flip(-1))  # P(y >= 2), ... P(y >= 5)
        one = torch.ones_like(above[:, :1])
        chances = torch.cat([one, above], -1) - torch.cat([above, 0 * one], -1)
        given = chances.gather(1, classes_n[:, None])[:, 0].clamp_min(1e-4)
        loss = -(weights_n * given.log()).mean()
        if known is None:
            penalty = _PULL * (log_weights - prior).square().sum()
        else:
            off = [(x - x0).square().sum() for x, x0 in zip(numbers, known, strict=True)]
            penalty = _TRUST / len(classes_n) * torch.stack(off).sum()
        optimiser.zero_grad()
        (loss + penalty).backward()
        optimiser.step()
    with torch.no_grad():
        fitted = log_weights, _ascending(first_threshold, gaps), log_steepness.exp()[0]
    return tuple(x.detach().numpy().copy() for x in fitted), float(loss.detach())  # type: ignore[return-value]


_TINY = 1e-4


def _ascending(first: torch.Tensor, gaps: torch.Tensor) -> torch.Tensor:
    return torch.cat([first, first + functional.softplus(gaps).cumsum(0)])


def _body(obs: np.ndarray) -> np.ndarray:
    return np.concatenate([body.pose(obs), body.motion(obs)], axis=-1)
