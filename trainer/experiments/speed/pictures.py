"""Pictures beside their peers: drawing the robot, looking at the demo, and how that grows with it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import gymnasium
import numpy as np
import torch

from onedemo.config import PredictorConfig
from onedemo.demos.library import find_demo, read_frames
from onedemo.demos.video import write_webm
from onedemo.errors import UserError
from onedemo.experiments.speed.figures import Figure, Growth, Result, Skipped, by_turns, ratio, single
from onedemo.render.render_thread import RenderThread
from onedemo.reward.model import visual_inputs
from onedemo.types import Demo
from onedemo.vision.encoders import EfficientNetLite0, demo_features, published_lite0
from onedemo.vision.folded import SIDE

_CLIP = 10  # pictures
_WIDTH, _HEIGHT = 320, 240
_TOLERANCE = 1e-3
_DEMO = "hopper-backflip"

T = TypeVar("T")

# The first call of a process, as at a start: imports are not the cache's.
_CACHED = """
import sys, time
from pathlib import Path
from typing import Any, TypeVar
from onedemo.demos.library import find_demo
from onedemo.vision.encoders import demo_features, make_encoder
demo = find_demo(sys.argv[1], Path(sys.argv[2]))
began = time.perf_counter()
demo_features(demo, make_encoder("efficientnet-lite0"), Path(sys.argv[2]))
print(1000 * (time.perf_counter() - began))
"""


def measure(quick: bool, *, seconds: tuple[int, ...] | None = None) -> list[Result]:
    """Takes all figures about pictures.

    Args:
        quick: Fewer repetitions and a shorter longest demo.
        seconds: Lengths of the demos whose cost is charted; None: 8 to 60, quick 2 to 8.

    Returns:
        ``render_vs_gymnasium``, ``features_vs_single`` and the same on one core,
        ``features_cached_ms``, and the growth ``demo_length``.
    """
    seconds = seconds or ((2, 8) if quick else (8, 16, 32, 60))
    with tempfile.TemporaryDirectory() as directory:
        place = Path(directory)
        return [
            _render(turns=3 if quick else 12),
            *_features(turns=3 if quick else 10),
            _cached(place, turns=2 if quick else 5),
            _demo_length(place, seconds),
        ]


def poses(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Robots as random rollouts from random heights and angles show them: flying, standing, fallen.

    Returns:
        Positions and velocities, (count, 6) each.
    """
    env = gymnasium.make("Hopper-v5", terminate_when_unhealthy=False, max_episode_steps=150)
    robot: Any = env.unwrapped
    rng = np.random.default_rng(0)
    states = []
    for episode in range(5):
        env.reset(seed=episode)
        env.action_space.seed(episode)
        qpos = robot.data.qpos.copy()
        qpos[1:3] += rng.uniform(0, 1), rng.uniform(-np.pi, np.pi) if episode else 0.0
        robot.set_state(qpos, robot.data.qvel)
        for _ in range(150):
            env.step(env.action_space.sample())
            states.append((robot.data.qpos.copy(), robot.data.qvel.copy()))
    env.close()
    chosen = np.linspace(0, len(states) - 1, count).astype(int)
    return np.array([states[i][0] for i in chosen]), np.array([states[i][1] for i in chosen])


def _render(turns: int) -> Figure | Skipped:
    name = "render_vs_gymnasium"
    qpos, qvel = poses(3 * _CLIP)
    try:
        ours = RenderThread(_WIDTH, _HEIGHT)
    except UserError as error:
        return Skipped(name=name, reason=str(error))
    # Each side in a thread of its own: a GL context belongs to the thread that made it.
    with ours, ThreadPoolExecutor(1) as theirs:
        env = gymnasium.make("Hopper-v5", render_mode="rgb_array", width=_WIDTH, height=_HEIGHT)
        robot: Any = env.unwrapped

        def draw_ours() -> float:
            began = time.perf_counter()
            for clip in qpos.reshape(-1, _CLIP, qpos.shape[1]):
                ours.render(clip).result()
            return len(qpos) / (time.perf_counter() - began)

        def draw_theirs() -> float:
            began = time.perf_counter()
            for q, v in zip(qpos[:_CLIP], qvel[:_CLIP], strict=True):
                robot.set_state(q, v)
                env.render()
            return _CLIP / (time.perf_counter() - began)

        theirs.submit(env.reset).result()
        taken = by_turns({"ours": draw_ours, "theirs": lambda: theirs.submit(draw_theirs).result()}, turns)
        theirs.submit(env.close).result()
    return ratio(
        name, f"pictures of the Hopper, {_WIDTH}x{_HEIGHT}, clips of {_CLIP}",
        ours=taken["ours"], theirs=taken["theirs"], against="gymnasium Hopper-v5 rgb_array", reach=8,
        equal="the same positions from random rollouts, one by one, in a thread each", unit="frames/s",
    )  # fmt: skip


def one_at_a_time(network: Any, frames: np.ndarray) -> np.ndarray:
    """Features by the network as its package has it, a frame at a time, (n, 1280)."""
    features = []
    with torch.no_grad():
        for frame in frames:
            square = cv2.resize(frame, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
            pixels_13HW = torch.from_numpy(square[None]).permute(0, 3, 1, 2).float().contiguous()
            maps = network.extract_features((pixels_13HW - 127) / 128)
            features.append(maps.mean((2, 3)).numpy()[0])
    return np.stack(features)


def _features(turns: int) -> list[Result]:
    frames = read_frames(find_demo(_DEMO, Path()))[:: 30 if turns < 10 else 5]
    network, encoder = published_lite0(), EfficientNetLite0()
    wanted = one_at_a_time(network, frames)
    error = float(np.linalg.norm(encoder.encode(frames) - wanted) / np.linalg.norm(wanted))
    if error > _TOLERANCE:
        raise RuntimeError(f"the features differ from the package's by {error:.1e} of their length")
    cores = torch.get_num_threads()

    def rate(job: Callable[[], object], threads: int) -> Callable[[], float]:
        def once() -> float:
            torch.set_num_threads(threads)
            began = time.perf_counter()
            job()
            took = time.perf_counter() - began
            torch.set_num_threads(cores)
            return len(frames) / took

        return once

    taken = by_turns(
        {
            "ours": rate(lambda: encoder.encode(frames), cores),
            "theirs": rate(lambda: one_at_a_time(network, frames), cores),
            "ours, one core": rate(lambda: encoder.encode(frames), 1),
            "theirs, one core": rate(lambda: one_at_a_time(network, frames), 1),
        },
        turns,
    )
    # Where others want the cores, theirs is faster on one: it gets the better of the two.
    best = [max(pair) for pair in zip(taken["theirs"], taken["theirs, one core"], strict=True)]
    against = "its package, one frame at a time"
    equal = f"the same frames, scaling included; features differ by {error:.0e}"
    return [
        ratio(
            "features_vs_single", "demo features, EfficientNet-Lite0, all cores",
            ours=taken["ours"], theirs=best, against=f"{against}, the better of one thread and all",
            reach=3, equal=equal, unit="frames/s",
        ),
        ratio(
            "features_vs_single_one_core", "the same on one core",
            ours=taken["ours, one core"], theirs=taken["theirs, one core"], against=against,
            reach=None, equal=equal, unit="frames/s",
        ),
    ]  # fmt: skip


def _cached(place: Path, turns: int) -> Figure:
    demo = find_demo(_DEMO, place)
    demo_features(demo, EfficientNetLite0(), place)
    command = [sys.executable, "-c", _CACHED, _DEMO, str(place)]
    taken = [
        float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        for _ in range(turns)
    ]
    return single(
        "features_cached_ms", "features of an 8 s demo at the second start", taken, unit="ms", reach=50,
        how="first call in a new process, making the encoder included, imports not",
    )  # fmt: skip


def _demo_length(place: Path, seconds: tuple[int, ...]) -> Growth:
    original = find_demo(_DEMO, place)
    frames = read_frames(original)
    encoder = EfficientNetLite0()
    encoder.encode(frames[:1])
    lines: dict[str, list[float]] = {}
    for length in seconds:
        path = place / f"{length}.webm"
        count = round(length * original.fps)
        write_webm(path, (frames[i % len(frames)] for i in range(count)), fps=original.fps)
        demo = replace(original, path=path, frames=count, sha256=f"{length}-seconds")
        for line, cost in _costs(demo, encoder, place).items():
            lines.setdefault(line, []).append(cost)
    return Growth(
        name="demo_length", title="A longer demonstration", x_label="length of the demo, s",
        y_label="seconds", x=seconds, y=lines,
    )  # fmt: skip


def _costs(demo: Demo, encoder: EfficientNetLite0, place: Path) -> dict[str, float]:
    costs: dict[str, float] = {}
    features, costs["features"] = _timed(lambda: demo_features(demo, encoder, place))
    _, costs["features from the cache"] = _timed(lambda: demo_features(demo, encoder, place))
    dims = PredictorConfig().visual_dims
    _, costs["predictor's inputs"] = _timed(lambda: visual_inputs(features, dims))
    _, costs["all frames read"] = _timed(lambda: read_frames(demo))
    return costs


def _timed(job: Callable[[], T]) -> tuple[T, float]:
    """What the job gives, and the seconds it takes."""
    began = time.perf_counter()
    result = job()
    return result, time.perf_counter() - began
