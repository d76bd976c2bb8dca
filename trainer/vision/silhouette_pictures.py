"""Masks of a robot in random states, to learn from: drawn from its model alone, with the faults of real ones.

Physics runs on for a while from random states; MuJoCo draws which pixel shows which geom, for cameras about
the one that looks at the robot's plane. Masks that are found in videos have other edges than drawn ones,
holes, and now and then lack a limb: so do these.

Shapes: n short films of T frames, H = W = ``_SIZE``, A numbers to be read (``aims``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np

from onedemo.render.gl_context import open_context
from onedemo.rl.random_states import wild_rollouts
from onedemo.robots.registry import robot_named
from onedemo.robots.robot import Robot, body_name, model_of
from onedemo.sim.kinematics import body_of
from onedemo.vision.silhouette_views import RATE, Views, views

FRAMES = 14
"""Of each film."""
_SIZE = 112
_VIEW = 1.35
"""Height of what is drawn, in lengths of the robot."""
_SECONDS = 0.96
"""How long random states run on before the next."""
_STANDING = 0.25
_FILMS_EACH = 2
"""Of each random state and what comes of it."""
_NEAR = 0.03
"""Metres above the ground at which contact is over."""
_MOST_ORDERS = 4
TRAVEL_SCALE = 0.4
"""A metre a second of travel counts as this many units of the pose."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Films:
    """What is learned from."""

    crops: np.ndarray
    """(n, T, S, S), uint8."""
    places: np.ndarray
    """(n, T, K), float32."""
    aims: np.ndarray
    """What they show, (n, T, A), float32."""
    reach: float
    """Length of the robot stretched out, metres."""
    swaps: np.ndarray
    """As ``swaps_of``, (k, A)."""


def aims(robot: Robot, qpos: np.ndarray, obs: np.ndarray) -> np.ndarray:
    """What is to be read of states, (..., q) and (..., o): pose, motion, travel and contact, (..., A)."""
    body = body_of(robot)
    travel = TRAVEL_SCALE * body.travel(obs)
    contact = np.zeros(obs.shape[:-1])
    if has_floor(robot):
        lowest = np.minimum.reduce(list(body.clearances(qpos).values()))
        contact = np.clip(1 - lowest / _NEAR, 0, 1)
    numbers = [body.pose(obs), body.motion(obs), travel[..., None], contact[..., None]]
    return np.concatenate(numbers, axis=-1).astype(np.float32)


def names_of(robot: Robot) -> list[str]:
    """Names of the numbers that ``aims`` gives, (A,)."""
    limbs = [f"{robot.limbs[0]}'s side"] * (not body_of(robot).planar) + list(robot.limbs[1:])
    pose = ["height", *(f"{way} of {limb}" for limb in [robot.limbs[0], *limbs] for way in ("right", "up"))]
    return [*pose, *(f"rate of {number}" for number in pose), "travel", "contact"]


def swaps_of(robot: Robot) -> np.ndarray:
    """Orders of the numbers of ``aims`` that no silhouette tells apart, (k, A); the first is as they are.

    A robot with two legs that are alike, one behind the other, looks the same if they change places.
    """
    model, body = model_of(robot.xml), body_of(robot)
    orders = [list(range(model.nbody))]
    for one in range(1, model.nbody):
        for other in range(one + 1, model.nbody):
            if len(orders) < _MOST_ORDERS and _alike(model, robot, one, other):
                pairs = list(zip(_branch(model, one), _branch(model, other), strict=True))
                changed = {a: b for a, b in pairs} | {b: a for a, b in pairs}
                orders += [[changed.get(each, each) for each in order] for order in orders]
    names = [body_name(model, each) for each in range(model.nbody)]
    bodies = [names.index(name) for name in robot.limbs]
    extra = int(not body.planar)  # the root has two axes
    answer = []
    for order in orders:
        limbs = [bodies.index(order[each]) for each in bodies]
        axes = [0] * extra + [limb + extra for limb in limbs]
        pose = np.array([0, *(1 + 2 * axis + part for axis in axes for part in (0, 1))])
        size = len(pose)
        answer.append(np.concatenate([pose, size + pose, [2 * size, 2 * size + 1]]))
    return np.stack(answer)


def _branch(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and all that hang on it."""
    return [
        body,
        *(b for child in np.flatnonzero(model.body_parentid == body) for b in _branch(model, child)),
    ]


def _alike(model: mujoco.MjModel, robot: Robot, one: int, other: int) -> bool:
    """Whether two bodies hang on the same one and look the same, with all that hangs on them."""
    plane, branches = [robot.camera.right, robot.camera.up], (_branch(model, one), _branch(model, other))
    if model.body_parentid[one] != model.body_parentid[other] or len(branches[0]) != len(branches[1]):
        return False
    for a, b in zip(*branches, strict=True):
        geoms = [np.flatnonzero(model.geom_bodyid == each) for each in (a, b)]
        if len(geoms[0]) != len(geoms[1]) or not np.allclose(
            model.body_pos[a, plane], model.body_pos[b, plane], atol=0.01
        ):
            return False
        for sizes in (model.geom_size, model.geom_pos[:, plane], np.float64(model.geom_type)[:, None]):
            if not np.allclose(sizes[geoms[0]], sizes[geoms[1]], atol=0.01):
                return False
    return True


def has_floor(robot: Robot) -> bool:
    """Whether pictures show how far the robot is above a floor."""
    return robot.root != "fixed" and robot.camera.up == 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Eye:
    """A camera and how much it shows."""

    azimuth: float
    """Degrees; 90 looks straight at the plane in which the robot moves."""
    elevation: float
    """Degrees; below 0 it looks down."""
    distance: float
    """Metres."""
    view: float
    """Height of what it shows at the robot, metres."""

    @property
    def fovy(self) -> float:
        """Vertical field of view, degrees."""
        return math.degrees(2 * math.atan(self.view / 2 / self.distance))

    def row_below(self, size: int, depth: np.ndarray) -> np.ndarray:
        """Rows, of ``size``, of points so many metres below what it looks at."""
        tilt, focal = math.radians(self.elevation), size * self.distance / self.view
        return size / 2 + focal * depth * math.cos(tilt) / (self.distance - depth * math.sin(tilt))


def facing(robot: Robot) -> Eye:
    """The robot's own camera; it shows about three metres."""
    ahead = robot.camera.forward
    azimuth = math.degrees(math.atan2(ahead[1], ahead[0])) if abs(ahead[2]) < 0.5 else 90.0
    elevation = math.degrees(math.asin(ahead[2]))
    return Eye(azimuth=azimuth, elevation=elevation, distance=robot.camera.distance, view=3.0)


class Silhouettes:
    """Draws which geom of a robot each pixel shows. Belongs to the thread that made it; to be closed.

    Args:
        robot: Whose.
        size: Rows and columns.

    Raises:
        UserError: If this machine cannot draw.
    """

    def __init__(self, robot: Robot, size: int = _SIZE) -> None:
        self.robot = robot
        spec = mujoco.MjSpec.from_file(str(robot.xml))
        spec.visual.global_.offwidth = spec.visual.global_.offheight = size
        spec.visual.quality.offsamples = 0
        self.model, self.size = spec.compile(), size
        self.data = mujoco.MjData(self.model)
        self._context: Any = open_context(size, size)
        self._mjr = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + 16)
        for flag, on in (("SHADOW", 0), ("REFLECTION", 0), ("SKYBOX", 0), ("SEGMENT", 1), ("IDCOLOR", 1)):
            self._scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = on
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._rect = mujoco.MjrRect(0, 0, size, size)
        self._pixels = np.empty((size, size, 3), np.uint8)

    def middle(self, qpos: np.ndarray) -> np.ndarray:
        """Where the middle of the robot's geoms is in positions (q,): metres, (3,)."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.geom_xpos[self.model.geom_bodyid > 0].mean(axis=0)

    def draw(self, qpos: np.ndarray, eye: Eye, at: np.ndarray) -> np.ndarray:
        """Which geom each pixel shows.

        Args:
            qpos: Positions, (q,).
            eye: Looks from where.
            at: What it looks at, metres, (3,).

        Returns:
            (H, W), int32; -1 where it is none of the robot's.
        """
        model, data, camera = self.model, self.data, self._camera
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        camera.lookat[:] = at
        camera.azimuth, camera.elevation, camera.distance = eye.azimuth, eye.elevation, eye.distance
        model.vis.global_.fovy = eye.fovy
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, camera, everything, self._scene)
        mujoco.mjr_render(self._rect, self._scene, self._mjr)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, self._mjr)
        which = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and model.geom_bodyid[geom.objid]:
                which[geom.segid + 1] = geom.objid
        numbers = self._pixels[::-1].astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
        return which[np.minimum(numbers, len(which) - 1)]

    def close(self) -> None:
        """Frees the GL context."""
        if self._context is not None:
            self._context.make_current()
            self._mjr.free()
            self._context.free()
            self._context = None

    def __enter__(self) -> Silhouettes:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def films(env_name: str, count: int, seed: int, check: Callable[[float], None]) -> Films:
    """Draws short films of what random actions do from random and from standing starts.

    Args:
        env_name: The robot.
        count: n.
        seed: Of states, cameras and faults.
        check: Called now and then with the share that is done; what it raises ends the drawing.

    Raises:
        UserError: If this machine cannot draw.
    """
    robot, rng = robot_named(env_name), np.random.default_rng(seed)
    qpos, shown = _states(robot, count, seed, rng)
    with Silhouettes(robot) as drawing:
        reach = length_of(drawing, qpos[:, 0])
        seen = []
        for number, film in enumerate(qpos):
            if number % 20 == 0:
                check(number / count)
            seen.append(_seen(drawing, film, reach, rng))
    return Films(
        crops=np.stack([view.crops for view in seen]), places=np.stack([view.places for view in seen]),
        aims=shown, reach=reach, swaps=swaps_of(robot),
    )  # fmt: skip


def _states(robot: Robot, count: int, seed: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the frames of films, (n, T, q), and what they show, (n, T, A)."""
    every = round(_SECONDS / robot.dt)
    steps = np.round(np.arange(FRAMES) / RATE / robot.dt).astype(int)
    starts = -(-count // _FILMS_EACH)
    rollouts = wild_rollouts(
        robot.name, lanes=-(-starts // 8), steps=8 * every, every=every, seed=seed, standing=_STANDING
    )
    lane, episode = np.divmod(rng.permutation(starts).repeat(_FILMS_EACH)[:count], 8)
    first = rng.integers(every - steps[-1], size=count)
    at = (lane[:, None], (episode * every + first)[:, None] + steps)
    return rollouts.qpos[at], aims(robot, rollouts.qpos[at], rollouts.obs[at])


def length_of(drawing: Silhouettes, qpos: np.ndarray) -> float:
    """Diagonal of the box around the robot in the camera's plane, in its longest of poses (n, q): metres.

    Nearly longest, one in twenty: as it is told from masks of a video.
    """
    model, data = drawing.model, drawing.data
    mine = model.geom_bodyid > 0
    diagonals = []
    for q in qpos[:: max(1, len(qpos) // 400)]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        turn = data.geom_xmat[mine].reshape(-1, 3, 3)
        middle = data.geom_xpos[mine] + np.einsum("gij,gj->gi", turn, model.geom_aabb[mine, :3])
        half = np.einsum("gij,gj->gi", np.abs(turn), model.geom_aabb[mine, 3:])
        sides = (middle + half).max(axis=0) - (middle - half).min(axis=0)
        diagonals.append(np.hypot(sides[drawing.robot.camera.right], sides[drawing.robot.camera.up]))
    return float(np.percentile(diagonals, 95))


def _seen(drawing: Silhouettes, qpos: np.ndarray, reach: float, rng: np.random.Generator) -> Views:
    """What is seen of a film, (T, q)."""
    camera = drawing.robot.camera
    straight, tilt = facing(drawing.robot), rng.uniform(-26, 5)
    eye = Eye(
        azimuth=straight.azimuth + rng.uniform(-14, 14),
        elevation=straight.elevation + (tilt if straight.elevation > -45 else abs(tilt)),
        distance=reach * rng.uniform(1.7, 3.2), view=reach * _VIEW,
    )  # fmt: skip
    aside = np.zeros(3)
    aside[[camera.right, camera.up]] = reach * rng.uniform(-0.1, 0.1, 2)
    at = np.stack([drawing.middle(q) for q in qpos]) + aside
    ids = np.stack([drawing.draw(q, eye, place) for q, place in zip(qpos, at, strict=True)])
    scale, way = drawing.size / eye.view, at[:, camera.right]
    floor = eye.row_below(drawing.size, at[:, camera.up])
    masks = _spoilt(ids, floor, reach * scale, rng)
    floor += scale * (rng.normal(0, 0.03) + rng.normal(0, 0.008, len(qpos)))
    wrong, known = rng.uniform(0.9, 1.1), rng.random() >= 0.1 and has_floor(drawing.robot)
    return views(
        masks,
        floor=floor if known else np.full(len(qpos), np.nan),
        scale=scale * wrong,
        way=None if rng.random() < 0.15 else way / wrong + rng.normal(0, 0.004, len(qpos)),
        reach=reach,
    )


def _spoilt(ids: np.ndarray, floor: np.ndarray, reach: float, rng: np.random.Generator) -> np.ndarray:
    """Masks as they are found, (T, H, W), bool, of geoms as they are drawn; ``reach`` in pixels."""
    masks, geoms = ids >= 0, np.unique(ids[ids >= 0])
    bad = rng.choice([0.0, 0.5, 1.0], p=[0.25, 0.45, 0.3])  # some videos are easy, some are not
    if rng.random() < 0.35 * bad and len(geoms) > 1:  # a limb is lost for a while
        first, last = np.sort(rng.integers(len(ids) + 1, size=2))
        masks[first:last] &= ids[first:last] != rng.choice(geoms)
    blur, edge = rng.uniform(0.4, 1.8), rng.uniform(0.32, 0.6)
    rough, grown = 0.3 * bad * rng.random(), int(rng.choice([0, 1, -1], p=[0.6, 0.35, 0.05]))
    shadow, mirrored = rng.random(2) < 0.25 * bad
    spoilt = np.empty_like(masks)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for index, mask in enumerate(masks):
        if not mask.any() or rng.random() < 0.03 * bad:
            spoilt[index] = False
            continue
        solid = mask.astype(np.float32)
        if grown:
            solid = (cv2.dilate if grown > 0 else cv2.erode)(solid, cross)
        places = np.argwhere(mask)
        if rng.random() < 0.35 * bad:  # a piece is lost, or something beside it is taken for it
            _ellipse(solid, places, reach * rng.uniform(0.02, 0.12, 2), rng, float(rng.random() < 0.35))
        if rng.random() < 0.25 * bad:  # it is cut in two
            _band(solid, places, reach * rng.uniform(0.03, 0.16), rng)
        if shadow:
            middle = (int(places[:, 1].mean() + rng.normal(0, 2)), int(floor[index]))
            axes = (int(rng.uniform(0.1, 0.3) * reach), int(rng.uniform(0.01, 0.04) * reach))
            cv2.ellipse(solid, middle, axes, 0, 0, 360, 1.0, -1)
        if mirrored and rng.random() < 0.8:
            _mirror(solid, floor[index], reach * rng.uniform(0.03, 0.3))
        solid = cv2.GaussianBlur(solid, (0, 0), blur)
        if rough:
            noise = rng.normal(0, rough, [side // 4 for side in mask.shape]).astype(np.float32)
            solid += cv2.resize(noise, mask.shape[::-1]) * (solid > 0.02)
        spoilt[index] = solid > edge
    return spoilt


def _ellipse(
    solid: np.ndarray, places: np.ndarray, axes: np.ndarray, rng: np.random.Generator, fill: float
) -> None:
    row, column = places[rng.integers(len(places))]
    size = (int(axes[0]), int(axes[1]))
    cv2.ellipse(solid, (int(column), int(row)), size, rng.uniform(0, 180), 0, 360, fill, -1)


def _band(solid: np.ndarray, places: np.ndarray, width: float, rng: np.random.Generator) -> None:
    """Takes a straight band out of what is solid."""
    row, column = places[rng.integers(len(places))]
    turn, (rows, columns) = rng.uniform(0, np.pi), np.indices(solid.shape, np.float32)
    solid[np.abs((rows - row) * np.sin(turn) + (columns - column) * np.cos(turn)) < width / 2] = 0


def _mirror(solid: np.ndarray, floor: float, depth: float) -> None:
    """Adds what a polished floor shows of it, down to so many pixels."""
    flip = np.array([[1, 0, 0], [0, -1, 2 * floor]], np.float32)
    mirrored = cv2.warpAffine(solid, flip, solid.shape[::-1])
    top, bottom = (int(np.clip(row, 0, len(solid))) for row in (floor, floor + depth))
    np.maximum(solid[top:bottom], mirrored[top:bottom], out=solid[top:bottom])
