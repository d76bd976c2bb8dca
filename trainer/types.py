"""The records that move between the rooms. All frozen: what was measured does not change later.

Shapes: N lanes (parallel episodes), T control steps, o observations, a actions, q positions and v velocities
of the robot (of a hopper 11, 3, 6 and 6). Arrays are lane-first, (N, T, ...).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, kw_only=True, slots=True)
class Demo:
    """The one demonstration video, resampled to a fixed frame rate."""

    name: str
    sha256: str
    """Of its pictures, hex: what it is. Of older demos, of the file."""
    path: Path
    """The normalised video file."""
    fps: float
    """Frames per second."""
    frames: int
    """How many frames."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    task: str = ""
    """The hand-coded reward that describes the move ("backflip", "hop"), or "" where none is known."""
    robot: str = ""
    """The robot that it was made with, and for; "" for a video of anything else, which is for any robot."""
    source: str = ""
    """What the video was made from: a file name or a command."""
    edits: str = ""
    """What was done to that video on its way in, in a few words."""

    @property
    def seconds(self) -> float:
        """Length of the video, in seconds."""
        return self.frames / self.fps


@dataclass(frozen=True, kw_only=True, slots=True)
class Segment:
    """The part of a rollout behind a clip: W control steps of one lane."""

    obs: np.ndarray
    """Observation before each step, (W, o)."""
    actions: np.ndarray
    """Action of each step as the policy gave it (not clipped), (W, a)."""
    qpos: np.ndarray
    """Positions before each step, (W, q), metres and radians."""
    qvel: np.ndarray
    """Velocities before each step, (W, v), metres/s and radians/s."""

    def __post_init__(self) -> None:
        lengths = {len(self.obs), len(self.actions), len(self.qpos), len(self.qvel)}
        if len(lengths) != 1:
            raise ValueError(f"a segment's arrays must have equal lengths, got {sorted(lengths)}")

    def __len__(self) -> int:
        return len(self.obs)


@dataclass(frozen=True, kw_only=True, slots=True)
class Rollouts:
    """What N lanes did in T control steps. Lane-first arrays; all states are those *before* the step."""

    obs: np.ndarray
    """Observations, (N, T, o), float64."""
    actions: np.ndarray
    """Actions as sampled (the environment clips them), (N, T, a), float32."""
    qpos: np.ndarray
    """Positions, (N, T, q), float64."""
    qvel: np.ndarray
    """Velocities, (N, T, v), float64."""
    clock: np.ndarray
    """The demo step that belongs to the state, (N, T), int32."""
    inputs: np.ndarray
    """Normalised policy inputs, (N, T, i), float32."""
    next_inputs: np.ndarray
    """Normalised policy inputs of the state after the step, before any reset, (N, T, i), float32."""
    rewards: np.ndarray
    """What each step was worth, (N, T), as the episode rules say; under plain ones the environment's own."""
    terminated: np.ndarray
    """True where the step reached a terminal state, (N, T), bool."""
    truncated: np.ndarray
    """True where the step reached the time limit, (N, T), bool."""

    def segment(self, lane: int, start: int, length: int) -> Segment:
        """Cuts steps ``start`` .. ``start + length`` of one lane.

        Raises:
            ValueError: If the cut leaves the rollout or spans the end of an episode.
        """
        stop = start + length
        if not (0 <= start and stop <= self.obs.shape[1]):
            raise ValueError(f"steps {start}..{stop} are outside 0..{self.obs.shape[1]}")
        if (self.terminated | self.truncated)[lane, start : stop - 1].any():
            raise ValueError(f"steps {start}..{stop} of lane {lane} span the end of an episode")
        cut = (lane, slice(start, stop))
        return Segment(
            obs=self.obs[cut].copy(),
            actions=self.actions[cut].copy(),
            qpos=self.qpos[cut].copy(),
            qvel=self.qvel[cut].copy(),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Clip:
    """About 0.3 s of a rollout next to the demo frames of the same time span: what a person rates."""

    id: int
    run: str
    demo_step: int
    """Control step of the demo at which the clip begins."""
    stage: str
    """"pretrain" or "online"."""
    iteration: int
    """The iteration whose rollouts it was cut from; 0 in the pretrain stage."""
    snapshot: int
    """The newest snapshot when it was cut; 0 if there was none."""
    predicted: float | None
    """The rating that snapshot predicted, 1..5."""
    steps: int
    """Length, in control steps."""
    choice: str = ""
    """Why it was chosen (``trainer/queries/selection.py``); "" if it was before that was kept."""
    score: float | None = None
    """By what it was chosen: a predicted rating, a disagreement; None if by chance."""


ROLES = ("annotator", "researcher", "simulated")
"""What a rater may be."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Rater:
    """A person, or a simulated one."""

    id: int
    name: str
    role: str
    """One of ``ROLES``."""


HALTED = ("pausing", "paused", "failed", "stopping", "stopped")
"""Phases from which a run may be told to go on."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Status:
    """What the trainer is doing, as of now; the page shows it."""

    phase: str
    """"starting", "pretrain", "online", "pausing", "paused", "stopping", "stopped", "done" or "failed"."""
    message: str = ""
    """What it is starting with, one plain sentence; the page says the rest (``app/annotation/phases.py``)."""
    progress: float | None = None
    """How much of starting is done, 0 to 1; None if that is not known."""
    left_s: float | None = None
    """Seconds until it has started, from how fast it went so far; None if that is not known."""
    method: str = ""
    """How the run learns: "onedemo" or "paper"."""
    error: str = ""
    """If it failed: what went wrong, one sentence."""
    saved: bool = True
    """Whether ratings can be saved; False: the database's files are gone, and every press is refused."""
    iteration: int = 0
    """TRPO iterations so far."""
    env_steps: int = 0
    """Control steps so far."""
    total_steps: int = 0
    """Control steps at which the run is done."""
    steps_per_s: float = 0.0
    """Control steps per second in the last iteration."""
    unstable: int = 0
    """Episodes that ended because the robot's physics became unstable, so far."""
    snapshot: int = 0
    """Newest snapshot of the similarity predictor; 0 if there is none."""
    ratings: int = 0
    """Ratings that hold in this run."""
    pretrain_ratings: int = 0
    """Ratings asked for before the policy is trained."""
    target_ratings: int = 0
    """Ratings asked for in all."""
    next_clips_s: float | None = None
    """Seconds until the iteration ends, and with it new clips are expected; None if not known."""

    @property
    def asked_ratings(self) -> int:
        """Ratings that people are asked for so far, as ``RatingQueue.asked``."""
        return self.target_ratings if self.iteration else self.pretrain_ratings
