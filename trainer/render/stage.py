"""Where a robot is and from where it is seen, in the axes of its pictures; and what is behind it there.

Axes: right, away from the camera, up. Heights are above the floor, other places as in the world; metres.

Shapes: L geoms that are seen, q positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from onedemo.render.backdrop import Viewpoint, Window, backdrop, ground_from_above
from onedemo.render.outline import Silhouette
from onedemo.render.studio import chains
from onedemo.robots.camera import FOVY, Camera, Extents, visible_geoms
from onedemo.robots.robot import Robot

_FREE_ABOVE = 0.8943
"""So far, in halves of the picture's height, the robot may rise above the camera before it follows."""
_APART = 0.03
"""Limbs of a planar robot that lie in one another are drawn beside one another, so far of its size."""


@dataclass(frozen=True, slots=True)
class Shape:
    """How far each geom reaches."""

    low: np.ndarray
    """(..., L, 3)."""
    high: np.ndarray
    """(..., L, 3)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Eye:
    """Where the camera is."""

    x: float
    y: float
    """Of the plane that it is ``distance`` before."""
    z: float
    distance: float


class Stage:
    """Where one robot is seen.

    Args:
        robot: The robot.
        model: As ``onedemo.render.studio.studio_model`` dresses it.
    """

    def __init__(self, robot: Robot, model: mujoco.MjModel) -> None:
        self._model, self._camera = model, robot.camera
        camera, axes = robot.camera, np.eye(3)
        self._axes = np.stack([axes[camera.right], camera.forward, axes[camera.up]])
        self.turn = np.stack([axes[camera.right], axes[camera.up], -camera.forward], axis=1).ravel()
        """Of MuJoCo's camera, (9,)."""
        self._origin = camera.floor * axes[2] if camera.up == 2 else np.zeros(3)
        self._pick = np.abs(self._axes).argmax(axis=1)
        self._turned = self._axes[1].sum() < 0
        seen = visible_geoms(model)
        self._limbs = model.geom_bodyid[seen] > 0
        limbs = model.geom_bodyid[seen[self._limbs]]
        self._root = int(model.body_rootid[limbs[0]]) if limbs.size else 0
        self._extents = Extents(model, seen)
        self._silhouette = Silhouette(model, seen[self._limbs], self._axes[[0, 2]], camera.size)
        self._depth = float(self._axes[1].sum()) * camera.depth
        self._free = robot.root == "free"
        self._above = camera.up != 2
        self._free_above = free_above(camera)
        self._beside = beside(robot, model)

    def pose(self, data: mujoco.MjData, qpos: np.ndarray) -> Shape:
        """Moves the robot, and tells how far it reaches now.

        Args:
            data: Of its simulation, which is changed.
            qpos: Positions, (q,).
        """
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)
        if self._beside is not None:
            data.geom_xpos += self._beside
        return self._seen(*self._extents.of(data))

    def reach(self, data: mujoco.MjData, qpos: np.ndarray) -> Shape:
        """As ``pose``, but away from the camera from the plane that it is ``Camera.distance`` before."""
        if self._free:
            shape = self.pose(data, qpos)
            y = self.eye(data, shape).y
        else:  # which needs neither centres of mass nor lights
            data.qpos[:] = qpos
            mujoco.mj_kinematics(self._model, data)
            shape, y = self._seen(*self._extents.of(data)), self._depth
        shape.low[:, 1] -= y
        shape.high[:, 1] -= y
        return shape

    def eye(self, data: mujoco.MjData, shape: Shape) -> Eye:
        """From where the robot, just posed, is seen whole."""
        camera = self._camera
        x, y, z = camera.middle, self._depth, camera.height
        if camera.follows:
            middle = data.subtree_com[self._root]
            x = float(middle[camera.right])
            if self._above:
                z = float(middle[camera.up])
            else:
                y = float(self._axes[1] @ middle) if self._free else y
                z += max(0.0, float(shape.high[self._limbs, 2].max()) - z - self._free_above)
        return Eye(x=x, y=y, z=z, distance=camera.distance)

    def outline(self, data: mujoco.MjData) -> np.ndarray:
        """The border of the robot, just posed, (n, 2): to the right and above the floor."""
        return self._silhouette.of(data) - self._origin @ self._axes[[0, 2]].T

    def place(self, eye: Eye) -> np.ndarray:
        """Where the camera is in the world, (3,)."""
        return np.array([eye.x, eye.y - eye.distance, eye.z]) @ self._axes + self._origin

    def backdrop(
        self, width: int, height: int, eye: Eye, window: Window, shape: Shape, *, exact: bool
    ) -> np.ndarray:
        """What is behind the robot, (H, W, 3), uint8 RGB; arguments as of ``onedemo.render.backdrop``."""
        unit = self._camera.unit
        distance = eye.distance + (eye.y + self._camera.floor if self._above else 0.0)
        view = Viewpoint(
            x=eye.x / unit, z=eye.z / unit, distance=distance / unit, fovy=FOVY,
            y=eye.y / unit if self._free else None,
        )  # fmt: skip
        if self._above:
            return ground_from_above(width, height, view, window)
        low, high = shape.low, shape.high
        half, middle = (high[:, 1] - low[:, 1]) / 2, (high[:, 1] + low[:, 1]) / 2 - eye.y
        limbs_L5 = np.stack([low[:, 0], high[:, 0], low[:, 2], half, middle], axis=1) / unit
        return backdrop(width, height, view, limbs_L5, exact=exact, window=window)

    def _seen(self, low: np.ndarray, high: np.ndarray) -> Shape:
        """Extents in the axes of the pictures."""
        low, high = low[:, self._pick], high[:, self._pick]
        if self._turned:
            low[:, 1], high[:, 1] = -high[:, 1], -low[:, 1]
        if self._origin[2]:
            low[:, 2] -= self._origin[2]
            high[:, 2] -= self._origin[2]
        return Shape(low, high)


def free_above(camera: Camera) -> float:
    """How far a robot may rise above the camera before the camera follows, metres."""
    half = camera.distance * math.tan(math.radians(FOVY) / 2)
    return round(_FREE_ABOVE * half / camera.unit, 2) * camera.unit


def beside(robot: Robot, model: mujoco.MjModel) -> np.ndarray | None:
    """By how much each geom is moved toward the camera or away from it, (geoms, 3); None if none is."""
    if robot.root != "planar":
        return None
    places = chains(model, robot.root)
    count = 1 + max((chain for chain, _ in places.values()), default=-1)
    if count < 2:
        return None
    offsets = np.zeros((model.ngeom, 3))
    for body, (chain, _) in places.items():
        if chain >= 0:
            offsets[model.geom_bodyid == body] = (chain - (count - 1) / 2) * robot.camera.forward
    return _APART * robot.camera.distance * offsets
