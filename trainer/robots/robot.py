"""What a robot is: its model, how it is stepped and observed, what of it is seen, where it rests.

Shapes: q positions, v velocities, a actions, o observations.
"""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import gymnasium
import mujoco
import numpy as np

from onedemo.robots.camera import Camera, chosen_camera

log = logging.getLogger("onedemo")

GYMNASIUM_ASSETS = Path(str(gymnasium.__file__)).parent / "envs/mujoco/assets"

CONTACT_MARGIN = 0.002
"""Metres between a part and the ground at which MuJoCo's contact sets in: a part can lie on the
ground at rest without reaching it. Both geoms have a margin of 0.001 (hopper.xml); MuJoCo 4 adds
them up."""

Root = Literal["planar", "free", "fixed"]


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
    hidden: tuple[int, ...]
    """Positions that observations leave out, ascending: where the camera follows the robot."""
    across: int | None
    """Which position is the root's to the right, and which velocity that of it; None where it has none."""
    height: int | None
    """The same of its height; None where it has none or the camera follows it up, too."""
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
    rest: tuple[float, ...]
    """Positions from which episodes start, (q,)."""
    camera: Camera
    start: Start = Start()
    wild: Wild
    stock: StockReward = StockReward()
    model_sha256: str = ""
    """Of the model and the files that it needs, hex; "" for a model of one file."""

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
    def unseen(self) -> int:
        """How many positions observations leave out; all built-in robots have them at the front."""
        return len(self.hidden)

    @property
    def obs_size(self) -> int:
        """Observations: the positions that are not hidden, and the clipped velocities."""
        return self.positions - self.unseen + self.velocities

    @property
    def seen(self) -> slice | list[int]:
        """Which positions are observed."""
        if self.hidden == tuple(range(self.unseen)):
            return slice(self.unseen, None)  # takes a view, where a list would take a copy
        return [at for at in range(self.positions) if at not in self.hidden]

    @property
    def angles(self) -> tuple[int, ...]:
        """Observations that are angles without end: joints that may turn all the way round, (..., o)."""
        model, hinge = model_of(self.xml), mujoco.mjtJoint.mjJNT_HINGE
        turning = model.jnt_qposadr[(model.jnt_type == hinge) & (model.jnt_limited == 0)]
        seen = np.arange(self.positions)[self.seen].tolist()
        return tuple(seen.index(at) for at in turning.tolist())

    @property
    def sha256(self) -> str:
        """Of the model and of what is observed and commanded of it: a run goes on only with the same."""
        return _fingerprint(self)

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The observation of states: everything but the place on the floor, velocities clipped.

        Args:
            qpos: Positions, (..., q), metres and radians.
            qvel: Velocities, (..., v), metres/s and radians/s.

        Returns:
            Observations, (..., o).
        """
        limit = self.velocity_limit
        return np.concatenate([qpos[..., self.seen], np.clip(qvel, -limit, limit)], axis=-1)

    def state(self, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The positions and velocities that an observation tells of, its place on the floor being 0.

        Args:
            obs: (..., o).

        Returns:
            (..., q) and (..., v), the latter as clipped as they were observed.
        """
        seen = self.positions - self.unseen
        qpos = np.zeros((*obs.shape[:-1], self.positions), obs.dtype)
        qpos[..., self.seen] = obs[..., :seen]
        return qpos, obs[..., seen:]

    def healthy(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Whether states are healthy by the rule of gymnasium.

        Args:
            qpos: Positions, (..., q).
            qvel: Velocities, (..., v).

        Returns:
            True where healthy, (...).
        """
        rule = self.stock
        if np.isfinite(rule.healthy_state):
            others = qpos[..., self.unseen + 1 :]
            inside = np.maximum(np.abs(others).max(-1), np.abs(qvel).max(-1)) < rule.healthy_state
        else:
            inside = np.ones(qpos.shape[:-1], bool)
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
    return compiled(xml)


def compiled(xml: Path) -> mujoco.MjModel:
    """A model of one's own of a file.

    What MuJoCo warns of goes into our log from then on: by itself it writes MUJOCO_LOG.TXT into whatever
    directory the program was started in.

    Raises:
        ValueError: If MuJoCo cannot compile it; the text is MuJoCo's own, with the line.
    """
    mujoco.set_mju_user_warning(_note)
    return mujoco.MjModel.from_xml_path(str(xml))


def _note(said: str) -> None:
    log.debug("MuJoCo: %s", said)


def build(name: str, xml: Path, *, frame_skip: int, root: Root | None = None, **known: object) -> Robot:
    """A robot of a model; what is not given is chosen by the model.

    Args:
        name: What it is called.
        xml: Its MJCF file.
        frame_skip: Physics steps in a control step.
        root: How its first body moves.
        **known: Any other field of ``Robot``.
    """
    model = model_of(xml)
    root = root or root_of(model)
    if "camera" not in known:
        known["camera"] = chosen_camera(model, root)
    camera = known["camera"]
    assert isinstance(camera, Camera)
    place = plane_of(model) if root == "planar" else (0, 1, 2) if root == "free" else ()
    across, height = (place.index(a) if a in place else None for a in (camera.right, camera.up))
    hidden = {
        "fixed": (), "free": (0, 1), "planar": (0, 1) if 2 not in place else (place.index(camera.right),)
    }[root]  # fmt: skip
    low, high = command_ranges(model)
    fields: dict[str, object] = {
        "hidden": hidden, "across": across, "height": None if height in hidden else height,
        "timestep": float(model.opt.timestep), "positions": model.nq, "velocities": model.nv,
        "low": tuple(low.tolist()), "high": tuple(high.tolist()), "rest": tuple(model.qpos0.tolist()),
        "limbs": tuple(body_name(model, body) for body in moving_bodies(model)), "feet": (),
        "wild": Wild(heights=(0.05, 2.0)), "stock": StockReward(forward=0.0 if root == "fixed" else 1.0),
    }  # fmt: skip
    return Robot(name=name, xml=xml, root=root, frame_skip=frame_skip, **(fields | known))  # type: ignore[arg-type]


def root_of(model: mujoco.MjModel) -> Root:
    """How the first body that has joints moves."""
    kinds = [int(kind) for kind in model.jnt_type[:3]]
    if kinds and kinds[0] == mujoco.mjtJoint.mjJNT_FREE:
        return "free"
    slide, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    if kinds != [slide, slide, hinge] or len(set(model.jnt_bodyid[:3].tolist())) != 1:
        return "fixed"
    along, across, about = model.jnt_axis[:3]
    square = np.abs([*along, *across]).max() == 1 and along.max() == across.max() == 1
    return "planar" if square and np.abs(np.cross(along, across) @ about) > 1 - 1e-9 else "fixed"


def plane_of(model: mujoco.MjModel) -> tuple[int, int]:
    """World axes along which a planar root moves by its first two positions."""
    first, second = (int(axis.argmax()) for axis in model.jnt_axis[:2])
    return first, second


def command_ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """What actions of -1 and 1 command of each actuator, (a,) and (a,).

    The actuator's own range; where it has none, that of the joint which it brings to a position, or what
    its greatest force needs; else -1 and 1.
    """
    low, high = np.full(model.nu, -1.0), np.full(model.nu, 1.0)
    for motor in range(model.nu):
        joint = int(model.actuator_trnid[motor, 0])
        on_joint = model.actuator_trntype[motor] == mujoco.mjtTrn.mjTRN_JOINT and model.jnt_limited[joint]
        gain, affine = model.actuator_gainprm[motor, 0], model.actuator_biasprm[motor, 1]
        if model.actuator_ctrllimited[motor]:
            low[motor], high[motor] = model.actuator_ctrlrange[motor]
        elif gain > 0 and affine == -gain and on_joint:  # a position actuator
            low[motor], high[motor] = model.jnt_range[joint]
        elif gain > 0 and not model.actuator_biasprm[motor].any() and model.actuator_forcelimited[motor]:
            low[motor], high[motor] = model.actuator_forcerange[motor] / gain
    return low, high


def moving_bodies(model: mujoco.MjModel) -> list[int]:
    """Bodies that can be seen and can move, in the order of the model."""
    return [b for b in range(1, model.nbody) if model.body_weldid[b] and solid_geoms(model, b).size]


def floor_of(model: mujoco.MjModel) -> float | None:
    """Height of the highest level floor, a plane that does not move, metres; None if there is none."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    level = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (data.geom_xmat[:, 8] > 1 - 1e-6)
    heights = data.geom_xpos[level & (model.body_weldid[model.geom_bodyid] == 0), 2]
    return float(heights.max()) if heights.size else None


def body_name(model: mujoco.MjModel, body: int) -> str:
    """What a body is called; those without a name are called by their number."""
    return model.body(body).name or f"body {body}"


def solid_geoms(model: mujoco.MjModel, body: int) -> np.ndarray:
    """The geoms of a body that can be seen, numbers; a plane is a floor."""
    mine = np.flatnonzero(model.geom_bodyid == body)
    return mine[model.geom_type[mine] != mujoco.mjtGeom.mjGEOM_PLANE]


@lru_cache(maxsize=64)
def _fingerprint(robot: Robot) -> str:
    files = robot.model_sha256 or hashlib.sha256(robot.xml.read_bytes()).hexdigest()
    chosen = [
        files, robot.frame_skip, robot.hidden, robot.limbs, robot.low, robot.high, repr(robot.velocity_limit)
    ]  # fmt: skip
    return hashlib.sha256(json.dumps(chosen).encode()).hexdigest()
