"""The states behind a demo that was simulated: what its video shows, in numbers.

Only simulated raters and evaluation may import this module. The method learns from the video and
the ratings alone; a rater or a metric may look at the answer, the trainer may not. The states of
``hopper-hop.mp4`` lie beside it in ``hopper-hop.hidden.npz``.

Shapes: T control steps, so T + 1 states; o observations, a actions, q = v positions, velocities.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from onedemo.errors import UserError

SUFFIX = ".hidden.npz"
_FIELDS = ("obs", "actions", "qpos", "qvel")


@dataclass(frozen=True, kw_only=True, slots=True)
class HiddenStates:
    """One simulated episode."""

    obs: np.ndarray
    """(T + 1, o), float64."""
    actions: np.ndarray
    """(T, a), float32, not clipped."""
    qpos: np.ndarray
    """(T + 1, q), float64, metres and radians."""
    qvel: np.ndarray
    """(T + 1, v), float64, metres/s and radians/s."""

    def __post_init__(self) -> None:
        lengths = {len(self.obs), len(self.actions) + 1, len(self.qpos), len(self.qvel)}
        if len(lengths) != 1:
            raise ValueError("T actions need T + 1 observations, positions and velocities")
        if not all(np.isfinite(getattr(self, name)).all() for name in _FIELDS):
            raise ValueError("hidden states must be finite")


def hidden_path(video: Path) -> Path:
    """Where the hidden states of a demo's video lie, if it has any."""
    return video.with_name(video.name.removesuffix(video.suffix) + SUFFIX)


def save_hidden(path: Path, hidden: HiddenStates) -> None:
    """Writes an episode as NPZ."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: getattr(hidden, name) for name in _FIELDS}
    with path.open("wb") as file:  # an open file keeps savez from adding a suffix
        np.savez_compressed(file, **arrays)


def load_hidden(path: Path) -> HiddenStates:
    """Reads an episode that ``save_hidden`` wrote.

    Raises:
        UserError: If the file is missing or is not such an episode.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return HiddenStates(**{name: data[name] for name in _FIELDS})
    except FileNotFoundError:
        raise UserError(f"no hidden states at {path}") from None
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} does not hold a demo's hidden states: {error}") from None
