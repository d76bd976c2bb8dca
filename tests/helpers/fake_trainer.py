"""A trainer that does not learn, for tests of the page: the real store, real clips, a given status."""

from __future__ import annotations

import functools
import hashlib
import threading
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from onedemo.rl.rollouts import Acting, EpisodeRules
from onedemo.robots.registry import robot_named
from onedemo.storage.clips import NewClip
from onedemo.storage.store import Store
from onedemo.types import Clip, Demo, Segment, Status

if TYPE_CHECKING:
    from onedemo.vision.pose_estimator import Track

FPS = 30.0
SIZE = (360, 480)
DEMO_FRAMES = 240


@functools.cache
def drawn_frames(count: int, phase: float = 0.0) -> np.ndarray:
    """A stick that turns: pictures that differ from frame to frame, drawn once for all tests."""
    import cv2

    frames = np.full((count, *SIZE, 3), (236, 239, 243), np.uint8)
    for index, frame in enumerate(frames):
        angle = phase + 2 * np.pi * index / 60
        centre = np.array([240.0, 190.0])
        tip = centre + 110 * np.array([np.cos(angle), np.sin(angle)])
        frame[300:] = (214, 219, 226)
        cv2.line(
            frame, tuple(int(v) for v in centre), tuple(int(v) for v in tip), (47, 93, 196), 22, cv2.LINE_AA
        )
        cv2.circle(frame, tuple(int(v) for v in centre), 18, (232, 150, 60), -1, cv2.LINE_AA)
    return frames


@functools.cache
def clip_picture(start: int, *phases: float) -> bytes:
    """Ten frames of the demo from ``start`` on, beside as many robots as there are phases."""
    from onedemo.render.clip_image import compose_clip

    demo = drawn_frames(DEMO_FRAMES)[start : start + 10]
    return compose_clip(demo, *(drawn_frames(10, phase) for phase in phases))


def drawn_track() -> Track:
    """What ``drawn_frames`` of the demo show, as if the stick were a robot."""
    from onedemo.robots.registry import robot_named
    from onedemo.sim.kinematics import body_of
    from onedemo.vision.pose_estimator import Track

    body = body_of(robot_named("hopper"))
    spin = 2 * np.pi / 60 * FPS
    angles = np.repeat(spin / FPS * np.arange(DEMO_FRAMES)[:, None], 4, axis=1)
    pose = body.pose_of(np.full(DEMO_FRAMES, 1.2), angles)
    motion = body.motion_of(np.zeros(DEMO_FRAMES), angles, np.full_like(angles, spin))
    return Track(pose=pose.astype(np.float32), motion=motion.astype(np.float32))


class Wobble:
    """A policy that holds still with a wobble."""

    horizon = 1000

    def inputs(self, obs: np.ndarray, clock: np.ndarray) -> np.ndarray:
        return clock[:, None]

    def act(self, inputs: np.ndarray, rng: object = None) -> np.ndarray:
        return 0.6 * np.sin(inputs / 20 + np.arange(3))


class StandIn:
    """What the page needs of a trainer."""

    def __init__(self, data_dir: Path, *, clips: int = 8, target: int = 200) -> None:
        self.store = Store(data_dir)
        self.data_dir = data_dir
        self.run = "backflip-1"
        self.directory = data_dir / "runs" / self.run / "clips"
        self.directory.mkdir(parents=True)
        # One's own, as browsers keep pictures under it, and what it shows differs from test to test.
        sha256 = hashlib.sha256(bytes(data_dir)).hexdigest()
        self.demo = Demo(
            name="hopper-backflip", sha256=sha256, path=data_dir / "demo.mp4", fps=FPS, frames=DEMO_FRAMES,
            width=480, height=360, task="backflip",
        )  # fmt: skip
        self.store.runs.add(
            run=self.run, demo=self.demo.name, demo_sha256=sha256, seed=0, config="", version="0"
        )
        self.demo.path.touch()
        self.frames = drawn_frames(DEMO_FRAMES)
        self._lock = threading.Lock()
        self._status = Status(
            phase="pretrain",
            message="The robot is waiting for your first ratings.",
            method="onedemo",
            target_ratings=target,
            total_steps=2_000_000,
        )
        self.calls: list[str] = []
        self.track: Track | None = None
        self.add_clips(clips)

    def add_clips(self, count: int) -> list[int]:
        new = [
            NewClip(demo_step=25 * i % 900, segment=_zeros(), stage="pretrain", iteration=0)
            for i in range(count)
        ]
        ids = [clip.id for clip in self.store.clips.add(self.run, new)]
        for number in ids:
            self.clip_file(number).write_bytes(clip_picture(number * 9 % 200, number))
        self.store.clips.set_state(ids, "ready")
        return ids

    def set_status(self, **changes) -> None:
        with self._lock:
            self._status = replace(self._status, **changes)

    def status(self) -> Status:
        with self._lock:
            return self._status

    dt = 0.008
    robot = robot_named("hopper")

    def clip_file(self, clip_id: int) -> Path:
        return self.directory / f"{clip_id:06d}.jpg"

    def clip_picture(self, clip: Clip) -> Future[Path]:
        return _there(self.clip_file(clip.id))

    def pair_picture(self, pair_id: int) -> Future[Path]:
        return _there(self.pair_file(pair_id))

    def want_pairs(self) -> None:
        self.calls.append("pairs")

    def pair_file(self, pair_id: int) -> Path:
        return self.directory / f"pair-{pair_id}.jpg"

    def add_pairs(self, count: int) -> list[int]:
        from onedemo.storage.comparisons import NewPair

        pair = NewPair(demo_step=100, left=_zeros(), right=_zeros(), stage="pretrain", iteration=0)
        ids = [pair.id for pair in self.store.comparisons.add_pairs(self.run, [pair] * count)]
        for number in ids:
            self.pair_file(number).write_bytes(clip_picture(0, number, number + 1))
        self.store.comparisons.set_pair_state(ids, "ready")
        return ids

    def rollout_picture(self, iteration: int, suffix: str) -> Future[Path]:
        from onedemo.demos.video import write_webm

        if not 1 <= iteration <= len(self.store.runs.iterations(self.run)):
            raise FileNotFoundError(iteration)
        file = self.directory / f"rollout-{iteration}.{suffix}"
        if suffix == "jpg":
            import cv2

            cv2.imwrite(str(file), np.concatenate(drawn_frames(6, phase=iteration), axis=1)[::3, ::3])
        else:
            write_webm(file, drawn_frames(30, phase=iteration), fps=FPS)
        return _there(file)

    def acting(self) -> Acting:
        return Acting(policy=Wobble(), rules=EpisodeRules())  # type: ignore[arg-type]

    def pause(self) -> None:
        self.calls.append("pause")
        self.set_status(phase="paused")

    def resume(self) -> None:
        self.calls.append("resume")
        self.set_status(phase="online")

    def stop(self, timeout_s: float = 60.0) -> None:
        self.calls.append("stop")
        self.set_status(phase="stopped")


def _there(file: Path) -> Future[Path]:
    future: Future[Path] = Future()
    future.set_result(file)
    return future


def _zeros() -> Segment:
    """41 steps, of which 25 are 6 pictures: a clip from a multiple of 25 on has ten."""
    sizes = {"obs": 11, "actions": 3, "qpos": 6, "qvel": 6}
    return Segment(**{name: np.zeros((41, size)) for name, size in sizes.items()})
