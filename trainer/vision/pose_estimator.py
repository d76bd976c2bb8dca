"""What the robot looks like, learned from pictures of its own random poses: no demo, no rating.

Random states of the robot are drawn by the renderer and encoded like the demo's frames; a small
network regresses the pose from the features. It then says what pose a demo of the *same robot* shows
in each frame. Of a demo of another body it says nothing. It depends on robot and encoder alone, so it
is learned once and kept.

Shapes: n pictures, F demo frames, D frame features, P = 9 numbers of a pose (``trainer/sim/kinematics.py``).
"""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from onedemo.core.files import read_whole, write_atomic
from onedemo.core.names import check_name
from onedemo.render.mover import contact_of, is_studio, locate, travel_of
from onedemo.render.renderer import RenderThread
from onedemo.rl.random_states import wild_rollouts
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import HEIGHT_SCALE, body_of
from onedemo.types import Demo
from onedemo.vision.encoders import Encoder

_SEED = 20_000
_STANDING = 0.25
"""Share of the pictures in which the robot began upright: random states hardly ever are."""
_MEMBERS = 3
_BATCH = 64
_RATE = 2e-3
_DRAWING = 0.7
"""Share of the time that drawing and encoding the pictures takes, as measured."""
_DROPPED = 0.2
_NOISE = 0.1
_VERSION = 4  # raise it when what is drawn or how it is learned changes
_SMOOTH = np.array([1.0, 2.0, 1.0]) / 4
_AROUND = 2
"""Frames before and after over which a speed is taken."""
_STRANGE = 10.0
"""Videos of the robot have 1.0 to 1.1, a video of a person thousands."""
_log = logging.getLogger(__name__)


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


class PoseEstimator:
    """Regresses the pose from frame features: a few small networks, averaged.

    Args:
        tensors: Mean and deviation of the features, and the networks' weights, as ``learn`` gives them.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray]) -> None:
        self.tensors = dict(tensors)
        self.held_out = tensors["held_out"]
        """Explained share of the variance of each number of the pose on pictures held out, (P,)."""
        self._nets = [_network(len(tensors["mean"])) for _ in range(_MEMBERS)]
        for member, net in enumerate(self._nets):
            names = net.state_dict()
            net.load_state_dict({name: torch.from_numpy(tensors[f"{member}.{name}"]) for name in names})
            net.eval().requires_grad_(False)

    def knows(self, features: np.ndarray) -> bool:
        """Whether frames, (F, D), show this robot, as far as can be told from how unusual they look."""
        return self.strangeness(features) < _STRANGE

    def strangeness(self, features: np.ndarray) -> float:
        """Mean square of the features of frames (F, D), in deviations of the robot's own: 1 is like them."""
        return float(np.square((features - self.tensors["mean"]) / self.tensors["std"]).mean())

    def poses(self, features: np.ndarray) -> np.ndarray:
        """Pose in each picture, (n, D) to (n, P): means over the networks, so sines may fall short of 1."""
        inputs = torch.from_numpy((features - self.tensors["mean"]) / self.tensors["std"])
        return np.mean([net(inputs).numpy() for net in self._nets], axis=0)

    def track(self, features: np.ndarray, fps: float) -> Track:
        """Pose and motion in the frames of a video.

        Args:
            features: Frame features, (F, D).
            fps: Frames per second.
        """
        poses = self.poses(features)
        height = _smooth(poses[:, 0] / HEIGHT_SCALE)
        waves = poses[:, 1:].reshape(len(poses), -1, 2)
        short = 1 - np.minimum(np.linalg.norm(waves, axis=-1), 1)  # an unsure mean lies inside the circle
        angles = _smooth(np.unwrap(np.arctan2(waves[..., 0], waves[..., 1]), axis=0))
        body = body_of(robot_named("hopper"))
        motion = body.motion_of(_rate(height, fps), angles, _rate(angles, fps))
        return Track(
            pose=body.pose_of(height, angles).astype(np.float32), motion=motion.astype(np.float32),
            doubt=np.linalg.norm(short, axis=-1).astype(np.float32),
        )  # fmt: skip


def with_ground(track: Track, frames: np.ndarray, fps: float) -> Track:
    """The same, with travel and contact where pictures tell them: those of the robot's own studio.

    Args:
        track: What F frames show.
        frames: (F, H, W, 3), uint8 RGB.
        fps: Frames per second.
    """
    mover = locate(frames) if is_studio(frames) else None
    if mover is None:
        return track
    travel, contact = travel_of(mover, fps), contact_of(mover)
    return replace(
        track, travel=None if travel is None else travel.astype(np.float32),
        contact=None if contact is None else contact.astype(np.float32),
    )  # fmt: skip


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


def _go_on(share: float) -> None:
    """Lets everything run to its end."""


def learn(
    env_name: str, encoder: Encoder, cache_dir: Path, check: Callable[[float], None] = _go_on, *,
    count: int = 4000, epochs: int = 25,
) -> PoseEstimator:  # fmt: skip
    """Learns what the robot looks like, or takes what was learned before.

    Args:
        env_name: The robot.
        encoder: Looks at the pictures.
        cache_dir: Where it is kept, by robot and encoder.
        check: Called every now and then with the share that is done; what it raises ends the learning.
        count: Pictures to learn from, where it is not known yet.
        epochs: Passes over them.

    Raises:
        UserError: If this machine cannot draw.
    """
    spec = robot_named(env_name)
    model = hashlib.sha256(spec.xml.read_bytes()).hexdigest()[:12]
    path = cache_dir / f"{check_name(env_name)}-{model}-{encoder.name}-v{_VERSION}.npz"
    if (data := read_whole(path)) is not None:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            return PoseEstimator(stored)
    appearance = regress(*pictures(env_name, encoder, count, check), check, epochs=epochs)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **appearance.tensors)
    write_atomic(path, buffer.getvalue())
    return appearance


def pictures(
    env_name: str, encoder: Encoder, count: int, check: Callable[[float], None] = _go_on
) -> tuple[np.ndarray, np.ndarray]:
    """Draws and encodes what random actions do from random and from standing starts.

    States that physics has run on for a while look like those of a demo: parts rest on the ground,
    joints on their stops. With purely random poses the regression explained a tenth less of the demos.

    Returns:
        Features (n, D) and poses (n, P), float32, in random order.
    """
    every = 10
    steps = 8 * every
    rollouts = wild_rollouts(
        env_name, lanes=-(-count // 8), steps=steps, every=steps, seed=_SEED, standing=_STANDING
    )
    qpos = rollouts.qpos[:, ::every].reshape(-1, rollouts.qpos.shape[-1])
    qpos = np.random.default_rng(_SEED).permutation(qpos)[:count]
    with RenderThread() as drawing:  # a thread of its own: those of the encoder take turns at asking

        def drawn() -> Iterator[np.ndarray]:
            for number, q in enumerate(qpos):
                check(_DRAWING * number / len(qpos))
                yield drawing.render(q[None]).result()[0]

        features = encoder.encode(drawn())
    return features, body_of(robot_named(env_name)).pose(qpos[:, 1:]).astype(np.float32)


def regress(
    features: np.ndarray, poses: np.ndarray, check: Callable[[float], None] = _go_on, *, epochs: int = 25
) -> PoseEstimator:
    """Fits the networks; the last tenth of the pictures is held out and judges them.

    One thread computes: several would add up in another order, and runs with another number of
    ``rollouts.threads`` would see other poses. They would also be slower, as the networks are small.

    Args:
        features: (n, D).
        poses: (n, P).
        check: Called before each pass over the pictures with the share that is done, counting the drawing
            of them; what it raises ends the fit.
        epochs: Passes over the pictures.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _regress(features, poses, check, epochs)
    finally:
        torch.set_num_threads(threads)


def _regress(
    features: np.ndarray, poses: np.ndarray, check: Callable[[float], None], epochs: int
) -> PoseEstimator:
    generator = torch.Generator().manual_seed(_SEED)
    mean, std = features.mean(axis=0), features.std(axis=0) + 1e-3
    inputs, targets = torch.from_numpy((features - mean) / std), torch.from_numpy(poses)
    train = len(inputs) * 9 // 10
    tensors = {"mean": mean, "std": std, "held_out": np.zeros(poses.shape[1])}
    updates = epochs * -(-train // _BATCH)
    for member in range(_MEMBERS):
        net = _network(features.shape[1])
        _draw_weights(net, generator)
        optimiser = torch.optim.AdamW(net.parameters(), _RATE, weight_decay=1e-2, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=updates)
        for epoch in range(epochs):
            check(_DRAWING + (1 - _DRAWING) * (member + epoch / epochs) / _MEMBERS)
            for index in torch.randperm(train, generator=generator).split(_BATCH):
                seen = inputs[index]
                # Features that are missing or off must not matter: dropout and noise of our own generator.
                seen = seen * (torch.rand(seen.shape, generator=generator) > _DROPPED) / (1 - _DROPPED)
                seen = seen + _NOISE * torch.randn(seen.shape, generator=generator)
                loss = functional.mse_loss(net(seen), targets[index])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
        tensors |= {f"{member}.{name}": x.detach().numpy().copy() for name, x in net.state_dict().items()}
    appearance = PoseEstimator(tensors)
    error = np.square(appearance.poses(features[train:]) - poses[train:]).sum(axis=0)
    spread = np.square(poses[train:] - poses[train:].mean(axis=0)).sum(axis=0)
    appearance.held_out = appearance.tensors["held_out"] = 1 - error / spread
    return appearance


def _network(features: int) -> nn.Sequential:
    layer = nn.utils.skip_init
    return nn.Sequential(
        layer(nn.Linear, features, 256), nn.ReLU(), layer(nn.Linear, 256, 128), nn.ReLU(),
        layer(nn.Linear, 128, body_of(robot_named("hopper")).pose_size),
    )  # fmt: skip


def _draw_weights(net: nn.Sequential, generator: torch.Generator) -> None:
    for layer in net:
        if isinstance(layer, nn.Linear):
            bound = layer.in_features**-0.5
            nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
            nn.init.zeros_(layer.bias)


def _smooth(x: np.ndarray) -> np.ndarray:
    """A moving average along time, (F, ...). Past the ends it goes on as it came."""
    padded = np.concatenate([2 * x[:1] - x[1:2], x, 2 * x[-1:] - x[-2:-1]]) if len(x) > 1 else x[[0, 0, 0]]
    return np.sum([weight * padded[i : i + len(x)] for i, weight in enumerate(_SMOOTH)], axis=0)


def _rate(x: np.ndarray, fps: float) -> np.ndarray:
    """Change per second along time, (F, ...), over a few frames before and after."""
    times = np.arange(len(x))
    before, after = np.maximum(times - _AROUND, 0), np.minimum(times + _AROUND, len(x) - 1)
    spans = np.maximum(after - before, 1).reshape(-1, *[1] * (x.ndim - 1)) / fps
    return (x[after] - x[before]) / spans
