"""A small world for tests of the trainer: a two-second demo whose states are known, and a cheap encoder."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from onedemo.config import load_config
from onedemo.demos.ground_truth import HiddenStates, hidden_path, save_hidden
from onedemo.demos.video import write_webm
from onedemo.render.renderer import Renderer
from onedemo.robots.hopper import joint_points
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env
from onedemo.sim.kinematics import body_of
from onedemo.types import Demo
from onedemo.vision.pose_estimator import Track

BODY = body_of(robot_named("hopper"))

STEPS = 250
FRAMES = 60
FRAME_STEPS = np.round(np.arange(FRAMES) / 30 / 0.008).astype(int)
"""The control step that each frame shows."""


class Thumbnail:
    """A real encoder, only small: the frame itself, 8 x 8 grey pixels."""

    name = "thumbnail"
    dims = 64

    def encode(self, frames: Iterable[np.ndarray]) -> np.ndarray:
        grey = [cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in frames]
        return np.array(
            [cv2.resize(g, (8, 8), interpolation=cv2.INTER_AREA).ravel() for g in grey], np.float32
        )


def falling_demo(directory: Path, seed: int = 0) -> Demo:
    """A hopper that waves its motors and falls, drawn as a stick figure; its states lie beside the video."""
    hidden = falling_states(seed)
    return _as_demo(directory, hidden, [_stick_figure(qpos) for qpos in hidden.qpos[FRAME_STEPS]])


def drawn_demo(directory: Path, seed: int = 0) -> Demo:
    """The same fall as the robot's own pictures show it; needs a machine that can draw."""
    hidden = falling_states(seed)
    with Renderer() as renderer:
        return _as_demo(directory, hidden, list(renderer.render(hidden.qpos[FRAME_STEPS])))


def falling_track(seed: int = 0) -> Track:
    """What a perfect eye would see in the demo."""
    obs = falling_states(seed).obs[FRAME_STEPS]
    return Track(pose=BODY.pose(obs).astype(np.float32), motion=BODY.motion(obs).astype(np.float32))


@functools.cache
def falling_states(seed: int = 0) -> HiddenStates:
    """The states of the fall, STEPS + 1 of them."""
    env = vector_env.make("hopper", 1, horizon=STEPS + 1, nthread=0)
    obs, _ = env.reset(seed=seed)
    states = [(obs[0], env.qpos[0], env.qvel[0])]
    actions = 0.8 * np.sin(np.arange(STEPS)[:, None] / 20 + np.array([0.0, 1.0, 2.0]))
    for action in actions:
        obs, *_ = env.step(action[None])
        states.append((obs[0], env.qpos[0], env.qvel[0]))
    env.close()
    columns = [np.array(column) for column in zip(*states, strict=True)]
    return HiddenStates(obs=columns[0], actions=actions, qpos=columns[1], qvel=columns[2])


def _as_demo(directory: Path, hidden: HiddenStates, frames: list[np.ndarray]) -> Demo:
    directory.mkdir(parents=True, exist_ok=True)
    video = directory / "falling.webm"
    write_webm(video, frames, fps=30.0)
    save_hidden(hidden_path(video), hidden)
    sha256 = hashlib.sha256(video.read_bytes()).hexdigest()
    height, width, _ = frames[0].shape
    return Demo(
        name="falling", sha256=sha256, path=video, fps=30.0, frames=FRAMES, width=width, height=height,
        task="backflip",
    )  # fmt: skip


def small_config(**overrides):
    """Settings under which a whole run takes seconds, of the paper's method unless told otherwise."""
    small = {
        "method": "paper",
        "ratings.pretrain": 12,
        "ratings.online": 6,
        "ratings.queue": 4,
        "rollouts.lanes": 8,
        "rollouts.steps": 50,
        "rollouts.total_steps": 2400,
        "rollouts.threads": 1,
        "predictor.updates": 60,
        "predictor.visual_dims": 8,
        "practice.random_lanes": 8,
        "practice.bank_tries": 500,
    }
    return load_config(None, small | {key.replace("__", "."): value for key, value in overrides.items()})


def _stick_figure(qpos: np.ndarray) -> np.ndarray:
    image = np.full((120, 160, 3), 235, np.uint8)
    points = {k: (80 + 40 * (p[0] - qpos[0]), 105 - 40 * p[1]) for k, p in joint_points(qpos).items()}
    for a, b in (("top", "hip"), ("hip", "knee"), ("knee", "ankle"), ("heel", "toe")):
        start, end = (tuple(int(v) for v in points[name]) for name in (a, b))
        cv2.line(image, start, end, (180, 60, 30), 5, cv2.LINE_AA)
    return image
