"""The reward model: from a demo frame and a robot's state and action to a rating of 1 to 5.

Here is what all kinds have in common: settings, what they see of the demo, and the snapshot that a fit
gives. ``trainer/reward/two_branch_net.py`` is the paper's network, ``trainer/reward/learned_distance.py``
a learned distance.

Shapes: n clips, W control steps a clip, F demo frames, D frame features, V visual dims, o observations,
a actions.
"""

from __future__ import annotations

import importlib
import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from onedemo.core.files import archive_fault, write_atomic
from onedemo.errors import UserError
from onedemo.reward.settings import KINDS, PredictorConfig
from onedemo.storage.rating_records import RatedSegment
from onedemo.vision.pose_estimator import Track

CLASSES = 5
_FAR = 5.0
"""Standard deviations beyond which a visual input of another demo is no farther."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Lens:
    """How frame features become visual inputs. Fitted on one demo; others can be seen through it, too."""

    mean: np.ndarray
    """Of the features, (D,), float32."""
    axes: np.ndarray
    """Principal components with their scale, (D, V); or the scale of each feature alone, (D,). float32."""

    def see(self, features: np.ndarray) -> np.ndarray:
        """Visual inputs of frames, (F, D) to (F, V), float32."""
        centred = features.astype(np.float64) - self.mean
        seen = centred @ self.axes if self.axes.ndim == 2 else centred * self.axes
        return seen.astype(np.float32)

    def see_other(self, features: np.ndarray) -> np.ndarray:
        """The same for a demo that the lens was not fitted on: no input is beyond ``_FAR``.

        A feature that all but never changed in the one demo has a scale of a million, and may well change
        in the other: unlimited, such inputs make the fit diverge.
        """
        return np.clip(self.see(features), -_FAR, _FAR)


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """The demo as a predictor sees it."""

    visual: np.ndarray
    """Principal components of the frame features, (F, V), float32."""
    track: Track | None
    """What the frames show of the robot; None if that is not known."""
    basis: np.ndarray
    """Functions of the frames that an unknown track is made of (``trainer/reward/latent_track.py``), (F,
    R), float32."""
    fps: float
    """Frames per second."""
    lens: Lens | None = None
    """How ``visual`` was made of the features; needed if another run is to start from the predictor."""
    robot: str = "hopper"
    """Whose states are compared with it."""


class Snapshot(ABC):
    """An immutable, numbered predictor for one demo: what scores rollouts.

    Args:
        number: 1, 2, ... within a run.
        config: How it was fitted.
    """

    lens: Lens | None = None
    """What it sees the frames through, if it sees visual inputs."""

    def __init__(self, *, number: int, config: PredictorConfig) -> None:
        self.number = number
        self.config = config

    @abstractmethod
    def member_probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Probability of each rating, by each member.

        Args:
            frames: Index of the demo frame shown, integers of any shape.
            obs: Observations of the robot, (..., o).
            actions: Its actions, (..., a). Frames and states are broadcast against each other.

        Returns:
            (members, ..., 5), float32, for ratings 1 to 5.
        """

    def best(self) -> float | None:
        """The rating of a robot that does exactly what the demo shows; None where the kind does not know."""
        return None

    def beside(self, view: View) -> Snapshot | None:
        """The same predictor beside another demo, as snapshot 0: what is known before the first rating.

        Returns:
            None where nothing is: what the demo shows has to be learned from ratings first.

        Raises:
            UserError: If predictors of this kind cannot start another run.
        """
        raise UserError(f"a run cannot start from a predictor of kind {self.config.kind!r}")

    @abstractmethod
    def tensors(self) -> dict[str, Any]:
        """What ``restore`` of the kind's module needs besides number and config."""

    def probabilities(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Probability of each rating, the members' mean, (..., 5). Arguments as ``member_probabilities``."""
        return self.member_probabilities(frames, obs, actions).mean(axis=0)

    def ratings(self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The predicted rating of each pair, (...), 1..5: the reward."""
        probabilities = self.probabilities(frames, obs, actions)
        if self.config.reward == "argmax":
            return probabilities.argmax(axis=-1).astype(np.float32) + 1.0
        return expected(probabilities)

    def clip_ratings(
        self, frames: np.ndarray, obs: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predicted rating of whole clips, and how far the members disagree.

        Args:
            frames: (n, W).
            obs: (n, W, o).
            actions: (n, W, a).

        Returns:
            Mean over members, and standard deviation among them, (n,) each.
        """
        clips = expected(self.member_probabilities(frames, obs, actions)).mean(axis=-1)
        return clips.mean(axis=0), clips.std(axis=0)

    def save(self, path: Path) -> None:
        """Writes the snapshot, whole or not at all."""
        buffer = io.BytesIO()
        data = {"number": self.number, "config": asdict(self.config), **self.tensors()}
        torch.save(data, buffer)
        write_atomic(path, buffer.getvalue())

    @staticmethod
    def load(path: Path, device: str = "cpu") -> Snapshot:
        """Reads what ``save`` wrote, onto a torch device; runs no code from the file.

        Raises:
            UserError: If it is damaged.
        """
        content = path.read_bytes()
        if fault := archive_fault(content):
            raise UserError(f"the predictor {path} is damaged ({fault}): restore it from a backup")
        data = torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
        # Legacy snapshots without a kind are the paper's network.
        settings = {"kind": "network", "members": 1, "appearance": False} | data["config"]
        module = importlib.import_module(KINDS[settings["kind"]])
        return module.restore(data, PredictorConfig(**settings), device)


@dataclass(frozen=True, kw_only=True, slots=True)
class FitStats:
    """How a fit went, on the ratings it was fitted on."""

    loss: float
    """Cross-entropy at the end of the fit, nats."""
    accuracy: float
    """Share of clips whose most probable rating, averaged over the clip, is the one given; of 2,000
    clips spread evenly where there are more."""


def fit(
    ratings: Sequence[RatedSegment], frames: np.ndarray, view: View, config: PredictorConfig,
    *, number: int, seed: int, device: str = "cpu", start: Snapshot | None = None,
) -> tuple[Snapshot, FitStats]:  # fmt: skip
    """Fits a predictor on all ratings: the same ratings, seed and start give the same weights.

    It never goes on from the run's last snapshot: without a start it is fitted from scratch, with one
    from there.

    Args:
        ratings: n rated segments, all of W steps.
        frames: Index of the demo frame at each step of each segment, (n, W).
        view: The demo.
        config: Which kind, and how.
        number: The snapshot's number.
        seed: Of everything random.
        device: Where torch computes; what is drawn at random is the same everywhere.
        start: Fitted on the ratings of another move, to be fine-tuned (the paper's section "Transfer
            learning to hopping task").

    Returns:
        The snapshot and how the fit went.

    Raises:
        ValueError: If there is no rating.
        UserError: If the start is of another kind or size.
    """
    if not ratings:
        raise ValueError("a similarity predictor needs at least one rating")
    if start is not None:
        check_start(start, config)
    module = importlib.import_module(KINDS[config.kind])
    return module.fit(ratings, frames, view, config, number=number, seed=seed, device=device, start=start)


def check_start(start: Snapshot, config: PredictorConfig) -> None:
    """Raises UserError if fits of this config cannot start from ``start``."""
    if start.config.kind != config.kind:
        raise UserError(
            f"the predictor to start from is of kind {start.config.kind!r}, and this run fits one of kind "
            f"{config.kind!r}; choose a run with --set predictor.kind={config.kind}"
        )
    same = ("hidden", "additional_layer") if config.kind == "network" else ()
    for name in same:
        theirs, ours = getattr(start.config, name), getattr(config, name)
        if theirs != ours:
            raise UserError(
                f"the predictor to start from has predictor.{name} = {theirs}, this run has {ours}; "
                "they must be the same"
            )


def expected(probabilities: np.ndarray) -> np.ndarray:
    """The expected rating, ``sum_k k p(k)``, of probabilities (..., 5): (...)."""
    with np.errstate(invalid="ignore"):  # BLAS may set that flag by what lies beside an array of five
        return probabilities @ np.arange(1, CLASSES + 1, dtype=np.float32)


def visual_inputs(features: np.ndarray, dims: int) -> np.ndarray:
    """Frame features as the predictor sees them, through a lens of their own: (F, D) to (F, V)."""
    return fit_lens(features, dims).see(features)


def fit_lens(features: np.ndarray, dims: int) -> Lens:
    """Centres frame features and turns them onto their principal components.

    Departs from the paper, which feeds all 4096 features: with a few hundred ratings, the few
    directions in which one demo's frames differ are all that can be used. No rating and no
    state enters. ``dims=0`` keeps every feature, standardised.

    Args:
        features: Frame features of the demo, (F, D).
        dims: Components to keep, V; 0 keeps D.

    Returns:
        What gives inputs of about unit variance in the first component.
    """
    mean = features.mean(axis=0)
    centred = features.astype(np.float64) - mean
    if dims == 0:
        return Lens(mean=mean, axes=(1 / (centred.std(axis=0) + 1e-6)).astype(np.float32))
    # By the frames' inner products: a demo has fewer frames than a frame has features.
    squares, vectors = np.linalg.eigh(centred @ centred.T)
    order = np.argsort(squares)[::-1][: min(dims, features.shape[1])]
    squares, vectors = squares[order], vectors[:, order]
    # The sign of an eigenvector is open: fix it, so that two machines agree on what a snapshot's inputs mean.
    vectors *= np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(len(order))] < 0, -1, 1)
    # Directions in which these frames do not differ are nothing but rounding.
    lengths = np.sqrt(np.maximum(squares, 0.0))
    there = lengths > 1e-6 * lengths[0]
    axes = np.where(there, centred.T @ vectors / np.where(there, lengths, 1.0), 0.0)
    scale = (vectors[:, 0] * lengths[0]).std() + 1e-12
    return Lens(mean=mean, axes=(axes / scale).astype(np.float32))
