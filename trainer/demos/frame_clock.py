"""Which demo frame is on screen at which control step. One clock: step t is at t * dt seconds."""

from __future__ import annotations

import numpy as np


def frame_of_step(step: int | np.ndarray, dt: float, fps: float, n_frames: int) -> np.ndarray:
    """The frame on screen at a control step: ``floor(step * dt * fps)``, within the video.

    Args:
        step: Control step or steps, any shape.
        dt: Seconds per control step.
        fps: Frames per second.
        n_frames: How many frames the video has.

    Returns:
        Frame indices in 0..n_frames - 1, the shape of ``step``, int64.
    """
    # A step that falls exactly on a frame must not miss it by a rounding error (0.008 * 125 * 30).
    frame = np.floor(np.asarray(step) * (dt * fps) + 1e-9).astype(np.int64)
    return np.clip(frame, 0, n_frames - 1)


def steps_of_frames(n: int, dt: float, fps: float) -> np.ndarray:
    """The control step that each of the first ``n`` frames shows: the nearest in time.

    Args:
        n: How many frames.
        dt: Seconds per control step.
        fps: Frames per second.

    Returns:
        Control steps, (n,), int64.
    """
    return np.floor(np.arange(n) / (fps * dt) + 0.5).astype(np.int64)
