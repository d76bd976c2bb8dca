"""One clip as one animated picture: the demo on the left, the agent on the right.

Both sides share one file, so they cannot drift apart, and a plain ``<img>`` plays it. WebP by
OpenCV at quality 80: about 75 KB and 0.2 s for ten frames of the robot; Pillow makes the same file
no faster, and AVIF, at half the size, is not shown by older browsers. Real video full of leaves
takes 280 KB; quality 65 brings that to 180.

Shapes: k frames, H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import cv2
import numpy as np

SIDE_WIDTH, SIDE_HEIGHT = 480, 360
"""Each side, pixels."""
GAP = 12
"""White space between the sides, pixels."""
CLIP_WIDTH, CLIP_HEIGHT = 2 * SIDE_WIDTH + GAP, SIDE_HEIGHT
HOLD_SECONDS = 0.5
"""How long the last frame stays before the clip starts over."""
SLOW = 0.25
"""Speed of the slow-motion variant."""

_QUALITIES = (80, 65)
_ENOUGH = 150_000  # bytes; a clip beyond it is encoded again at the lower quality


def compose_clip(
    demo_frames: np.ndarray,
    agent_frames: np.ndarray,
    *,
    fps: float,
    speed: float = 1.0,
) -> bytes:
    """Lays the frames side by side and encodes them as an endless animated WebP.

    Args:
        demo_frames: The demo's frames, (k, H, W, 3), uint8 RGB, any size.
        agent_frames: The agent's frames at the same times, (k, H', W', 3), uint8 RGB, any size.
        fps: Frames per second at normal speed.
        speed: 1 for normal speed, 0.25 for a quarter of it.

    Returns:
        The file's bytes: 972 x 360 pixels, k frames, the last held half a second.

    Raises:
        ValueError: If the sides differ in length, are empty or not RGB, or fps or speed are not
            positive.
    """
    for side, frames in (("demo", demo_frames), ("agent", agent_frames)):
        if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8 or not frames.size:
            raise ValueError(
                f"{side} frames must be (k, H, W, 3) uint8 with k > 0, got {frames.shape} {frames.dtype}"
            )
    if len(demo_frames) != len(agent_frames):
        raise ValueError(f"{len(demo_frames)} demo frames, but {len(agent_frames)} agent frames")
    if fps <= 0 or speed <= 0:
        raise ValueError(f"fps and speed must be positive, got {fps} and {speed}")
    animation = cv2.Animation()
    animation.frames = [
        cv2.cvtColor(side_by_side(demo, agent), cv2.COLOR_RGB2BGR)
        for demo, agent in zip(demo_frames, agent_frames, strict=True)
    ]
    animation.durations = frame_durations(len(demo_frames), fps * speed)
    animation.loop_count = 0
    data = b""
    for quality in _QUALITIES:
        options = [cv2.IMWRITE_WEBP_QUALITY, quality]
        done, encoded = cv2.imencodeanimation(".webp", animation, options)
        if not done:
            raise RuntimeError("OpenCV could not encode an animated WebP")
        data = encoded.tobytes()
        if len(data) <= _ENOUGH:
            break
    return data


def frame_durations(k: int, fps: float) -> np.ndarray:
    """How long each frame stays, (k,), int32 milliseconds; their sum does not drift from k / fps.

    Args:
        k: How many frames.
        fps: Frames per second as played.
    """
    durations = np.diff(np.round(np.arange(k + 1) * 1000 / fps)).astype(np.int32)
    durations[-1] = max(durations[-1], round(HOLD_SECONDS * 1000))
    return durations


def side_by_side(demo: np.ndarray, agent: np.ndarray) -> np.ndarray:
    """One picture of both, (H, W, 3), each fitted into its side."""
    gap = np.full((SIDE_HEIGHT, GAP, 3), 255, np.uint8)
    return np.concatenate([fit(demo), gap, fit(agent)], axis=1)


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
