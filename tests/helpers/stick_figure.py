"""A video of another body, made by the project itself: a drawn figure does a backflip."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

FPS = 30.0
FRAMES = 75
SIZE = (240, 320)
_TIMES = np.array([0.0, 0.5, 0.9, 1.1, 1.5, 1.9, 2.1, 2.5])
"""Seconds at which it stands, crouches, leaves the ground, ..., stands again."""
_LEAN = np.radians([0, 15, -10, -60, -190, -320, -355, -360])
_HEIGHT = np.array([0, -18, 5, 45, 70, 40, -15, 0])
_KNEE = np.radians([5, 75, 5, 60, 110, 60, 70, 5])
_ARMS = np.radians([10, -40, 160, 150, 60, 60, 40, 10])


def backflip() -> np.ndarray:
    """Its frames, (75, 240, 320, 3) uint8 RGB, at 30 a second."""
    moments = np.arange(FRAMES) / FPS
    ways = (np.interp(moments, _TIMES, way) for way in (_LEAN, _HEIGHT, _KNEE, _ARMS))
    return np.array([_drawn(*moment) for moment in zip(*ways, strict=True)])


def backflip_video(path: Path) -> Path:
    """The same as an MP4 file."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FPS, SIZE[::-1])
    for frame in backflip():
        video.write(frame[..., ::-1])
    video.release()
    return path


def _drawn(lean: float, height: float, knee: float, arms: float) -> np.ndarray:
    frame = np.full((*SIZE, 3), (226, 232, 240), np.uint8)
    frame[205:] = (170, 160, 150)
    hip = np.array([160.0, 145.0 - height])
    shoulder = hip + 45 * _up(lean)
    bones = [(hip, shoulder, 9)]
    for side in (-0.12, 0.12):
        middle = hip - 30 * _up(lean + knee * 0.6 + side)
        bones += [(hip, middle, 8), (middle, middle - 30 * _up(lean - knee * 0.5 + side), 7)]
        elbow = shoulder - 22 * _up(lean + arms + side)
        bones += [(shoulder, elbow, 6), (elbow, elbow - 20 * _up(lean + arms * 1.1 + side), 5)]
    for start, end, width in bones:
        cv2.line(frame, _pixel(start), _pixel(end), (40, 60, 120), width, cv2.LINE_AA)
    cv2.circle(frame, _pixel(shoulder + 15 * _up(lean)), 11, (205, 150, 120), -1, cv2.LINE_AA)
    return frame


def _up(angle: float) -> np.ndarray:
    return np.array([np.sin(angle), -np.cos(angle)])


def _pixel(point: np.ndarray) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
