"""What a robot is: its model, how it is stepped and observed, what of it is seen, where it rests.

Shapes: q positions, v velocities, a actions, o observations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import gymnasium
import mujoco
import numpy as np

GYMNASIUM_ASSETS = Path(str(gymnasium.__file__)).parent / "envs/mujoco/assets"

CONTACT_MARGIN = 0.002
"""Metres between a part and the ground at which MuJoCo's contact sets in: a part can lie on the
ground at rest without reaching it. Both geoms have a margin of 0.001 (hopper.xml); MuJoCo 4 adds
them up."""

Root = Literal["planar", "free", "fixed"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """From where the robot is seen, and what of its place the camera follows."""

    right: int = 0
    """World axis (0, 1, 2 for x, y, z) that points to the right in pictures."""
    up: int = 2
    """World axis that points up in pictures."""
    distance: float = 3.0
    """Metres from the robot."""
    height: float = 0.88
    """Of the camera above the floor, metres."""
    follows: bool = True
    """Whether it follows the robot along ``right``; else it stands."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Start:
    """The standard reset: the model's own state, and noise around it."""

    positions: float = 5e-3
    """Half-width of the uniform noise on every position."""
    velocities: float = 5e-3
    """Half-width of the uniform noise on every velocity, or its deviation."""
    normal: bool = False
    """Whether the noise on velocities is normal instead of uniform."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Wild:
    """Random states: how they are spread. What is None is chosen by the model."""

    heights: tuple[float, float]
    """Range of the root's height, metres."""
    joints: tuple[tuple[float, float], ...] | None = None
    """Range of each position after the root's, radians; the joints' own ranges if None."""
    speeds: tuple[float, ...] | None = None
    """Standard deviation of each velocity, m/s and rad/s."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StockReward:
    """The hand-coded reward of gymnasium: forward speed, health, small actions. For evaluation and demos."""

    forward: float = 1.0
    """Of forward speed, per m/s."""
    healthy: float = 0.0
    """Of a step that ends healthy."""
    control: float = 1e-3
    """Cost of the squared action, per step."""
    healthy_height: tuple[float, float] | None = None
    """Open range of root heights that count as healthy, metres; None: any does."""
    healthy_angle: tuple[float, float] | None = None
    """Open range of root angles that count as healthy, radians, of planar robots; None: any does."""
    healthy_state: float = np.inf
    """Healthy: every other position and velocity is within +- this."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Robot:
    """One robot. ``build`` reads from the model what the model says."""

    name: str
    xml: Path
    """The MuJoCo model."""
    root: Root
    """How its first body moves: along two axes and about the third, freely, or not at all."""
    unseen: int
    """Leading positions that observations leave out: where the robot is on the floor."""
    frame_skip: int
    """Physics steps in a control step."""
    timestep: float
    """Physics step, seconds (the model's own)."""
    positions: int
    """q."""
    velocities: int
    """v."""
    low: tuple[float, ...]
    """What an action of -1 commands of each motor, (a,)."""
    high: tuple[float, ...]
    """What an action of 1 commands, (a,)."""
    limbs: tuple[str, ...]
    """Bodies that are drawn and compared, the root first."""
    feet: tuple[str, ...]
    """Limbs that touch the ground while the robot stands."""
    horizon: int = 1000
    """Control steps in an episode unless asked otherwise."""
    velocity_limit: float = np.inf
    """Observed velocities are clipped to +- this, m/s and rad/s."""
    camera: Camera = Camera()
    start: Start = Start()
    wild: Wild
    stock: StockReward = StockReward()

    def __post_init__(self) -> None:
        if self.frame_skip < 1 or self.horizon < 1 or self.timestep <= 0:
            raise ValueError(f"{self.name}: frame_skip, horizon and timestep must be positive")

    @property
    def dt(self) -> float:
        """Control step, seconds."""
        return self.timestep * self.frame_skip

    @property
    def action_size(self) -> int:
        """Motors, each driven in -1..1, which stands for ``low``..``high``."""
        return len(self.low)

    @property
    def obs_size(self) -> int:
        """Observations: ``qpos[unseen:]`` and the clipped ``qvel``."""
        return self.positions - self.unseen + self.velocities

    @property
    def angles(self) -> tuple[int, ...]:
        """Observations that are angles without end: joints that may turn all the way round, (..., o)."""
        model, free = model_of(self.xml), mujoco.mjtJoint.mjJNT_HINGE
        turning = (model.jnt_type == free) & (model.jnt_limited == 0)
        return tuple(int(at) - self.unseen for at in model.jnt_qposadr[turning])

    @property
    def height(self) -> int | None:
        """Which position is the root's height; None where it has none."""
        return {"planar": 1, "free": 2, "fixed": None}[self.root]

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The observation of states: everything but the place on the floor, velocities clipped.

        Args:
            qpos: Positions, (..., q), metres and radians.
            qvel: Velocities, (..., v), metres/s and radians/s.

        Returns:
            Observations, (..., o).
        """
        limit = self.velocity_limit
        return np.concatenate([qpos[..., self.unseen :], np.clip(qvel, -limit, limit)], axis=-1)

    def state(self, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The positions and velocities that an observation tells of, its place on the floor being 0.

        Args:
            obs: (..., o).

        Returns:
            (..., q) and (..., v), the latter as clipped as they were observed.
        """
        seen = self.positions - self.unseen
        place = np.zeros((*obs.shape[:-1], self.unseen), obs.dtype)
        return np.concatenate([place, obs[..., :seen]], axis=-1), obs[..., seen:]

    def healthy(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Whether states are healthy by the rule of gymnasium.

        Args:
            qpos: Positions, (..., q).
            qvel: Velocities, (..., v).

        Returns:
            True where healthy, (...).
        """
        rule = self.stock
        others = qpos[..., self.unseen + 1 :]
        inside = np.maximum(np.abs(others).max(-1), np.abs(qvel).max(-1)) < rule.healthy_state
        if rule.healthy_height is not None:
            low, high = rule.healthy_height
            inside = inside & (low < qpos[..., self.height]) & (qpos[..., self.height] < high)
        if rule.healthy_angle is not None:
            low, high = rule.healthy_angle
            inside = inside & (low < qpos[..., 2]) & (qpos[..., 2] < high)
        return inside


@lru_cache(maxsize=32)
def model_of(xml: Path) -> mujoco.MjModel:
    """The model of a file, compiled once; not to be changed."""
    return mujoco.MjModel.from_xml_path(str(xml))


def build(name: str, xml: Path, *, frame_skip: int, **known: object) -> Robot:
    """A robot of a model; what is not given is chosen by the model.

    Args:
        name: What it is called.
        xml: Its MJCF file.
        frame_skip: Physics steps in a control step.
        **known: Any other field of ``Robot``.
    """
    model = model_of(xml)
    ranged = model.actuator_ctrllimited.astype(bool)
    ends = np.where(ranged[:, None], model.actuator_ctrlrange, [-1.0, 1.0])
    root = root_of(model)
    limbs = tuple(body_name(model, b) for b in range(1, model.nbody) if solid_geoms(model, b).size)
    fields: dict[str, object] = {
        "root": root, "unseen": {"planar": 1, "free": 2, "fixed": 0}[root],
        "timestep": float(model.opt.timestep), "positions": model.nq, "velocities": model.nv,
        "low": tuple(ends[:, 0].tolist()), "high": tuple(ends[:, 1].tolist()),
        "limbs": limbs, "feet": (), "wild": Wild(heights=(0.05, 2.0)),
        "stock": StockReward(forward=0.0 if root == "fixed" else 1.0),
    }  # fmt: skip
    return Robot(name=name, xml=xml, frame_skip=frame_skip, **(fields | known))  # type: ignore[arg-type]


def root_of(model: mujoco.MjModel) -> Root:
    """How the first body that has joints moves."""
    kinds = [int(kind) for kind in model.jnt_type[:3]]
    first = model.jnt_bodyid[:3]
    if kinds and kinds[0] == mujoco.mjtJoint.mjJNT_FREE:
        return "free"
    slide, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    if kinds == [slide, slide, hinge] and len(set(first.tolist())) == 1:
        return "planar"
    return "fixed"


def body_name(model: mujoco.MjModel, body: int) -> str:
    """What a body is called; those without a name are called by their number."""
    return model.body(body).name or f"body {body}"


def solid_geoms(model: mujoco.MjModel, body: int) -> np.ndarray:
    """The geoms of a body that can be seen, numbers; a plane is a floor."""
    mine = np.flatnonzero(model.geom_bodyid == body)
    return mine[model.geom_type[mine] != mujoco.mjtGeom.mjGEOM_PLANE]
