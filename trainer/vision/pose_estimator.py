"""What a demo's frames show of the robot, and where that is kept for the demos that come with the program.

It is read by ``trainer/vision/silhouette.py``.

Shapes: F demo frames, P numbers of a pose (``trainer/sim/kinematics.py``).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from onedemo.core.files import read_whole, write_atomic
from onedemo.types import Demo


@dataclass(frozen=True, kw_only=True, slots=True)
class Track:
    """What a demo's frames show of the robot."""

    pose: np.ndarray
    """(F, P), float32, as ``body.pose``."""
    motion: np.ndarray
    """(F, P), float32, as ``body.motion``."""
    travel: np.ndarray | None = None
    """Velocity of the root to the right, m/s, (F,), float32, as ``body.travel``; None: not known."""
    contact: np.ndarray | None = None
    """How far it touches the ground, 0..1, (F,), float32, as ``body.contact``; None: not known."""
    doubt: np.ndarray | None = None
    """How unsure the pose is, (F,), float32: 0 is sure, 1 may be any; None: not said."""


def shipped_track(demo: Demo) -> Track | None:
    """What a demo that comes with the program shows of the robot, as ``keep_track`` left it beside its video.

    So examples of ratings can be chosen before the robot was looked at. None for any other demo.
    """
    if (data := read_whole(_track_file(demo))) is None:
        return None
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        return Track(**{name: stored[name] for name in _KEPT if name in stored.files})


def keep_track(demo: Demo, track: Track) -> None:
    """Keeps what a demo shows of the robot beside its video."""
    assert track.doubt is not None, "the pose estimator says how sure it is"
    buffer = io.BytesIO()
    known = {name: x for name in _KEPT if (x := getattr(track, name)) is not None}
    np.savez_compressed(buffer, allow_pickle=False, **known)
    write_atomic(_track_file(demo), buffer.getvalue())


_KEPT = ("pose", "motion", "travel", "contact", "doubt")


def _track_file(demo: Demo) -> Path:
    return demo.path.with_suffix(".track.npz")
