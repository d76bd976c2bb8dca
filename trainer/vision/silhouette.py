"""The pose of a robot from its silhouette, learned from masks that are drawn of its own model.

A small convolutional net looks at the shape in each frame, and convolutions along time put frames side by
side, so that rates and travel are read, too, and what one frame hides the next one shows. Nothing depends on
colours, lights or the floor: what masks are found in any video will do. It sees no demo and no rating, is
learned once for a robot's model, and kept.

Shapes: F frames, S x S pixels, K numbers of a place, P numbers of a pose, A = 2 P + 2 numbers that are read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from onedemo.types import Demo
from onedemo.vision import learned_robots
from onedemo.vision.mask_file import masks_of
from onedemo.vision.masks import Masks
from onedemo.vision.pose_estimator import Track, shipped_track
from onedemo.vision.silhouette_pictures import TRAVEL_SCALE, Films, films
from onedemo.vision.silhouette_views import FOUND, PLACES, RATE, SIDE, Views, views

VERSION = 1
"""Raise it when what is drawn or how it is learned changes."""
MEMBERS = 2
"""Networks: the one that is learned, as it is at the end of each of the last cycles (Huang et al. 2017)."""
_SEED = 30_000
_FILMS = 2000
_EPOCHS = 7
"""Passes over them in each of some cycles of the learning rate."""
_CYCLES = 3
_BATCH = 12
"""Films at a time."""
_RATE = 2e-3
_DRAWING = 0.35
"""Share of the time that drawing takes, as measured."""
_WIDTH = 96
_HELD_OUT = 0.1
_ANOTHER = 0.5
"""Doubt of half of the frames of a video from which on it shows another body."""
_COARSE = 4
"""Pixels along a side of the parts whose covered share is compared with that of the pose that was read."""


class Silhouette:
    """Reads pose, motion, travel and contact from silhouettes: two small networks, averaged.

    Args:
        tensors: Their weights, and how right they were, as ``learn`` gives them.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray]) -> None:
        self.tensors = dict(tensors)
        self.reach = float(tensors["reach"])
        """Length of the robot stretched out, metres."""
        self.held_out = np.asarray(tensors["held_out"], np.float64)
        """Explained share of the variance of each number on films held out, (A,)."""
        self._doubts = np.asarray(tensors["doubts"], np.float64)
        self._swaps = np.asarray(tensors["swaps"], np.intp)
        self._unit = bool(tensors["unit"])
        self._nets = [_Net(len(self.held_out)) for _ in range(MEMBERS)]
        for member, net in enumerate(self._nets):
            names = net.state_dict()
            weights = {n: torch.from_numpy(np.asarray(tensors[f"{member}.{n}"], np.float32)) for n in names}
            net.load_state_dict(weights)
            net.eval().requires_grad_(False)

    def read(self, seen: Views) -> tuple[np.ndarray, np.ndarray]:
        """What silhouettes show.

        Args:
            seen: Of frames that follow each other, ``RATE`` a second.

        Returns:
            The numbers, (F, A), and the doubt, (F,): 0 is sure, 1 may be any.
        """
        each, signs = self._signs(seen)
        return each.mean(axis=0), np.sqrt(np.clip(signs @ self._doubts, 0, 1))

    def _signs(self, seen: Views) -> tuple[np.ndarray, np.ndarray]:
        """What each net reads, (M, F, A), and signs that it is wrong, (F, 4).

        An unsure mean of directions lies inside the circle; nets differ where they have not learned; and the
        robot in the pose that was read would cover other pixels.
        """
        with _one_thread():
            first, *others = [net.along(seen) for net in self._nets]
            each = np.stack([first, *(_nearest(first, other, self._swaps) for other in others)])
            pose = each[..., : self._pose].mean(axis=0)
            drawn = np.mean([net.drawn(pose) for net in self._nets], axis=0)
        waves = pose[:, 1:].reshape(len(pose), -1, 2)
        short = np.maximum(1 - np.square(waves).sum(axis=-1), 0).mean(axis=-1)
        spread = each[..., : self._pose].var(axis=0).sum(axis=-1)
        covered = _coarse(torch.from_numpy(seen.crops)).numpy()
        unlike = np.square(drawn - covered).sum(axis=-1) / (np.square(covered).sum(axis=-1) + 1e-3)
        return each, np.stack([np.ones_like(short), short, spread, np.minimum(unlike, 4)], axis=-1)

    def numbers(self, found: Masks, fps: float) -> tuple[np.ndarray, np.ndarray]:
        """What is read of the frames of a video.

        Args:
            found: Where the robot is, at the scale of this robot.
            fps: Frames a second.

        Returns:
            As ``read``: frames in which nothing was found have a doubt of 1.
        """
        times = np.arange(len(found.masks)) / fps
        looked = np.arange(0, times[-1] + 0.5 / RATE, 1 / RATE)
        nearest = np.abs(looked[:, None] - times).argmin(axis=1)
        seen = views(
            found.masks, floor=found.floor, scale=found.scale, way=found.way, reach=self.reach, fps=fps
        )
        numbers, doubt = self.read(Views(crops=seen.crops[nearest], places=seen.places[nearest]))
        numbers = _steady(numbers, self._swaps)
        at = np.stack([np.interp(times, looked, column) for column in numbers.T], axis=1)
        return at, np.where(seen.places[:, FOUND] > 0, np.interp(times, looked, doubt), 1.0)

    def track(self, found: Masks, fps: float) -> Track | None:
        """Pose, motion, travel and contact in the frames of a video; None if it shows another body.

        Arguments as of ``numbers``.
        """
        at, doubt = self.numbers(found, fps)
        if np.median(doubt) > _ANOTHER:
            return None
        pose, motion = at[:, : self._pose], at[:, self._pose : 2 * self._pose]
        waves = pose[:, 1:].reshape(len(pose), -1, 2)
        lengths = np.linalg.norm(waves, axis=-1, keepdims=True)
        waves = waves / np.maximum(lengths, 1e-6 if self._unit else 1.0)
        pose = np.concatenate([pose[:, :1], waves.reshape(len(pose), -1)], axis=1)
        stands = np.isfinite(found.floor).any()
        return Track(
            pose=pose.astype(np.float32), motion=motion.astype(np.float32),
            travel=None if found.way is None else (at[:, -2] / TRAVEL_SCALE).astype(np.float32),
            contact=np.clip(at[:, -1], 0, 1).astype(np.float32) if stands else None,
            doubt=doubt.astype(np.float32),
        )  # fmt: skip

    @property
    def _pose(self) -> int:
        return (len(self.held_out) - 2) // 2


def seen_in(
    demo: Demo, env_name: str, cache_dir: Path, check: Callable[[float], None] = lambda _: None
) -> Track | None:
    """What a demo shows of a robot: of a built-in one as it was kept beside its video, else read now.

    Args:
        demo: The demo.
        env_name: The robot.
        cache_dir: As of ``learn``.
        check: The same.

    Returns:
        None if it shows another body.

    Raises:
        UserError: If the stored video is missing or damaged, or this machine cannot draw.
    """
    if (track := known_track(demo, env_name)) is not None:
        return track
    learned = learn(env_name, cache_dir, check)
    return learned.track(masks_of(demo, learned.reach), demo.fps)


def known_track(demo: Demo, env_name: str) -> Track | None:
    """What a built-in demo of a robot shows, as it is kept beside its video; None for any other."""
    return shipped_track(demo) if demo.robot == env_name else None


def file_name(env_name: str) -> str:
    """Names the file of what is learned of a robot."""
    return f"{learned_robots.model_name(env_name)}-silhouette-v{VERSION}"


def learn(
    env_name: str, cache_dir: Path, check: Callable[[float], None] = lambda _: None, *,
    count: int = _FILMS, epochs: int = _EPOCHS, shipped: bool = True,
) -> Silhouette:  # fmt: skip
    """Learns what the robot's silhouettes show, or takes what was learned before.

    Args:
        env_name: The robot.
        cache_dir: Where it is kept, by the robot's model.
        check: Called now and then with the share that is done; what it raises ends the learning.
        count: Films to learn from, where it is not known yet.
        epochs: Passes over them in a cycle.
        shipped: Whether what comes with the program will do.

    Raises:
        UserError: If this machine cannot draw.
    """
    name = file_name(env_name)
    if (known := learned_robots.find(name, cache_dir, shipped=shipped)) is not None:
        return Silhouette(known)

    def drawn(share: float) -> None:
        check(_DRAWING * share)

    def fitted(share: float) -> None:
        check(_DRAWING + (1 - _DRAWING) * share)

    learned = fit(films(env_name, count, _SEED, drawn), fitted, epochs=epochs)
    learned_robots.keep(name, cache_dir, learned.tensors)
    return learned


def fit(
    shown: Films, check: Callable[[float], None] = lambda _: None, *, epochs: int = _EPOCHS
) -> Silhouette:
    """Fits the networks; the last tenth of the films is held out and judges them, and their doubt.

    One thread computes, so that the same films give the same networks on any machine of a kind.

    Args:
        shown: What is learned from.
        check: Called before each pass over them with the share that is done; what it raises ends the fit.
        epochs: Passes over them in a cycle.
    """
    with _one_thread():
        return _fit(shown, check, epochs)


def _fit(shown: Films, check: Callable[[float], None], epochs: int) -> Silhouette:
    generator = torch.Generator().manual_seed(_SEED)
    count, _, size = shown.aims.shape
    train = count - max(1, round(_HELD_OUT * count))
    crops, places, aims = (torch.from_numpy(x) for x in (shown.crops, shown.places, shown.aims))
    tensors: dict[str, np.ndarray] = {
        "reach": np.array(shown.reach), "held_out": np.zeros(size), "doubts": np.zeros(4),
        "swaps": shown.swaps, "unit": np.array(_all_unit(shown.aims)),
    }  # fmt: skip
    swaps = torch.from_numpy(shown.swaps)
    net = _Net(size)
    net.draw_weights(generator)
    for cycle in range(_CYCLES):
        optimiser = torch.optim.AdamW(net.parameters(), weight_decay=2e-2, fused=True)
        updates = epochs * -(-train // _BATCH)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=updates)
        for epoch in range(epochs):
            check((cycle + epoch / epochs) / _CYCLES)
            for index in torch.randperm(train, generator=generator).split(_BATCH):
                loss = net.loss(crops[index], places[index], aims[index], swaps)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
        if (member := cycle + MEMBERS - _CYCLES) >= 0:
            state = net.state_dict()
            tensors |= {f"{member}.{name}": x.detach().numpy().copy() for name, x in state.items()}
    return _judged(tensors, shown, train)


def _judged(tensors: Mapping[str, np.ndarray], shown: Films, train: int) -> Silhouette:
    """With how right it is about the films that were held out, and what tells how right it is."""
    learned = Silhouette(tensors)
    aims = shown.aims[train:]
    looked = [
        learned._signs(Views(crops=crops, places=places))
        for crops, places in zip(shown.crops[train:], shown.places[train:], strict=True)
    ]
    read = [each.mean(axis=0) for each, _ in looked]
    error = np.stack([_least_error(*pair, shown.swaps) for pair in zip(read, aims, strict=True)])
    spread = np.square(aims - aims.mean(axis=(0, 1))).mean(axis=(0, 1))
    size = (aims.shape[-1] - 2) // 2
    wrong = error[..., :size].mean(axis=-1).ravel() / spread[:size].mean()
    return Silhouette({
        **tensors,
        "held_out": 1 - error.mean(axis=(0, 1)) / np.maximum(spread, 1e-9),
        "doubts": _weights(np.concatenate([signs for _, signs in looked]), wrong),
    })  # fmt: skip


def _least_error(read: np.ndarray, aims: np.ndarray, swaps: np.ndarray) -> np.ndarray:
    """Squared errors of a film, (F, A), with limbs that are alike in the places that fit best."""
    return min((np.square(read[:, order] - aims) for order in swaps), key=np.mean)


def _nearest(to: np.ndarray, numbers: np.ndarray, swaps: np.ndarray) -> np.ndarray:
    """Numbers of frames, (F, A), with limbs that are alike in each frame as they are most like others."""
    if len(swaps) == 1:
        return numbers
    each = numbers[:, swaps]  # (F, k, A)
    best = np.square(each - to[:, None]).sum(axis=-1).argmin(axis=1)
    return each[np.arange(len(numbers)), best]


def _steady(numbers: np.ndarray, swaps: np.ndarray) -> np.ndarray:
    """Numbers of a video, (F, A), in which limbs that are alike change places as little as can be.

    The likeliest way through the orders of all frames (Viterbi): what it costs is how far poses and rates, by
    which limbs that cross are told apart, jump from frame to frame.
    """
    if len(swaps) == 1:
        return numbers
    each = numbers[:, swaps]  # (F, k, A)
    jumps = np.linalg.norm(each[1:, :, None] - each[:-1, None], axis=-1)  # (F - 1, to, from)
    cost, came = np.zeros(len(swaps)), []
    for jump in jumps:
        came.append((jump + cost).argmin(axis=1))
        cost = (jump + cost).min(axis=1)
    order = [int(cost.argmin())]
    for step in reversed(came):
        order.append(int(step[order[-1]]))
    return np.take_along_axis(numbers, swaps[order[::-1]], axis=1)


def _all_unit(aims: np.ndarray) -> bool:
    """Whether the directions of limbs lie in the plane that is seen."""
    size = (aims.shape[-1] - 2) // 2
    waves = aims[..., 1:size].reshape(-1, 2)
    return bool(np.abs(np.linalg.norm(waves, axis=-1) - 1).max() < 1e-3)


def _weights(signs: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Weights of signs, (n, k), whose sum is nearest to errors, (n,); none below zero."""
    kept = list(range(signs.shape[1]))
    while True:
        weights = np.linalg.lstsq(signs[:, kept], wrong, rcond=None)[0]
        if (weights >= 0).all() or len(kept) == 1:
            break
        del kept[int(np.argmin(weights))]
    found = np.zeros(signs.shape[1])
    found[kept] = np.maximum(weights, 0)
    return found


class _Net(nn.Module):
    """Convolutions over each picture, and then along time."""

    def __init__(self, numbers: int) -> None:
        super().__init__()
        layer = nn.utils.skip_init
        sizes = ((1, 48, 8, 4, 2), (48, 64, 3, 2, 1), (64, 64, 3, 2, 1))
        self.look = nn.ModuleList([layer(nn.Conv2d, *size) for size in sizes])
        self.gather = layer(nn.Linear, 64 * (SIDE // 16) ** 2, _WIDTH)
        steps = ((_WIDTH + PLACES, 1), (_WIDTH, 1), (_WIDTH, 2))
        self.follow = nn.ModuleList([layer(nn.Conv1d, a, _WIDTH, 3, padding=d, dilation=d) for a, d in steps])
        self.say = layer(nn.Linear, _WIDTH, numbers)
        self.cover = nn.Sequential(
            layer(nn.Linear, (numbers - 2) // 2, 96), nn.ReLU(), layer(nn.Linear, 96, (SIDE // _COARSE) ** 2)
        )

    def draw_weights(self, generator: torch.Generator) -> None:
        """Draws first weights, by which signals keep their size (He et al. 2015)."""
        for weights in self.parameters():
            if weights.dim() > 1:
                nn.init.kaiming_normal_(weights, nonlinearity="relu", generator=generator)
            else:
                nn.init.zeros_(weights)

    def forward(self, crops: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
        """Numbers of films, (n, T, S, S) uint8 and (n, T, K) to (n, T, A)."""
        x = crops.flatten(0, 1)[:, None].float().div_(255)
        for convolution in self.look:
            x = functional.relu_(convolution(x))
        x = functional.relu_(self.gather(x.flatten(1))).unflatten(0, crops.shape[:2])
        x = torch.cat([x, places], dim=-1).transpose(1, 2)
        for number, convolution in enumerate(self.follow):
            y = functional.relu(convolution(x))
            x = y if number == 0 else x + y
        return self.say(x.transpose(1, 2))

    def loss(
        self, crops: torch.Tensor, places: torch.Tensor, aims: torch.Tensor, swaps: torch.Tensor
    ) -> torch.Tensor:
        """How wrong it is about films, and about what pixels the robot covers in the poses that they show.

        Limbs that are alike may have changed places in a film, but in all of it.
        """
        read = self(crops, places)
        wrong = [(read - aims[..., order]).square().mean(dim=(1, 2)) for order in swaps]
        found = places[..., FOUND].flatten() > 0
        pose = aims[..., : (aims.shape[-1] - 2) // 2].flatten(0, 1)[found]
        covered = functional.mse_loss(self.cover(pose), _coarse(crops.flatten(0, 1)[found]))
        return torch.stack(wrong).amin(dim=0).mean() + covered

    def drawn(self, pose: np.ndarray) -> np.ndarray:
        """How far the robot in poses, (F, P), covers each part of the cut-out, as ``_coarse``."""
        return self.cover(torch.from_numpy(pose)).numpy()

    def along(self, seen: Views) -> np.ndarray:
        """Numbers of the frames of a video, (F, A)."""
        return self(torch.from_numpy(seen.crops)[None], torch.from_numpy(seen.places)[None])[0].numpy()


def _coarse(crops: torch.Tensor) -> torch.Tensor:
    """The share of each part of cut-outs that is covered, (F, S, S) uint8 to (F, (S / _COARSE)^2)."""
    return functional.avg_pool2d(crops[:, None].float().div_(255), _COARSE).flatten(1)


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
