"""Where a robot's parts are and how they move, from positions and velocities alone: any model, any lanes.

Pure functions on arrays; no simulator runs here. ``body_of`` reads the tables of a model once.

A planar robot's parts turn about one axis, so their directions are sums of its positions: one product of
matrices. For any other, forward kinematics goes from body to body, all lanes at once.

Keypoints, the ends of the limbs beside the root, are sums of directions times lengths as long as limbs are
rigid and hang at each other's ends: then a difference in keypoints is one in directions, and nothing is
gained by comparing both. Ends for which that does not hold (a slide, a hip beside the spine) are found by
trying, and are compared themselves.

Shapes: "..." any batch shape, o observations, q positions, v velocities, B bodies of the model (the world is
the first), L limbs (bodies that are seen), A axes that are compared, K ends that are, P = 1 + 2 A + 2 K
numbers of a pose: the root's height, how far each axis points right and up in pictures, and how far right
and up of the root each end is. Of a planar robot there is one axis a limb, and its two numbers are sine and
cosine of the angle, clockwise, by which it is turned; of any other the root has three and each limb one.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np

from onedemo.robots.robot import CONTACT_MARGIN, Robot, body_name, model_of, solid_geoms

HEIGHT_SCALE = 1.5
"""A metre of height counts as this many units of the pose, beside sines that reach from -1 to 1."""
MOTION_SCALE = 0.15
"""Seconds: motion is the change of the pose within this time, of the size of the pose itself."""
_MOTION_LIMIT = 12.0  # pose units per second
TRAVEL_SCALE = 0.4
"""A metre a second of travel counts as this many units of the pose."""
CONTACT_REACH = 0.03
"""Metres above the ground from which on a part is taken to touch it, little by little."""
_ROOT, _BETWEEN, _TIP = 1.0, 0.7, 0.5
"""How much the direction of a limb counts to the eye: the root is large and slow, the tips are small."""
_TRIED = 4
"""States a number of the pose by which it is tried what follows from what."""
_ROUNDING = 1e-6  # metres


class Seen(NamedTuple):
    """What a person sees of states in the camera's plane."""

    pose: np.ndarray
    """(..., P), as ``Body.pose``."""
    motion: np.ndarray
    """(..., P), as ``Body.motion``."""
    travel: np.ndarray
    """(...), as ``Body.travel``."""
    contact: np.ndarray
    """(...), as ``Body.contact``."""


class Rates(NamedTuple):
    """How the root moves."""

    spin: np.ndarray
    """Of a planar root clockwise, as seen; of a free one also about the axes that point right and up: rad/s,
    (..., 1), (..., 3), or (..., 0) of a fixed one."""
    climb: np.ndarray
    """Upward, m/s, (...)."""
    travel: np.ndarray
    """To the right, m/s, (...)."""


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
        self._sight = np.stack([turn, np.eye(3)[self._right], np.eye(3)[self._up]], axis=-1)
        self._rest_frame = data.xmat[self._limbs[0]].reshape(3, 3).T
        self._axes = [] if self.planar else self._compared_axes(data)
        self.weights = self._prominence()
        """How much each axis counts to the eye, (A,): a root 1, its tips a half, 0 what is rigid with it."""
        self.upright = 0 if self.planar else 1
        """Which axis points up from the root at rest."""
        self.rest_height = float(data.xpos[self._limbs[0], self._up])
        """Of the root, metres."""
        self._free_ends: list[tuple[int, np.ndarray]] = []
        self._touching = np.zeros((0, 0))
        tried = self._tried()
        if self.planar:
            self._touching = self._how_low(tried)
        else:
            self._free_ends = self._uncovered_ends(tried)
        self.pose_size = 1 + 2 * (len(self.weights) + len(self._free_ends))
        """P."""

    # What is compared

    def seen(self, obs: np.ndarray) -> Seen:
        """All that is compared, at the price of one pass over the bodies: (..., o)."""
        qpos, qvel = self.robot.state(obs)
        if self.planar:
            pose = self.pose(obs)
            return Seen(pose, self.motion(obs), self.travel(obs), self.contact_of(pose))
        placed = self._place(qpos)
        lowest = self._touch(np.minimum.reduce(list(self._clearances(placed).values())))
        return Seen(self._pose_at(placed), self._motion_at(placed, qvel), self._travel(qvel), lowest)

    def pose(self, obs: np.ndarray) -> np.ndarray:
        """Height, and directions of the parts: (..., o) to (..., P)."""
        qpos, _ = self.robot.state(obs)
        if self.planar:
            return self.pose_of(self._height(qpos), self.directions(obs))
        return self._pose_at(self._place(qpos))

    def motion(self, obs: np.ndarray) -> np.ndarray:
        """Change of the pose per ``MOTION_SCALE`` seconds, limited: (..., o) to (..., P)."""
        qpos, qvel = self.robot.state(obs)
        if self.planar:
            return self.motion_of(self._climb(qvel), self.directions(obs), qvel @ self._turns.T)
        return self._motion_at(self._place(qpos), qvel)

    def travel(self, obs: np.ndarray) -> np.ndarray:
        """How fast the root moves to the right in pictures, m/s: (..., o) to (...)."""
        _, qvel = self.robot.state(obs)
        return self._travel(qvel)

    def contact(self, obs: np.ndarray) -> np.ndarray:
        """How far the lowest part touches the ground, 0..1, from ``CONTACT_REACH`` on: (..., o) to (...)."""
        if self.planar:
            return self.contact_of(self.pose(obs))
        qpos, _ = self.robot.state(obs)
        return self._touch(np.minimum.reduce(list(self.clearances(qpos).values())))

    def contact_of(self, pose: np.ndarray) -> np.ndarray:
        """The contact of a planar robot's pose, (..., P) to (...): where its parts are follows from that."""
        one = np.concatenate([np.ones_like(pose[..., :1]), pose[..., 1:]], axis=-1)
        return self._touch(pose[..., 0] / HEIGHT_SCALE + (one @ self._touching).min(axis=-1))

    def axes(self, qpos: np.ndarray) -> np.ndarray:
        """How far each compared axis points right and up: (..., q) to (..., A, 2)."""
        if self.planar:
            angles = (qpos - self._rest) @ self._turns.T
            return np.stack([np.sin(angles), np.cos(angles)], axis=-1)
        return self._axes_at(self._place(qpos))

    def height(self, qpos: np.ndarray) -> np.ndarray:
        """Height of the root, metres: (..., q) to (...)."""
        if self.planar:
            return self._height(qpos)
        return self._place(qpos).positions[self._limbs[0]][..., self._up]

    def root_rates(self, qpos: np.ndarray, qvel: np.ndarray) -> Rates:
        """How the root moves: (..., q) and (..., v)."""
        travel = self._travel(qvel)
        if self.robot.root == "fixed":
            return Rates(np.zeros((*travel.shape, 0)), np.zeros(travel.shape), travel)
        if self.robot.root == "planar":
            return Rates(qvel @ self._turns[:1].T, self._climb(qvel), travel)
        turned = _matrix(qpos[..., 3:7]) @ qvel[..., 3:6, None]
        return Rates(turned[..., 0] @ self._sight, qvel[..., self._up], travel)

    def own_spin(self, qvel: np.ndarray) -> np.ndarray:
        """Spin of the root about its own axes that at rest point away, right and up, rad/s: (..., v)."""
        if self.robot.root == "free":
            return qvel[..., 3:6] @ (self._rest_frame @ self._sight)
        return qvel @ self._turns[: int(self.robot.root == "planar")].T

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
        return self._clearances(self._place(qpos))

    def _clearances(self, placed: _Placed) -> dict[str, np.ndarray]:
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

    def _pose_at(self, placed: _Placed) -> np.ndarray:
        height = HEIGHT_SCALE * placed.positions[self._limbs[0]][..., self._up]
        return self._joined(height, np.concatenate([self._axes_at(placed), self._ends_at(placed)], axis=-2))

    def _motion_at(self, placed: _Placed, qvel: np.ndarray) -> np.ndarray:
        spins, speeds = self._move(qvel, placed)
        plane, root = (..., (self._right, self._up)), self._limbs[0]
        rates = [np.cross(spins[body], placed.rotations[body] @ axis)[plane] for body, axis in self._axes]
        for body, end in self._free_ends:
            moved = speeds[body] + np.cross(spins[body], placed.rotations[body] @ end)
            rates.append(HEIGHT_SCALE * (moved - speeds[root])[plane])
        return _limited(self._joined(HEIGHT_SCALE * speeds[root][..., self._up], np.stack(rates, axis=-2)))

    def _axes_at(self, placed: _Placed) -> np.ndarray:
        axes = [placed.rotations[body] @ axis for body, axis in self._axes]
        return np.stack([axis[..., (self._right, self._up)] for axis in axes], axis=-2)

    def _ends_at(self, placed: _Placed) -> np.ndarray:
        """Ends that do not follow from the axes, as far right and up of the root as they are, (..., K, 2)."""
        root = placed.positions[self._limbs[0]]
        ends = [self._at(placed, body, end) - root for body, end in self._free_ends]
        if not ends:
            return np.zeros((*root.shape[:-1], 0, 2))
        return HEIGHT_SCALE * np.stack([end[..., (self._right, self._up)] for end in ends], axis=-2)

    def _travel(self, qvel: np.ndarray) -> np.ndarray:
        if self.robot.across is None:
            return np.zeros(qvel.shape[:-1])
        return qvel[..., self.robot.across]

    def _climb(self, qvel: np.ndarray) -> np.ndarray:
        """Of a planar robot, m/s; 0 where the camera follows it up, too."""
        if self.robot.height is None:
            return np.zeros(qvel.shape[:-1])
        return qvel[..., self.robot.height]

    def _touch(self, lowest: np.ndarray) -> np.ndarray:
        if self._up != 2:  # seen from above, there is no ground in the picture
            return np.zeros(lowest.shape)
        return np.clip(1 - lowest / CONTACT_REACH, 0, 1)

    def _prominence(self) -> np.ndarray:
        """``weights``, by how limbs hang at each other; one that is rigid with it adds nothing."""
        moves = []
        for limb in self._limbs:
            chain = self._chain(limb)
            before = next((at for at, body in enumerate(chain) if at and body in self._limbs), len(chain))
            moves.append(any(self._joints[body] for body in chain[:before]))
        first = self._limbs[moves.index(True)] if any(moves) else -1
        inner = {body for limb in self._limbs for body in self._chain(limb)[1:]}
        of = {
            limb: 0.0 if not moving else _ROOT if limb == first else _BETWEEN if limb in inner else _TIP
            for limb, moving in zip(self._limbs, moves, strict=True)
        }
        return np.array([of[limb] for limb in (self._limbs if self.planar else [b for b, _ in self._axes])])

    def _chain(self, body: int) -> list[int]:
        """A body and all that it hangs at, the world left out."""
        chain = []
        while body:
            chain.append(body)
            body = self._parents[body]
        return chain

    def _tried(self) -> np.ndarray:
        """Positions of all kinds, (n, q), the root in its place: to try what follows from what."""
        count = _TRIED * (1 + 2 * (len(self._limbs) + len(self._axes)))
        qpos = self._rest + np.random.default_rng(0).uniform(-1.5, 1.5, (count, self._model.nq))
        place = {"planar": 2, "free": 3, "fixed": 0}[self.robot.root]
        qpos[:, :place] = self._rest[:place]
        return qpos

    def _known_from(self, seen: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is a sum of what is seen, (n, A, 2): factors (1 + 2 A, k) and the worst error, (k,)."""
        known = np.concatenate([np.ones((len(seen), 1)), seen.reshape(len(seen), -1)], axis=1)
        factors = np.linalg.lstsq(known, wanted, rcond=None)[0]
        return factors, np.abs(known @ factors - wanted).max(axis=0)

    def _how_low(self, tried: np.ndarray) -> np.ndarray:
        """How high above the root each of G balls of a planar robot ends, from (1, waves): (1 + 2 L, G).

        A capsule is two balls. Others are their corners, balls without a size.
        """
        placed = self._place(tried)
        low = []
        for limb in self._limbs:
            for geom in solid_geoms(self._model, limb):
                points, radius = self._balls(geom)
                low += [self._at(placed, limb, point)[..., self._up] - radius for point in points]
        root = placed.positions[self._limbs[0]][..., self._up]
        return self._known_from(self.axes(tried), np.stack(low, axis=-1) - root[:, None])[0]

    def _balls(self, geom: int) -> tuple[np.ndarray, float]:
        """A geom as balls: their middles in the frame of its body, (n, 3), and their radius, metres."""
        model, kinds = self._model, mujoco.mjtGeom
        own = np.zeros(9)
        mujoco.mju_quat2Mat(own, model.geom_quat[geom])
        size, radius = model.geom_size[geom], 0.0
        if model.geom_type[geom] == kinds.mjGEOM_SPHERE:
            places, radius = np.zeros((1, 3)), float(size[0])
        elif model.geom_type[geom] == kinds.mjGEOM_CAPSULE:
            places, radius = np.array([[0, 0, -size[1]], [0, 0, size[1]]]), float(size[0])
        else:
            middle, half = np.split(model.geom_aabb[geom], 2)
            places = middle + half * np.array(list(itertools.product((-1, 1), repeat=3)))
        return model.geom_pos[geom] + places @ own.reshape(3, 3).T, radius

    def _uncovered_ends(self, tried: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Ends of limbs whose place beside the root is no sum of directions."""
        placed = self._place(tried)
        root = placed.positions[self._limbs[0]]
        ends = [(limb, end) for limb in self._limbs for end in self._ends(limb)]
        places = [(self._at(placed, *end) - root)[..., (self._right, self._up)] for end in ends]
        _, errors = self._known_from(self._axes_at(placed), np.concatenate(places, axis=-1))
        apart = errors.reshape(-1, 2).max(axis=1) > _ROUNDING
        return [end for end, uncovered in zip(ends, apart, strict=True) if uncovered]

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
        """Of the root those that point right, up and away at rest; of any other limb that along it."""
        axes = []
        for place, body in enumerate(self._limbs):
            to_body = data.xmat[body].reshape(3, 3).T
            if place == 0:
                axes += [(body, to_body @ axis) for axis in (np.eye(3)[[self._right, self._up]])]
                axes.append((body, to_body @ self._sight[:, 0]))
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


def without_turns(robot: Robot, obs: np.ndarray) -> np.ndarray:
    """Observations with sine and cosine in place of each angle that has no end: (..., o) to (..., o + k).

    A robot after one turn looks as before it.
    """
    columns = []
    for at in range(robot.obs_size):
        one = obs[..., at : at + 1]
        columns += [np.sin(one), np.cos(one)] if at in robot.angles else [one]
    return np.concatenate(columns, axis=-1)


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
