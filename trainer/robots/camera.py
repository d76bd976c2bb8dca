"""From where a robot is seen, chosen by its model: how large it is, how it moves, how far it reaches.

World axes are numbered 0, 1, 2 for x, y, z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

FOVY = 39.0
"""Vertical field of view, degrees. The same for all, so that near and far look alike whatever the size."""
_TALL, _WIDE, _ASPECT = 0.5, 0.7, 4 / 3
"""Shares of the picture's height and width that a robot at rest takes at most, and the picture's shape."""
_MARGIN = 1.12
"""Of a robot that stays where it is, the picture shows all that it can reach, and so much more."""
_EYE_LEVEL = 0.83
"""Height of a camera that follows, in halves of the picture's height: some floor is seen below the robot."""
_NEARER = 0.8
"""Of half of its depth the camera goes back from a robot that has any."""
_TRIES = 200
"""Random positions from which is learned how far a robot reaches."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """From where the robot is seen, and what of its place the camera follows.

    It looks level, or straight down where ``up`` is no vertical axis.
    """

    right: int = 0
    """World axis that points to the right in pictures."""
    up: int = 2
    """World axis that points up in pictures."""
    distance: float = 3.0
    """Metres from the robot."""
    height: float = 0.88
    """Of the camera above the floor, metres; of one that looks down its place along ``up``."""
    follows: bool = True
    """Whether it follows the robot; else it stands."""
    middle: float = 0.0
    """Where along ``right`` a camera that stands looks, metres."""
    depth: float = 0.0
    """Where the robot is on the axis along which the camera looks, if it stands there, metres."""
    floor: float = 0.0
    """Height of the floor, metres."""

    @property
    def forward(self) -> np.ndarray:
        """The direction in which it looks, (3,)."""
        return np.cross(np.eye(3)[self.up], np.eye(3)[self.right])

    @property
    def size(self) -> float:
        """How large what it sees is, beside a robot of a man's height seen from three metres."""
        return self.distance / 3.0

    @property
    def unit(self) -> float:
        """Side of the floor's squares, metres: 1, 2 or 5, or these times a power of ten."""
        power = math.floor(math.log10(self.size))
        rest = self.size / 10.0**power
        for most, unit in ((1.7, 1), (3.5, 2), (6.0, 5)):
            if rest < most:
                return unit * 10.0**power
        return 10.0 ** (power + 1)


class Extents:
    """How far geoms reach in the world, from where a simulation has them.

    Args:
        model: Of the robot.
        geoms: Their numbers, (G,).
    """

    def __init__(self, model: mujoco.MjModel, geoms: np.ndarray) -> None:
        kinds = mujoco.mjtGeom
        self._geoms = geoms
        kind, self._size, box = model.geom_type[geoms], model.geom_size[geoms], model.geom_aabb[geoms]
        self._round = bool(np.isin(kind, (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_SPHERE)).all())
        self._capsules = np.flatnonzero(np.isin(kind, (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_SPHERE)))
        self._cylinders = np.flatnonzero(kind == kinds.mjGEOM_CYLINDER)
        self._ellipsoids = np.flatnonzero(kind == kinds.mjGEOM_ELLIPSOID)
        self._middle, self._half = box[:, :3], box[:, 3:]

    def of(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest x, y and z of each geom, (G, 3) each, metres."""
        place = data.geom_xpos[self._geoms]
        turn = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        if self._round:
            reach = self._rounded(turn, self._size)
            return place - reach, place + reach
        reach = (np.abs(turn) @ self._half[:, :, None])[:, :, 0]
        place = place + (turn @ self._middle[:, :, None])[:, :, 0]
        some = self._capsules
        reach[some] = self._rounded(turn[some], self._size[some])
        some = self._ellipsoids
        reach[some] = np.linalg.norm(turn[some] * self._size[some][:, None], axis=2)
        some, axis = self._cylinders, turn[self._cylinders][:, :, 2]
        across = np.sqrt(np.maximum(0.0, 1 - axis**2)) * self._size[some, :1]
        reach[some] = np.abs(axis) * self._size[some, 1:2] + across
        return place - reach, place + reach

    @staticmethod
    def _rounded(turn: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Of capsules, and of spheres, which have no length."""
        return np.abs(turn[:, :, 2] * size[:, 1:2]) + size[:, :1]


def visible_geoms(model: mujoco.MjModel) -> np.ndarray:
    """The geoms that MuJoCo's viewer shows, but floors, numbers: neither see-through nor of groups 3 to 5."""
    solid = (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE) & (
        model.geom_type != mujoco.mjtGeom.mjGEOM_HFIELD
    )
    seen = solid & (model.geom_group < 3) & (model.geom_rgba[:, 3] > 0)
    return np.flatnonzero(seen if (seen & (model.geom_bodyid > 0)).any() else solid)


def chosen_camera(model: mujoco.MjModel, root: str) -> Camera:
    """The camera that shows a robot well.

    A robot that moves about takes up to half of the picture's height at rest and is followed; of one that
    stays where it is the camera shows all that it can reach, and stands. One that moves in a horizontal
    plane is seen from above.

    Args:
        model: Of the robot.
        root: "planar", "free" or "fixed", as ``onedemo.robots.robot.root_of``.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms = visible_geoms(model)
    geoms = geoms[model.geom_bodyid[geoms] > 0]
    if not geoms.size:
        return Camera(follows=root != "fixed")
    extents = Extents(model, geoms)
    low, high = (edge(ends, axis=0) for edge, ends in zip((np.min, np.max), extents.of(data), strict=True))
    if root == "fixed":
        low_of_all, high_of_all = _reach(model, data, extents, low, high)
    else:
        low_of_all, high_of_all = low, high
    right, up = _plane(model, data, root, high_of_all - low_of_all)
    ground = _floor(model, data, high[2])
    floor = float(low[2]) if ground is None else ground
    if up == 2 and ground is not None:
        low_of_all[2] = max(low_of_all[2], floor)
    along = 3 - right - up
    wide, tall = high_of_all[right] - low_of_all[right], high_of_all[up] - low_of_all[up]
    depth = float(low[along] + high[along]) / 2
    if root == "fixed":
        half = _MARGIN * max(tall, wide / _ASPECT) / 2
        height = float(low_of_all[up] + high_of_all[up]) / 2 - (floor if up == 2 else 0.0)
    else:
        if up == 2:  # from the floor on
            tall = high[2] - min(low[2], floor)
        half = max(tall / _TALL, wide / _WIDE / _ASPECT) / 2
        height = _EYE_LEVEL * half if up == 2 else float(low[up] + high[up]) / 2
    half = max(float(half), 1e-3)
    distance = half / math.tan(math.radians(FOVY / 2))
    if root == "free":  # what reaches toward the camera looks larger
        distance += _NEARER * float(high[along] - low[along]) / 2
    if up == 2:
        height = max(height, 0.1 * half)  # not below the floor
    return Camera(
        right=right, up=up, distance=_three_digits(distance),
        height=_three_digits(height), follows=root != "fixed",
        middle=_three_digits(float(low_of_all[right] + high_of_all[right]) / 2) if root == "fixed" else 0.0,
        depth=0.0 if root == "planar" else round(depth, 6), floor=round(floor, 6),
    )  # fmt: skip


def _plane(model: mujoco.MjModel, data: mujoco.MjData, root: str, reach: np.ndarray) -> tuple[int, int]:
    """The axes that point right and up in pictures."""
    kinds = mujoco.mjtJoint
    turning = model.jnt_type == kinds.mjJNT_HINGE
    if root == "planar":
        flat = abs(data.xaxis[:3][turning[:3]][0, 2]) > 0.9
        return (0, 1) if flat else (int(np.argmin(np.abs(data.xaxis[:3][turning[:3]][0, :2]))), 2)
    if root == "free":
        return 0, 2
    sliding = model.jnt_type == kinds.mjJNT_SLIDE
    upright = np.abs(data.xaxis[:, 2])
    flat = bool(model.njnt) and bool(
        (turning | sliding).all() and (upright[turning] > 0.9).all() and (upright[sliding] < 0.1).all()
    )
    return (0, 1) if flat else (0 if reach[0] >= 0.9 * reach[1] else 1, 2)


def _floor(model: mujoco.MjModel, data: mujoco.MjData, top: float) -> float | None:
    """Height of the highest level plane of the world that the robot is not below; None if it has none."""
    planes = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid == 0))
    level = [g for g in planes if data.geom_xmat[g, 8] > 0.99 and data.geom_xpos[g, 2] < top]
    return max((float(data.geom_xpos[g, 2]) for g in level), default=None)


def _reach(
    model: mujoco.MjModel, data: mujoco.MjData, extents: Extents, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest x, y and z at which any part was in random positions, (3,) each."""
    rng = np.random.default_rng(0)
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    moved = np.flatnonzero((model.jnt_type == hinge) | (model.jnt_type == slide))
    low, high = low.copy(), high.copy()
    # What slides for ever, or is an object on a table, says nothing of the robot's size.
    most = np.where(model.jnt_type[moved] == hinge, math.pi, float((high - low).max()) / 2)
    rest = model.qpos0[model.jnt_qposadr[moved]]
    limited = model.jnt_limited[moved].astype(bool)
    least_most = np.where(limited[:, None], model.jnt_range[moved], [-np.inf, np.inf])
    ranges = np.clip(least_most, (rest - most)[:, None], (rest + most)[:, None])
    for _ in range(_TRIES):
        data.qpos[model.jnt_qposadr[moved]] = rng.uniform(ranges[:, 0], ranges[:, 1])
        mujoco.mj_kinematics(model, data)
        lowest, highest = extents.of(data)
        np.minimum(low, lowest.min(axis=0), out=low)
        np.maximum(high, highest.max(axis=0), out=high)
    return low, high


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")
