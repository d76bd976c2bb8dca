"""One clip as one picture: its frames in a grid, each the demo on the left and the agent on the right.

Both sides share one file, so they cannot drift apart; the page plays it, at any speed and frame by
frame. JPEG at quality 82: about 150 KB and 30 ms for ten frames of the robot, 280 KB for a real video full
of leaves.

Shapes: k frames, H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

SIDE_WIDTH, SIDE_HEIGHT = 480, 360
"""Each side, pixels."""
GAP = 12
"""White space between the sides, pixels."""
CLIP_WIDTH, CLIP_HEIGHT = 2 * SIDE_WIDTH + GAP, SIDE_HEIGHT
HOLD_SECONDS = 0.5
"""How long the last frame stays before a clip starts over."""

_QUALITY = 82
_MOST_ROWS = 40
"""Of the grid: browsers draw no picture higher than 16,384 pixels."""


def compose_clip(demo_frames: np.ndarray, *agent_frames: np.ndarray) -> bytes:
    """Lays the frames side by side, moment below moment, and encodes them as one JPEG.

    Args:
        demo_frames: The demo's frames, (k, H, W, 3), uint8 RGB, any size.
        agent_frames: Frames of one agent or more at the same times, (k, H', W', 3), uint8 RGB, any size.

    Returns:
        The file's bytes: of one agent, 972 x 360 pixels a moment, row by row, in one column as long as it
        is not too high.

    Raises:
        ValueError: If the sides differ in length, are empty or not RGB.
    """
    for side, frames in (("demo", demo_frames), *(("agent", frames) for frames in agent_frames)):
        if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8 or not frames.size:
            raise ValueError(
                f"{side} frames must be (k, H, W, 3) uint8 with k > 0, got {frames.shape} {frames.dtype}"
            )
        if len(frames) != len(demo_frames):
            raise ValueError(f"{len(demo_frames)} demo frames, but {len(frames)} agent frames")
    columns = math.ceil(len(demo_frames) / _MOST_ROWS)
    rows = math.ceil(len(demo_frames) / columns)
    width = SIDE_WIDTH + len(agent_frames) * (SIDE_WIDTH + GAP)
    picture = np.full((rows * SIDE_HEIGHT, columns * width, 3), 255, np.uint8)
    for cell in range(rows * columns):  # those left over show the last frame
        frame = min(cell, len(demo_frames) - 1)
        y, x = cell // columns * SIDE_HEIGHT, cell % columns * width
        for frames in (demo_frames, *agent_frames):
            side = picture[y : y + SIDE_HEIGHT, x : x + SIDE_WIDTH]
            cv2.cvtColor(fit(frames[frame]), cv2.COLOR_RGB2BGR, dst=side)
            x += SIDE_WIDTH + GAP
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a clip as JPEG")
    return encoded.tobytes()


def frame_durations(k: int, fps: float) -> np.ndarray:
    """How long each frame stays, (k,), int32 milliseconds; their sum does not drift from k / fps.

    Args:
        k: How many frames.
        fps: Frames per second as played.
    """
    durations = np.diff(np.round(np.arange(k + 1) * 1000 / fps)).astype(np.int32)
    durations[-1] = max(durations[-1], round(HOLD_SECONDS * 1000))
    return durations


def side_by_side(demo: np.ndarray, *agents: np.ndarray) -> np.ndarray:
    """One picture of all, (H, W, 3), each fitted into its side."""
    gap = np.full((SIDE_HEIGHT, GAP, 3), 255, np.uint8)
    return np.concatenate([fit(demo), *(part for agent in agents for part in (gap, fit(agent)))], axis=1)


def fit(frame: np.ndarray) -> np.ndarray:
    """Scales a frame to fit into one side; what is left over shows the frame itself, faded.

    A portrait video stands on a wide, blurred and lightened copy of itself: calmer than black
    bars, and the edges of the picture stay visible.

    Args:
        frame: (H, W, 3), uint8 RGB.

    Returns:
        (SIDE_HEIGHT, SIDE_WIDTH, 3), uint8 RGB.
    """
    height, width = frame.shape[:2]
    if (height, width) == (SIDE_HEIGHT, SIDE_WIDTH):
        return frame
    scale = min(SIDE_WIDTH / width, SIDE_HEIGHT / height)
    w = min(SIDE_WIDTH, max(1, round(width * scale)))
    h = min(SIDE_HEIGHT, max(1, round(height * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = cv2.resize(frame, (w, h), interpolation=method)
    if (h, w) == (SIDE_HEIGHT, SIDE_WIDTH):
        return small
    side = _surround(small)
    y, x = (SIDE_HEIGHT - h) // 2, (SIDE_WIDTH - w) // 2
    side[y : y + h, x : x + w] = small
    return side


def _surround(frame: np.ndarray) -> np.ndarray:
    """A wash of the frame's own colours over the whole side, mixed with white."""
    tiny = cv2.resize(frame, (4, 3), interpolation=cv2.INTER_AREA)
    wash = cv2.resize(tiny, (SIDE_WIDTH, SIDE_HEIGHT), interpolation=cv2.INTER_CUBIC)
    return cv2.addWeighted(wash, 0.3, np.full_like(wash, 243), 0.7, 0)
