"""A learned distance: the rating falls with the weighted distance between demo and robot.

The demo's track, pose and motion of the robot in each frame, is compared with the robot's own. The
ratings say how much each part of the difference matters, and at which distances a point is lost:

    d(f, s)  = sqrt(sum_i w_i (track_i(f) - body_i(s))^2 + e)            distance of frame and state
    P(y > k) = sigmoid(g (t_k - mean of d over the clip)),  t_1 > t_2 > t_3 > t_4

the ordered logit of McCullagh 1980 (proportional odds) on a distance. Where the rater has marked a part
of a clip as wrong, that part is taken to be further off than the rest, with the probability
sigmoid(g (mean of d inside - mean outside)). Where the track is seen
(``trainer/vision/silhouette.py``) that is 23 numbers, so a few dozen ratings fit it; a network of
thousands has
to learn first that near is like. Where it is not, the track itself is fitted to the ratings, too
(``trainer/reward/latent_track.py``).

A fit that starts from the numbers of another move (they say what the rater looks at, not what the demo
shows) is pulled to them, the less the more ratings there are.

Shapes: n clips, W control steps a clip, F demo frames, B = 18 body numbers (pose and motion), M members.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from onedemo.core import optimisers
from onedemo.reward.latent_track import track_of
from onedemo.reward.model import CLASSES, FitStats, PredictorConfig, Snapshot, View, expected
from onedemo.reward.segment_marks import marked_steps
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.storage.rating_records import RatedSegment

_UPDATES = 300
_RATE = 0.03
_EVERY = 2
"""Every so many steps of a clip enter a fit: neighbours are alike."""
_EVERY_IMAGINED = 7
"""The same where the track is fitted, too, which takes longer."""
_SPREAD = 0.3
"""Of the weights of an imagined track to begin with."""
_RIDGE = 0.004
"""Of the penalty on them, a standard normal prior for about 125 ratings."""
_PRIOR = (-1.0, -2.0)
"""Log weights before any rating: a difference in pose counts more than one in motion."""
_PULL = 0.003
"""Of the penalty that holds log weights near the prior."""
_TRUST = 8.0
"""Of the penalty that holds all numbers near those of a start, over the number of ratings. As a prior it
is a standard deviation of 0.25: another move's weights are taken to be right within a factor of 1.3."""
_MOST, _LEAST = 3.0, 0.3
"""Limits of a class's weight in the loss; classes are weighed to count equally."""
_TINY = 1e-4
"""Under the root: its slope must be finite where nothing differs."""
_JUDGED_CLIPS = 2000


class MetricSnapshot(Snapshot):
    """Fitted distances.

    Args:
        number: 1, 2, ... within a run.
        config: How they were fitted.
        tracks: The demo as each member sees it, (M, F, B), or (1, F, B) if all see the same.
        log_weights: Of each part of the difference, (M, B).
        thresholds: Distances at which ratings 5, 4, 3 and 2 end, ascending, (M, 4).
        steepness: g of each member, (M,).
        robot: Name of the robot.
    """

    def __init__(
        self, *, number: int, config: PredictorConfig, tracks: np.ndarray, log_weights: np.ndarray,
        thresholds: np.ndarray, steepness: np.ndarray, robot: str = "hopper",
    ) -> None:  # fmt: skip
        super().__init__(number=number, config=config)
        self.log_weights, self.thresholds, self.steepness = log_weights, thresholds, steepness
        self._tracks = tracks
        self._robot = robot
        self._weights = np.exp(log_weights).astype(np.float32)

    def member_probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """As ``Snapshot.member_probabilities``; what the motors do does not matter."""
        robot = _body(self._robot, obs)
        if len(self._tracks) == 1:
            squares = np.square(self._tracks[0][frames] - robot) @ self._weights.T
        else:
            members = zip(self._tracks, self._weights, strict=True)
            squares = np.stack([np.square(track[frames] - robot) @ w for track, w in members], axis=-1)
        return self._chances(np.sqrt(squares + _TINY))

    def _chances(self, distance: np.ndarray) -> np.ndarray:
        """Probability of each rating at distances by each member, (..., M) to (M, ..., 5), float32."""
        above = self.steepness[:, None] * (self.thresholds - distance[..., None])
        above = 1 / (1 + np.exp(-np.clip(above, -30, 30)))  # (..., M, 4): P(y >= 5), ... P(y >= 2)
        whole = np.concatenate([np.zeros_like(above[..., :1]), above, np.ones_like(above[..., :1])], -1)
        return np.moveaxis(np.diff(whole, axis=-1)[..., ::-1], -2, 0).astype(np.float32)

    def best(self) -> float:
        """As ``Snapshot.best``: the rating at distance zero."""
        nothing = np.full(len(self.steepness), np.sqrt(_TINY), self._weights.dtype)
        return float(expected(self._chances(nothing)).mean())

    def beside(self, view: View) -> MetricSnapshot | None:
        """As ``Snapshot.beside``; an imagined track cannot be known before the first rating."""
        if view.track is None:
            return None
        return MetricSnapshot(
            number=0, config=self.config, tracks=_seen(view)[None], log_weights=self.log_weights,
            thresholds=self.thresholds, steepness=self.steepness, robot=self._robot,
        )  # fmt: skip

    def tensors(self) -> dict[str, Any]:
        """The fitted numbers and the demo's tracks."""
        arrays = {
            "tracks": self._tracks, "log_weights": self.log_weights,
            "thresholds": self.thresholds, "steepness": self.steepness,
        }  # fmt: skip
        tensors = {name: torch.from_numpy(np.asarray(array)) for name, array in arrays.items()}
        return tensors | {"robot": self._robot}


def restore(data: dict[str, Any], config: PredictorConfig, device: str) -> MetricSnapshot:
    """The snapshot whose ``tensors`` are in ``data``; it computes in NumPy whatever the device."""
    names = ("tracks", "log_weights", "thresholds", "steepness")
    return MetricSnapshot(
        number=data["number"],
        config=config,
        robot=data.get("robot", "hopper"),
        **{name: data[name].numpy() for name in names},
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Clips:
    """What a fit looks at: a few steps of each of n clips."""

    frames: torch.Tensor
    """(n, W'), demo frames."""
    robot: torch.Tensor
    """(n, W', B)."""
    classes: torch.Tensor
    """(n,), 0..4."""
    weights: torch.Tensor
    """(n,), in the loss."""
    inside: torch.Tensor
    """Steps where the rater said that it goes wrong, (n, W'), 0 or 1."""

    def take(self, index: torch.Tensor) -> _Clips:
        return _Clips(
            frames=self.frames[index], robot=self.robot[index], classes=self.classes[index],
            weights=self.weights[index], inside=self.inside[index],
        )  # fmt: skip


def fit(
    ratings: Sequence[RatedSegment], frames: np.ndarray, view: View, config: PredictorConfig,
    *, number: int, seed: int, device: str = "cpu", start: Snapshot | None = None,
) -> tuple[MetricSnapshot, FitStats]:  # fmt: skip
    """Fits ``config.members`` distances by Adam, each on a bootstrap. As ``predictor.fit``.

    An imagined track may fit the same ratings in many ways: there are twice as many members then.
    With a start, member i begins with the numbers of the start's member i and is pulled back to them.
    """
    assert start is None or isinstance(start, MetricSnapshot), "predictor.fit has checked it"
    generator = torch.Generator().manual_seed(seed)
    seen = view.track is not None
    every = _EVERY if seen else _EVERY_IMAGINED
    classes_n = torch.tensor([r.value - 1 for r in ratings])
    counts = torch.bincount(classes_n, minlength=CLASSES).float()
    clips = _Clips(
        frames=torch.from_numpy(frames[:, every // 2 :: every].astype(np.int64)),
        robot=torch.from_numpy(
            _body(view.robot, np.stack([r.segment.obs[every // 2 :: every] for r in ratings]))
        ),
        classes=classes_n,
        weights=(len(ratings) / (CLASSES * counts)).clamp(_LEAST, _MOST)[classes_n],
        inside=torch.from_numpy(np.stack([marked_steps(r)[every // 2 :: every] for r in ratings])),
    )
    members, losses = [], []
    for k in range(config.members if seen else 2 * config.members):
        chosen = torch.arange(len(ratings))
        if config.members > 1:
            chosen = torch.randint(len(ratings), (len(ratings),), generator=generator)
        member, loss = _fit_one(clips.take(chosen), view, generator, _known(start, k))
        members.append(member)
        losses.append(loss)
    tracks, log_weights, thresholds, steepness = (np.stack(column) for column in zip(*members, strict=True))
    snapshot = MetricSnapshot(
        number=number, config=config, tracks=tracks[:1] if seen else tracks, log_weights=log_weights,
        thresholds=thresholds, steepness=steepness, robot=view.robot,
    )  # fmt: skip
    some = slice(None, None, -(-len(ratings) // _JUDGED_CLIPS))
    judged = [r.segment for r in ratings[some]]
    probabilities = snapshot.probabilities(
        frames[some], np.stack([s.obs for s in judged]), np.stack([s.actions for s in judged])
    )
    hit = probabilities.mean(axis=1).argmax(axis=-1) == classes_n[some].numpy()
    return snapshot, FitStats(loss=float(np.mean(losses)), accuracy=float(hit.mean()))


def _known(start: MetricSnapshot | None, member: int) -> tuple[torch.Tensor, ...] | None:
    """The numbers of a start's member, the track left out, as they are free in a fit."""
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
    clips: _Clips, view: View, generator: torch.Generator, known: tuple[torch.Tensor, ...] | None
) -> tuple[tuple[np.ndarray, ...], float]:
    """One member: its track, log weights, thresholds and steepness, and the loss it ended with."""
    size = body_of(robot_named(view.robot)).pose_size
    prior = torch.tensor(_PRIOR, dtype=torch.float32).repeat_interleave(size)
    usual = prior, torch.tensor([0.9]), torch.zeros(CLASSES - 2), torch.ones(1)
    numbers = [x.clone().requires_grad_() for x in known or usual]
    log_weights, first, gaps, log_steepness = numbers
    parameters = list(numbers)
    basis = torch.from_numpy(view.basis)
    places = torch.zeros(0)
    track = squares = torch.zeros(0)
    if view.track is not None:
        track = torch.from_numpy(_seen(view))
        squares = (track[clips.frames] - clips.robot).square()
    else:
        places = _SPREAD * torch.randn(
            basis.shape[1], body_of(robot_named(view.robot)).pose_size, generator=generator
        )
        parameters.append(places.requires_grad_())
    optimiser = optimisers.Adam(parameters, _RATE, fused=True)
    schedule = None
    if view.track is None:  # many more numbers: large steps first, small ones in the end
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2 * _RATE, total_steps=_UPDATES)
    loss = torch.zeros(())
    marked = (clips.inside.sum(1) > 0) & (clips.inside.sum(1) < clips.inside.shape[1])
    for _ in range(_UPDATES):
        if view.track is None:
            track = track_of(basis, places, view.fps)
            squares = (track[clips.frames] - clips.robot).square()
        thresholds = _ascending(first, gaps)
        distance_nW = (squares @ log_weights.exp() + _TINY).sqrt()
        distance_n = distance_nW.mean(dim=1)
        logits = log_steepness.exp() * (thresholds - distance_n[:, None])
        above = torch.sigmoid(logits.flip(-1))  # P(y >= 2), ... P(y >= 5)
        one = torch.ones_like(above[:, :1])
        chances = torch.cat([one, above], -1) - torch.cat([above, 0 * one], -1)
        given = chances.gather(1, clips.classes[:, None])[:, 0].clamp_min(1e-4)
        loss = -(clips.weights * given.log()).mean()
        if marked.any():
            within = (distance_nW * clips.inside).sum(1) / clips.inside.sum(1).clamp_min(1)
            without = (distance_nW * (1 - clips.inside)).sum(1) / (1 - clips.inside).sum(1).clamp_min(1)
            further = functional.logsigmoid(log_steepness.exp() * (within - without))[marked]
            loss = loss - further.sum() / len(marked)
        if known is None:
            penalty = _PULL * (log_weights - prior).square().sum()
        else:
            off = [(x - x0).square().sum() for x, x0 in zip(numbers, known, strict=True)]
            penalty = _TRUST / len(clips.classes) * torch.stack(off).sum()
        penalty = penalty + _RIDGE * places.square().sum()
        optimiser.zero_grad()
        (loss + penalty).backward()
        optimiser.step()
        if schedule is not None:
            schedule.step()
    with torch.no_grad():
        if view.track is None:
            track = track_of(basis, places, view.fps)
        fitted = track, log_weights, _ascending(first, gaps), log_steepness.exp()[0]
    return tuple(x.detach().numpy().copy() for x in fitted), float(loss.detach())


def _seen(view: View) -> np.ndarray:
    """The demo as its frames show it, (F, B)."""
    assert view.track is not None
    return np.concatenate([view.track.pose, view.track.motion], axis=-1)


def _ascending(first: torch.Tensor, gaps: torch.Tensor) -> torch.Tensor:
    return torch.cat([first, first + functional.softplus(gaps).cumsum(0)])


def _body(name: str, obs: np.ndarray) -> np.ndarray:
    body = body_of(robot_named(name))
    return np.concatenate([body.pose(obs), body.motion(obs)], axis=-1).astype(np.float32)
