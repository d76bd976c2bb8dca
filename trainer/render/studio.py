"""A robot dressed for pictures: each limb in a strong flat colour of its own, under a soft light.

The trunk is red. Every chain of limbs that begins at it has a colour of its own, which goes from dark to
bright on the way out, so that like limbs of both sides, and both ends of each, are told apart. The colours
differ in lightness as well as in hue, for those who see no red or no green.
"""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from onedemo.robots.camera import FOVY, Camera, Extents, visible_geoms
from onedemo.robots.robot import Robot

LIMB_COLOURS = ((0.91, 0.29, 0.17), (0.13, 0.25, 0.47), (0.20, 0.48, 0.76), (0.97, 0.69, 0.15))
"""Of the trunk, and of the first chain from there out."""
_TRUNK = (LIMB_COLOURS[0], (0.66, 0.17, 0.13))
_CHAINS = (
    LIMB_COLOURS[1:],
    ((0.04, 0.33, 0.27), (0.09, 0.60, 0.45), (0.66, 0.90, 0.78)),
    ((0.58, 0.22, 0.58), (0.80, 0.50, 0.80), (0.97, 0.78, 0.92)),
    ((0.36, 0.23, 0.10), (0.66, 0.46, 0.24), (0.91, 0.79, 0.58)),
)
_SCENERY = (0.70, 0.74, 0.79)

EYE = "onedemo eye"
"""The camera that pictures are taken with, which is moved for each."""


def chains(model: mujoco.MjModel, root: str) -> dict[int, tuple[int, int]]:
    """Which chain each body with geoms belongs to, and how far out in it it is.

    Args:
        model: Of the robot.
        root: As ``onedemo.robots.robot.root_of``: a robot that moves about has a trunk, an arm has none
            but its first body.

    Returns:
        Of each such body the number of its chain, -1 for the trunk, and its place there, from 0 on.
    """
    seen = {int(model.geom_bodyid[geom]) for geom in visible_geoms(model)} - {0}
    parents: dict[int, int] = {}
    for body in sorted(seen):
        parent = int(model.body_parentid[body])
        while parent and parent not in seen:
            parent = int(model.body_parentid[parent])
        parents[body] = parent
    children = {body: [b for b, parent in parents.items() if parent == body] for body in seen}
    trunk = {body for body, parent in parents.items() if not parent}
    if root != "fixed":
        for body in sorted(seen):
            if len(children[body]) > 1:
                while body:
                    trunk.add(body)
                    body = parents[body]
    found: dict[int, tuple[int, int]] = {}
    count = 0
    for body in sorted(seen):
        parent = parents[body]
        if body in trunk:
            found[body] = (-1, found[parent][1] + 1 if parent else 0)
        elif parent in trunk or children[parent][0] != body:
            found[body] = (count, 0)
            count += 1
        else:
            found[body] = (found[parent][0], found[parent][1] + 1)
    return found


def colours_of(robot: Robot, model: mujoco.MjModel) -> np.ndarray:
    """The colour of each geom, (geoms, 3), from 0 to 1; what belongs to the world is grey."""
    colours = np.tile(np.array(_SCENERY), (model.ngeom, 1))
    for body, (chain, place) in chains(model, robot.root).items():
        shades = _TRUNK if chain < 0 else _CHAINS[chain % len(_CHAINS)]
        colours[model.geom_bodyid == body] = shades[place % len(shades)]
    return colours


def studio_model(robot: Robot, *, width: int, height: int) -> mujoco.MjModel:
    """The robot alone, as it is drawn on up to so many pixels; physics is left as it is."""
    spec = mujoco.MjSpec.from_file(str(robot.xml))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.offsamples = 0
    spec.visual.quality.numslices = 40
    spec.visual.headlight.ambient = [0.46] * 3
    spec.visual.headlight.diffuse = [0.26] * 3
    spec.visual.headlight.specular = [0.0] * 3
    for light in list(spec.lights):
        spec.delete(light)
    camera = robot.camera
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, 1.3], cutoff=100, exponent=1,
        dir=0.35 * np.eye(3)[camera.right] + 0.55 * camera.forward - np.eye(3)[camera.up],
        diffuse=[0.5] * 3, ambient=[0.0] * 3, specular=[0.22] * 3,
    )  # fmt: skip
    spec.worldbody.add_camera(name=EYE, fovy=FOVY)
    for geom in spec.geoms:
        geom.material = ""
    with warnings.catch_warnings():  # of what is deprecated in a model
        warnings.simplefilter("ignore")
        model = spec.compile()
    seen = visible_geoms(model)
    model.geom_rgba[:, :3] = colours_of(robot, model)
    model.geom_rgba[:, 3] = 0
    model.geom_rgba[seen, 3] = 1
    model.geom_group[seen] = 0
    _stand_aside(model, camera, seen)
    # What is far from the model's own idea of its size must be seen, too.
    near, far = camera.distance / 30, camera.distance * 10
    if model.vis.map.znear * model.stat.extent > near or model.vis.map.zfar * model.stat.extent < far:
        model.stat.extent, model.vis.map.znear, model.vis.map.zfar = camera.distance, 1 / 30, 10
    return model


def _stand_aside(model: mujoco.MjModel, camera: Camera, seen: np.ndarray) -> None:
    """Leaves out what belongs to the world and would hide the robot, as a wall before it."""
    scenery, limbs = seen[model.geom_bodyid[seen] == 0], seen[model.geom_bodyid[seen] > 0]
    if not scenery.size or not limbs.size:
        return
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    low, high = Extents(model, limbs).of(data)
    low, high = low.min(axis=0), high.max(axis=0)
    axes = [camera.right, camera.up]
    forward = camera.forward
    for geom, low_of_it, high_of_it in zip(scenery, *Extents(model, scenery).of(data), strict=True):
        nearest = min(low_of_it @ forward, high_of_it @ forward)
        over = (low_of_it[axes] < high[axes]).all() and (high_of_it[axes] > low[axes]).all()
        if over and nearest < min(low @ forward, high @ forward):
            model.geom_rgba[geom, 3] = 0
