"""A learned distance: the rating falls with the weighted distance between demo and robot.

The demo's track, what a person sees of the robot in each frame (``sim.kinematics.Seen``), is compared with
the robot's own: pose, motion, and, where the track knows them, travel and contact. The ratings say how much
each part of the difference matters, how much the effort of the motors does, and at which distances a point
is lost:

    d(f, s, a) = sqrt(sum_i w_i (track_i(f) - body_i(s))^2 + e) + h effort(a)    of frame, state and action
    P(y > k)   = sigmoid(g (t_k - mean of d over the clip)),  t_1 > t_2 > t_3 > t_4

the ordered logit of McCullagh 1980 (proportional odds) on a distance. What the demo's motors do cannot be
seen, so effort has no counterpart in the track, and h is 0 until ratings say otherwise. Where the rater has
marked a part of a clip as wrong, that part is taken to be further off than the rest, with the probability
sigmoid(g (mean of d inside - mean outside)). Where the track is seen (``trainer/vision/pose_estimator.py``)
that is 26 numbers for a hopper, so a few dozen ratings fit it; a network of thousands has to learn first
that near is like. Where it is not, the track itself is fitted to the ratings, too
(``trainer/reward/latent_track.py``).

A fit that starts from the numbers of another move (they say what the rater looks at, not what the demo
shows) is pulled to them, the less the more ratings there are.

Shapes: n clips, W control steps a clip, F demo frames, P numbers of a pose, B = 2 P and one for each of the
``parts``, M members.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from onedemo.sim.kinematics import TRAVEL_SCALE, body_of
from onedemo.storage.rating_records import RatedSegment

_UPDATES = 300
_RATE = 0.03
_EVERY_SECONDS = 0.016
"""Between the steps of a clip that enter a fit: neighbours are alike."""
_EVERY_IMAGINED_SECONDS = 0.056
"""The same where the track is fitted, too, which takes longer."""
_SPREAD = 0.3
"""Of the weights of an imagined track to begin with."""
_RIDGE = 0.004
"""Of the penalty on them, a standard normal prior for about 125 ratings."""
_PRIOR = {"pose": -1.0, "motion": -2.0, "travel": -1.0, "contact": -2.0}
"""Log weights before any rating: a difference in pose or travel counts more than one in motion."""
_USUAL = 9
"""Numbers of a pose for which the prior is meant; the more there are, the less does each count."""
PARTS = ("travel", "contact")
"""What is compared beside pose and motion, where the track knows it."""
_PULL = 0.003
"""Of the penalty that holds log weights near the prior."""
_EFFORT_PULL = 0.1
"""Of the penalty on the weight of effort: a standard deviation of 0.3 with 55 ratings, 0.12 with 350."""
_USUAL_EFFORT = 0.5
"""Of a policy that still tries: what does not change the distance."""
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
        effort: h of each member, (M,).
        parts: Which of ``PARTS`` are compared.
        robot: Name of the robot.
    """

    def __init__(
        self, *, number: int, config: PredictorConfig, tracks: np.ndarray, log_weights: np.ndarray,
        thresholds: np.ndarray, steepness: np.ndarray, effort: np.ndarray, parts: tuple[str, ...],
        robot: str,
    ) -> None:  # fmt: skip
        super().__init__(number=number, config=config)
        self.log_weights, self.thresholds, self.steepness = log_weights, thresholds, steepness
        self.effort, self.parts = effort, parts
        self._tracks = tracks
        self._robot = robot
        self._weights = np.exp(log_weights).astype(np.float32)

    def member_probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """As ``Snapshot.member_probabilities``."""
        robot = _body(self._robot, obs, self.parts)
        if len(self._tracks) == 1:
            squares = np.square(self._tracks[0][frames] - robot) @ self._weights.T
        else:
            members = zip(self._tracks, self._weights, strict=True)
            squares = np.stack([np.square(track[frames] - robot) @ w for track, w in members], axis=-1)
        return self._chances(np.sqrt(squares + _TINY) + _effort(actions)[..., None] * self.effort)

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
            number=0, config=self.config, tracks=_seen(view)[None], log_weights=self.weights_for(view),
            thresholds=self.thresholds, steepness=self.steepness, effort=self.effort, parts=_parts(view),
            robot=self._robot,
        )  # fmt: skip

    def weights_for(self, view: View) -> np.ndarray:
        """Its log weights beside another demo, (M, B'); of parts that it never saw, the prior."""
        prior = _prior(view).numpy()
        rows = np.tile(prior, (len(self.log_weights), 1))
        size = len(prior) - len(_parts(view))
        rows[:, :size] = self.log_weights[:, :size]
        for at, part in enumerate(_parts(view)):
            if part in self.parts:
                rows[:, size + at] = self.log_weights[:, size + self.parts.index(part)]
        return rows

    def tensors(self) -> dict[str, Any]:
        """The fitted numbers and the demo's tracks."""
        arrays = {
            "tracks": self._tracks, "log_weights": self.log_weights,
            "thresholds": self.thresholds, "steepness": self.steepness, "effort": self.effort,
        }  # fmt: skip
        tensors = {name: torch.from_numpy(np.asarray(array)) for name, array in arrays.items()}
        return tensors | {"robot": self._robot, "parts": list(self.parts)}


def restore(data: dict[str, Any], config: PredictorConfig, device: str) -> MetricSnapshot:
    """The snapshot whose ``tensors`` are in ``data``; it computes in NumPy whatever the device."""
    names = ("tracks", "log_weights", "thresholds", "steepness")
    numbers = {name: data[name].numpy() for name in names}
    # Older ones compared pose and motion of the hopper alone, whatever its motors did.
    effort = data["effort"].numpy() if "effort" in data else np.zeros_like(numbers["steepness"])
    return MetricSnapshot(
        number=data["number"], config=config, robot=data.get("robot", "hopper"),
        parts=tuple(data.get("parts", ())), effort=effort, **numbers,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class _Clips:
    """What a fit looks at: a few steps of each of n clips."""

    frames: torch.Tensor
    """(n, W'), demo frames."""
    robot: torch.Tensor
    """(n, W', B)."""
    effort: torch.Tensor
    """(n, W')."""
    classes: torch.Tensor
    """(n,), 0..4."""
    weights: torch.Tensor
    """(n,), in the loss."""
    inside: torch.Tensor
    """Steps where the rater said that it goes wrong, (n, W'), 0 or 1."""

    def take(self, index: torch.Tensor) -> _Clips:
        return _Clips(
            frames=self.frames[index], robot=self.robot[index], effort=self.effort[index],
            classes=self.classes[index], weights=self.weights[index], inside=self.inside[index],
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
    between = _EVERY_SECONDS if seen else _EVERY_IMAGINED_SECONDS
    every = max(1, round(between / robot_named(view.robot).dt))
    some = slice(every // 2, None, every)
    classes_n = torch.tensor([r.value - 1 for r in ratings])
    counts = torch.bincount(classes_n, minlength=CLASSES).float()
    clips = _Clips(
        frames=torch.from_numpy(frames[:, some].astype(np.int64)),
        robot=torch.from_numpy(
            _body(view.robot, np.stack([r.segment.obs[some] for r in ratings]), _parts(view))
        ),
        effort=torch.from_numpy(_effort(np.stack([r.segment.actions[some] for r in ratings]))),
        classes=classes_n,
        weights=(len(ratings) / (CLASSES * counts)).clamp(_LEAST, _MOST)[classes_n],
        inside=torch.from_numpy(np.stack([marked_steps(r)[some] for r in ratings])),
    )
    members, losses = [], []
    for k in range(config.members if seen else 2 * config.members):
        chosen = torch.arange(len(ratings))
        if config.members > 1:
            chosen = torch.randint(len(ratings), (len(ratings),), generator=generator)
        member, loss = _fit_one(clips.take(chosen), view, generator, _known(start, k, view))
        members.append(member)
        losses.append(loss)
    columns = (np.stack(column) for column in zip(*members, strict=True))
    tracks, log_weights, thresholds, steepness, effort = columns
    snapshot = MetricSnapshot(
        number=number, config=config, tracks=tracks[:1] if seen else tracks, log_weights=log_weights,
        thresholds=thresholds, steepness=steepness, effort=effort, parts=_parts(view), robot=view.robot,
    )  # fmt: skip
    few = slice(None, None, -(-len(ratings) // _JUDGED_CLIPS))
    judged = [r.segment for r in ratings[few]]
    probabilities = snapshot.probabilities(
        frames[few], np.stack([s.obs for s in judged]), np.stack([s.actions for s in judged])
    )
    hit = probabilities.mean(axis=1).argmax(axis=-1) == classes_n[few].numpy()
    return snapshot, FitStats(loss=float(np.mean(losses)), accuracy=float(hit.mean()))


def _known(start: MetricSnapshot | None, member: int, view: View) -> tuple[torch.Tensor, ...] | None:
    """The numbers of a start's member, the track left out, as they are free in a fit."""
    if start is None:
        return None
    member %= len(start.steepness)
    thresholds = torch.from_numpy(start.thresholds[member].astype(np.float32))
    return (
        torch.from_numpy(start.weights_for(view)[member].astype(np.float32)),
        thresholds[:1],
        thresholds.diff().clamp_min(_TINY).expm1().log(),  # softplus backwards
        torch.tensor([float(np.log(start.steepness[member]))]),
        torch.tensor([float(start.effort[member])]),
    )


def _fit_one(
    clips: _Clips, view: View, generator: torch.Generator, known: tuple[torch.Tensor, ...] | None
) -> tuple[tuple[np.ndarray, ...], float]:
    """One member: its track, log weights, thresholds and steepness, and the loss it ended with."""
    body = body_of(robot_named(view.robot))
    prior = _prior(view)
    usual = prior, torch.tensor([0.9]), torch.zeros(CLASSES - 2), torch.ones(1), torch.zeros(1)
    numbers = [x.clone().requires_grad_() for x in known or usual]
    log_weights, first, gaps, log_steepness, effort = numbers
    parameters = list(numbers)
    basis = torch.from_numpy(view.basis)
    places = torch.zeros(0)
    track = squares = torch.zeros(0)
    if view.track is not None:
        track = torch.from_numpy(_seen(view))
        squares = (track[clips.frames] - clips.robot).square()
    else:
        places = _SPREAD * torch.randn(basis.shape[1], body.pose_size, generator=generator)
        parameters.append(places.requires_grad_())
    optimiser = optimisers.Adam(parameters, _RATE, fused=True)
    schedule = None
    if view.track is None:  # many more numbers: large steps first, small ones in the end
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2 * _RATE, total_steps=_UPDATES)
    loss = torch.zeros(())
    marked = (clips.inside.sum(1) > 0) & (clips.inside.sum(1) < clips.inside.shape[1])
    for _ in range(_UPDATES):
        if view.track is None:
            track = track_of(basis, places, view.fps, body)
            squares = (track[clips.frames] - clips.robot).square()
        thresholds = _ascending(first, gaps)
        distance_nW = (squares @ log_weights.exp() + _TINY).sqrt() + effort * clips.effort
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
            penalty = _PULL * (log_weights - prior).square().sum() + _EFFORT_PULL * effort.square().sum()
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
            track = track_of(basis, places, view.fps, body)
        fitted = track, log_weights, _ascending(first, gaps), log_steepness.exp()[0], effort[0]
    return tuple(x.detach().numpy().copy() for x in fitted), float(loss.detach())


def _parts(view: View) -> tuple[str, ...]:
    """Which of ``PARTS`` the demo shows; a robot that is fixed goes nowhere."""
    fixed = robot_named(view.robot).root == "fixed"
    known = [part for part in PARTS if getattr(view.track, part, None) is not None]
    return tuple(part for part in known if not (fixed and part == "travel"))


def _prior(view: View) -> torch.Tensor:
    """Log weights before any rating, (B,), float32."""
    size = body_of(robot_named(view.robot)).pose_size
    each = [_PRIOR["pose"]] * size + [_PRIOR["motion"]] * size
    shared = np.array(each) - np.log(size / _USUAL)
    return torch.tensor([*shared, *(_PRIOR[part] for part in _parts(view))], dtype=torch.float32)


def _seen(view: View) -> np.ndarray:
    """The demo as its frames show it, (F, B)."""
    track = view.track
    assert track is not None
    return _joined(track.pose, track.motion, {part: getattr(track, part) for part in _parts(view)})


def _body(name: str, obs: np.ndarray, parts: tuple[str, ...]) -> np.ndarray:
    """The robot as it is seen, (..., o) to (..., B)."""
    body = body_of(robot_named(name))
    if not parts:
        return _joined(body.pose(obs), body.motion(obs), {})
    seen = body.seen(obs)
    return _joined(seen.pose, seen.motion, {part: getattr(seen, part) for part in parts})


def _joined(pose: np.ndarray, motion: np.ndarray, parts: Mapping[str, np.ndarray]) -> np.ndarray:
    scaled = [(_SCALES[part] * x)[..., None] for part, x in parts.items()]
    return np.concatenate([pose, motion, *scaled], axis=-1).astype(np.float32)


_SCALES = {"travel": TRAVEL_SCALE, "contact": 1.0}


def _effort(actions: np.ndarray) -> np.ndarray:
    """How far the motors are driven, beyond what is usual: (..., a) to (...), float32."""
    driven = np.square(np.clip(actions, -1, 1)).mean(axis=-1)
    return (driven - _USUAL_EFFORT).astype(np.float32)


def _ascending(first: torch.Tensor, gaps: torch.Tensor) -> torch.Tensor:
    return torch.cat([first, first + functional.softplus(gaps).cumsum(0)])
