"""Where a robot's parts are and how they move, from positions and velocities alone: any model, any lanes.

Pure functions on arrays; no simulator runs here. ``body_of`` reads the tables of a model once.

A planar robot's parts turn about one axis, so their directions are sums of its positions: one product of
matrices. For any other, forward kinematics goes from body to body, all lanes at once.

Shapes: "..." any batch shape, o observations, q positions, v velocities, B bodies of the model (the world is
the first), L limbs (bodies that are seen), A axes that are compared, P = 1 + 2 A numbers of a pose: the
root's height, and how far each axis points right and up in pictures. Of a planar robot there is one axis a
limb, and its two numbers are sine and cosine of the angle, clockwise, by which it is turned.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from onedemo.robots.robot import CONTACT_MARGIN, Robot, body_name, model_of, solid_geoms

HEIGHT_SCALE = 1.5
"""A metre of height counts as this many units of the pose, beside sines that reach from -1 to 1."""
MOTION_SCALE = 0.15
"""Seconds: motion is the change of the pose within this time, of the size of the pose itself."""
_MOTION_LIMIT = 12.0  # pose units per second


class Body:
    """The kinematics of one robot. Immutable; made by ``body_of``."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        model = self._model = model_of(robot.xml)
        names = [body_name(model, b) for b in range(model.nbody)]
        self._limbs = [names.index(name) for name in robot.limbs]
        self._parents = model.body_parentid.tolist()
        self._joints = [np.flatnonzero(model.jnt_bodyid == b).tolist() for b in range(model.nbody)]
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._rest = model.qpos0.copy()
        camera = robot.camera
        self._right, self._up = camera.right, camera.up
        turn = -np.cross(np.eye(3)[self._right], np.eye(3)[self._up])  # clockwise, as seen
        self.planar = robot.root == "planar" and bool(
            (
                np.abs(np.abs(data.xaxis[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE] @ turn) - 1) < 1e-9
            ).all()
            and (model.jnt_type[2:] == mujoco.mjtJoint.mjJNT_HINGE).all()
        )
        """Whether all its parts turn about the one axis along which it is seen."""
        self._turns = np.zeros((len(self._limbs), model.nv))  # of each limb, by each velocity
        if self.planar:
            for row, body in zip(self._turns, self._limbs, strict=True):
                while body:
                    for joint in self._joints[body]:
                        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                            row[model.jnt_dofadr[joint]] = round(float(data.xaxis[joint] @ turn))
                    body = self._parents[body]
        self._axes = [] if self.planar else self._compared_axes(data)
        self.pose_size = 1 + 2 * (len(self._limbs) if self.planar else len(self._axes))
        """P."""

    # What is compared

    def pose(self, obs: np.ndarray) -> np.ndarray:
        """Height, and directions of the parts: (..., o) to (..., P)."""
        qpos, _ = self.robot.state(obs)
        if self.planar:
            return self.pose_of(self._height(qpos), self.directions(obs))
        placed = self._place(qpos)
        axes = [placed.rotations[body] @ axis for body, axis in self._axes]
        seen = np.stack([axis[..., (self._right, self._up)] for axis in axes], axis=-2)
        return self._joined(HEIGHT_SCALE * placed.positions[self._limbs[0]][..., self._up], seen)

    def motion(self, obs: np.ndarray) -> np.ndarray:
        """Change of the pose per ``MOTION_SCALE`` seconds, limited: (..., o) to (..., P)."""
        qpos, qvel = self.robot.state(obs)
        if self.planar:
            climb = np.zeros(obs.shape[:-1]) if self.robot.height is None else qvel[..., self.robot.height]
            return self.motion_of(climb, self.directions(obs), qvel @ self._turns.T)
        placed = self._place(qpos)
        spins, speeds = self._move(qvel, placed)
        rates = [np.cross(spins[body], placed.rotations[body] @ axis) for body, axis in self._axes]
        seen = np.stack([rate[..., (self._right, self._up)] for rate in rates], axis=-2)
        return _limited(self._joined(HEIGHT_SCALE * speeds[self._limbs[0]][..., self._up], seen))

    def travel(self, obs: np.ndarray) -> np.ndarray:
        """How fast the root moves to the right in pictures, m/s: (..., o) to (...)."""
        _, qvel = self.robot.state(obs)
        if self.robot.across is None:
            return np.zeros(obs.shape[:-1])
        return qvel[..., self.robot.across]

    def pose_of(self, height: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """A planar robot's pose of a height (...), metres, and directions (..., L), radians: (..., P)."""
        waves = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
        return self._joined(HEIGHT_SCALE * height, waves)

    def motion_of(self, climb: np.ndarray, angles: np.ndarray, spins: np.ndarray) -> np.ndarray:
        """A planar robot's motion: climb (...), m/s; limbs at ``angles`` turn at ``spins``, (..., L)."""
        waves = np.stack([np.cos(angles) * spins, -np.sin(angles) * spins], axis=-1)
        return _limited(self._joined(HEIGHT_SCALE * climb, waves))

    def directions(self, obs: np.ndarray) -> np.ndarray:
        """By how much each limb of a planar robot is turned clockwise, radians: (..., o) to (..., L)."""
        qpos, _ = self.robot.state(obs)
        return (qpos - self._rest) @ self._turns.T

    # Where things are

    def points(self, qpos: np.ndarray) -> dict[str, np.ndarray]:
        """The two ends of each limb in the camera's plane.

        Args:
            qpos: Positions, (..., q).

        Returns:
            Of each limb: right and up, metres, (..., 2, 2): its two ends.
        """
        placed = self._place(qpos)
        plane = (self._right, self._up)
        return {
            name: np.stack(
                [placed.positions[body] + placed.rotations[body] @ end for end in self._ends(body)], -2
            )[..., plane]
            for name, body in zip(self.robot.limbs, self._limbs, strict=True)
        }

    def clearances(self, qpos: np.ndarray) -> dict[str, np.ndarray]:
        """Distance of the ground, where height is 0, from each limb, negative inside it: metres, (...)."""
        placed = self._place(qpos)
        positions, rotations = placed.positions, placed.rotations
        return {
            name: np.minimum.reduce([
                positions[body][..., 2] + (rotations[body] @ self._model.geom_pos[geom])[..., 2]
                - self._reach(geom, rotations[body]) for geom in solid_geoms(self._model, body)
            ]) for name, body in zip(self.robot.limbs, self._limbs, strict=True)
        }  # fmt: skip

    def fallen(self, qpos: np.ndarray) -> np.ndarray:
        """Whether a limb other than the feet touches the ground: (..., q) to (...)."""
        gaps = self.clearances(qpos)
        return (
            np.minimum.reduce([gaps[n] for n in self.robot.limbs if n not in self.robot.feet])
            < CONTACT_MARGIN
        )

    # Inside

    def _height(self, qpos: np.ndarray) -> np.ndarray:
        at = self.robot.height
        if at is None:  # the camera follows it up, too
            return np.zeros(qpos.shape[:-1])
        return qpos[..., at] - self._rest[at] + self._model.body_pos[self._limbs[0]][self._up]

    def _at(self, placed: _Placed, body: int, point: np.ndarray) -> np.ndarray:
        """Where a point of a body is in the world, (..., 3)."""
        return placed.positions[body] + placed.rotations[body] @ point

    def _joined(self, height: np.ndarray, seen: np.ndarray) -> np.ndarray:
        return np.concatenate([height[..., None], seen.reshape(*seen.shape[:-2], -1)], axis=-1)

    def _compared_axes(self, data: mujoco.MjData) -> list[tuple[int, np.ndarray]]:
        """Of the root two axes, those that point up and right at rest; of any other limb that along it."""
        axes = []
        for place, body in enumerate(self._limbs):
            to_body = data.xmat[body].reshape(3, 3).T
            if place == 0:
                axes += [(body, to_body @ np.eye(3)[self._up]), (body, to_body @ np.eye(3)[self._right])]
            else:
                begin, end = self._ends(body)
                axes.append((body, (end - begin) / np.linalg.norm(end - begin)))
        return axes

    def _ends(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """The ends of a limb in its own frame, metres: those of its largest geom."""
        model = self._model
        geom = max(solid_geoms(model, body), key=lambda g: model.geom_rbound[g])
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        size = model.geom_size[geom]
        kind = model.geom_type[geom]
        if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            reach = np.array([0, 0, size[1]])
        else:  # the longest side
            box = model.geom_aabb[geom, 3:]
            reach = np.where(np.arange(3) == box.argmax(), box.max(), 0.0)
        along = rotation.reshape(3, 3) @ reach
        ends = model.geom_pos[geom] - along, model.geom_pos[geom] + along
        return ends if ends[0] @ ends[0] <= ends[1] @ ends[1] else ends[::-1]

    def _reach(self, geom: int, rotation: np.ndarray) -> np.ndarray:
        """How far a geom reaches down from its middle, metres, (...)."""
        model, kinds = self._model, mujoco.mjtGeom
        own = np.zeros(9)
        mujoco.mju_quat2Mat(own, model.geom_quat[geom])
        down = np.abs((rotation @ own.reshape(3, 3))[..., 2, :])  # of each of its axes
        size, kind = model.geom_size[geom], model.geom_type[geom]
        if kind == kinds.mjGEOM_SPHERE:
            return np.full(down.shape[:-1], size[0])
        if kind == kinds.mjGEOM_CAPSULE:
            return down[..., 2] * size[1] + size[0]
        if kind == kinds.mjGEOM_ELLIPSOID:
            return np.linalg.norm(down * size, axis=-1)
        if kind == kinds.mjGEOM_CYLINDER:
            return down[..., 2] * size[1] + np.sqrt(np.maximum(0, 1 - down[..., 2] ** 2)) * size[0]
        return down @ model.geom_aabb[geom, 3:]

    def _place(self, qpos: np.ndarray) -> _Placed:
        """Forward kinematics, as ``mj_kinematics``."""
        model, kinds = self._model, mujoco.mjtJoint
        batch = qpos.shape[:-1]
        placed = _Placed([np.zeros((*batch, 3))], [np.broadcast_to(np.eye(3), (*batch, 3, 3))], [], [])
        for body in range(1, model.nbody):
            parent = self._parents[body]
            own = np.zeros(9)
            mujoco.mju_quat2Mat(own, model.body_quat[body])
            rotation = placed.rotations[parent] @ own.reshape(3, 3)
            position = placed.positions[parent] + placed.rotations[parent] @ model.body_pos[body]
            for joint in self._joints[body]:
                kind, at = model.jnt_type[joint], model.jnt_qposadr[joint]
                if kind == kinds.mjJNT_FREE:
                    position, rotation = qpos[..., at : at + 3], _matrix(qpos[..., at + 3 : at + 7])
                axis, pivot = rotation @ model.jnt_axis[joint], model.jnt_pos[joint]
                anchor = position + rotation @ pivot
                placed.axes.append(axis)
                placed.anchors.append(anchor)
                if kind == kinds.mjJNT_SLIDE:
                    position = position + axis * (qpos[..., at, None] - self._rest[at])
                elif kind != kinds.mjJNT_FREE:
                    if kind == kinds.mjJNT_HINGE:
                        rotation = rotation @ _about(model.jnt_axis[joint], qpos[..., at] - self._rest[at])
                    else:
                        rotation = rotation @ _matrix(qpos[..., at : at + 4])
                    position = anchor - rotation @ pivot
            placed.positions.append(position)
            placed.rotations.append(rotation)
        return placed

    def _move(self, qvel: np.ndarray, placed: _Placed) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Spin, rad/s, and speed, m/s, of each body in the world, (..., 3)."""
        model, kinds = self._model, mujoco.mjtJoint
        spins, speeds = [np.zeros_like(placed.positions[0])], [np.zeros_like(placed.positions[0])]
        for body in range(1, model.nbody):
            parent, position = self._parents[body], placed.positions[body]
            spin = spins[parent]
            speed = speeds[parent] + np.cross(spin, position - placed.positions[parent])
            for joint in self._joints[body]:
                kind, at = model.jnt_type[joint], model.jnt_dofadr[joint]
                if kind == kinds.mjJNT_SLIDE:
                    speed = speed + placed.axes[joint] * qvel[..., at, None]
                    continue
                if kind == kinds.mjJNT_HINGE:
                    turn = placed.axes[joint] * qvel[..., at, None]
                else:  # in the body's own frame
                    speed = qvel[..., at : at + 3] if kind == kinds.mjJNT_FREE else speed
                    at += 3 if kind == kinds.mjJNT_FREE else 0
                    turn = (placed.rotations[body] @ qvel[..., at : at + 3, None])[..., 0]
                spin = spin + turn
                speed = speed + np.cross(turn, position - placed.anchors[joint])
            spins.append(spin)
            speeds.append(speed)
        return spins, speeds


@dataclass(frozen=True, slots=True)
class _Placed:
    """Where bodies and joints are in the world."""

    positions: list[np.ndarray]
    """Of each body, (..., 3)."""
    rotations: list[np.ndarray]
    """Of each body, (..., 3, 3)."""
    axes: list[np.ndarray]
    """Of each joint, (..., 3)."""
    anchors: list[np.ndarray]
    """Of each joint, (..., 3)."""


@lru_cache(maxsize=32)
def body_of(robot: Robot) -> Body:
    """The kinematics of a robot."""
    return Body(robot)


def _limited(rates: np.ndarray) -> np.ndarray:
    return MOTION_SCALE * np.clip(rates, -_MOTION_LIMIT, _MOTION_LIMIT)


def _about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations about an axis (3,) by angles (...): (..., 3, 3), by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, cosine = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotations of quaternions (..., 4), of any length: (..., 3, 3)."""
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(quaternion / np.maximum(length, 1e-12), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
