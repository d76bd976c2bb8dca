"""How well a robot's pose is read from videos of it that others would make: other looks, cameras and codecs.

Films of states that nothing was trained on are drawn in one look, coded and blurred, and read from their
silhouettes: once from those that MuJoCo draws, and from those that are found in the pictures. The states
behind the films judge, and are read nowhere else.

Settings: ``robot``; ``look``, a key of ``LOOKS``; ``seconds`` of each film; ``films`` of random states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from onedemo.core.files import hold
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.library import built_in
from onedemo.errors import UserError
from onedemo.experiments.jobs.method import hidden_of
from onedemo.experiments.jobs.pose_looks import FAULTS, LOOKS, Look
from onedemo.rl.random_states import wild_rollouts
from onedemo.robots.registry import robot_named
from onedemo.robots.robot import Robot
from onedemo.vision.masks import Masks, find_masks
from onedemo.vision.silhouette import Silhouette, learn
from onedemo.vision.silhouette_pictures import Silhouettes, aims, names_of

TRUE = "true masks"
HOW = (TRUE, *FAULTS)
"""What is read: masks as they are drawn, and those found in coded videos."""
_STATES_FROM = 50_000
"""Seeds of states: what is learned from has others."""
_FPS = 30.0
_WIDTH = 240
"""Columns of the pictures in which the robot is looked for."""
_STANDING = 0.5
_SURE = 0.5


def run(settings: Mapping[str, Any], seed: int, scratch: Path, cache: Path | None = None) -> dict[str, Any]:
    """Reads one look.

    Args:
        settings: See above.
        seed: Of the states.
        scratch: Used if there is no cache.
        cache: Holds what was learned of the robot.

    Raises:
        UserError: If there is no such look or robot.

    Returns:
        For ``TRUE`` and each of ``FAULTS``: ``explained``, R2 of each number of a frame, by name; ``doubt``,
        its rank correlation with the error; ``sure``, the share of frames with a doubt below a half; ``iou``
        of the masks with the true ones.
    """
    robot = robot_named(settings["robot"])
    if (look := LOOKS.get(settings["look"])) is None:
        raise UserError(f"there is no look {settings['look']!r}; choose one of: {', '.join(LOOKS)}")
    kept = (cache or scratch) / "robots"
    with hold(kept / "lock", wait=True):
        learned = learn(robot.name, kept)
    films = _films(robot, settings, seed)
    seen: dict[str, list[Seen]] = {how: [] for how in HOW}
    for states in films:
        truth = true_masks(robot, look, states.qpos)
        seen[TRUE].append(_read(learned, robot, truth, states, truth))
        frames = look.draw(robot, states.qpos)
        for fault, spoil in FAULTS.items():
            found = find_masks(_small(spoil(frames)), length=learned.reach).of_length(learned.reach)
            seen[fault].append(_read(learned, robot, found, states, truth))
    return {how: scores(robot, each) for how, each in seen.items()}


@dataclass(frozen=True, slots=True)
class _States:
    """Of the frames of a film: (F, q), (F, o)."""

    qpos: np.ndarray
    obs: np.ndarray


@dataclass(frozen=True, slots=True)
class Seen:
    """What was read of a film, (F, A); its doubt, (F,); what is right, (F, A); how right masks are, (F,)."""

    read: np.ndarray
    doubt: np.ndarray
    right: np.ndarray
    iou: np.ndarray


def _films(robot: Robot, settings: Mapping[str, Any], seed: int) -> list[_States]:
    """Films of random states, and of each simulated demo of the robot a part that the seed chooses."""
    steps = steps_of_frames(int(settings["seconds"] * _FPS), robot.dt, _FPS)
    every = int(steps[-1]) + 1
    rollouts = wild_rollouts(
        robot.name,
        lanes=settings["films"],
        steps=every,
        every=every,
        seed=_STATES_FROM + seed,
        standing=_STANDING,
    )
    wild = [
        _States(rollouts.qpos[lane, steps], rollouts.obs[lane, steps]) for lane in range(settings["films"])
    ]
    rng = np.random.default_rng(_STATES_FROM + seed)
    for hidden in [hidden_of(demo) for demo in built_in()]:
        if hidden is None or hidden.qpos.shape[-1] != rollouts.qpos.shape[-1]:
            continue
        at = steps + rng.integers(max(1, len(hidden.qpos) - every))
        wild.append(_States(hidden.qpos[at], hidden.obs[at]))
    return wild


def true_masks(robot: Robot, look: Look, qpos: np.ndarray) -> Masks:
    """As MuJoCo draws them for the camera of a look: what a perfect search would find."""
    with Silhouettes(robot, _WIDTH) as drawing:
        at = look.places(robot, qpos)
        masks = [drawing.draw(q, look.eye, place) >= 0 for q, place in zip(qpos, at, strict=True)]
    floor = look.eye.row_below(_WIDTH, at[:, robot.camera.up])
    return Masks(
        masks=np.stack(masks), floor=floor, scale=_WIDTH / look.eye.view,
        way=at[:, robot.camera.right] - at[0, robot.camera.right], doubt=np.zeros(len(qpos)), method="still",
    )  # fmt: skip


def _small(frames: np.ndarray) -> np.ndarray:
    size = (_WIDTH, round(_WIDTH * frames.shape[1] / frames.shape[2]))
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])


def _read(learned: Silhouette, robot: Robot, found: Masks, states: _States, truth: Masks) -> Seen:
    numbers, doubt = learned.numbers(found, _FPS)
    return Seen(
        read=numbers, doubt=doubt, right=aims(robot, states.qpos, states.obs),
        iou=np.array([_alike(*pair) for pair in zip(found.masks, truth.masks, strict=True)]),
    )  # fmt: skip


def _alike(found: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union of two masks of other sizes, each around its own middle."""
    side, shapes = 64, []
    for mask in (found, truth):
        if not mask.any():
            return 0.0
        x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
        part = mask[y : y + height, x : x + width].astype(np.float32)
        shapes.append(cv2.resize(part, (side, side), interpolation=cv2.INTER_AREA) > 0.5)
    return float((shapes[0] & shapes[1]).sum() / max(1, (shapes[0] | shapes[1]).sum()))


def scores(robot: Robot, seen: Sequence[Seen]) -> dict[str, Any]:
    """How right it is over films, and how well it knows that: see ``run``."""
    read, doubt, right, iou = (
        np.concatenate([getattr(film, field) for film in seen]) for field in ("read", "doubt", "right", "iou")
    )
    error = np.square(read - right)
    spread = np.square(right - right.mean(axis=0)).mean(axis=0)
    explained = 1 - error.mean(axis=0) / np.maximum(spread, 1e-9)
    size = (right.shape[1] - 2) // 2
    wrong = error[:, :size].mean(axis=1)
    sure = doubt < _SURE
    return {
        "explained": dict(zip(names_of(robot), np.round(explained, 4).tolist(), strict=True)),
        "sure": round(float(sure.mean()), 4),
        "of_sure": round(float(1 - error[sure].mean(axis=0)[1:size].mean() / spread[1:size].mean()), 4)
        if sure.any() else None,
        "doubt": round(float(np.corrcoef(_ranks(doubt), _ranks(wrong))[0, 1]), 4),
        "iou": round(float(iou.mean()), 4),
    }  # fmt: skip


def _ranks(values: np.ndarray) -> np.ndarray:
    return np.argsort(np.argsort(values)).astype(float)
