"""The outline of a robot as its camera's plane shows it: each geom's convex hull, laid over one another.

Shapes: G geoms, n points.
"""

from __future__ import annotations

import math

import cv2
import mujoco
import numpy as np

_FINE = 160
"""Pixels of the drawing that an outline is taken from, per metre of a robot seen from three metres."""
_ROUND = 12
"""Points of a circle."""
_MOST = 400
"""Points of a mesh that are looked at."""


class Silhouette:
    """Draws outlines of one robot.

    Args:
        model: The robot's.
        geoms: Those of which outlines are drawn, (G,).
        axes: Directions to the right and up in pictures, (2, 3).
        size: Of the robot, as ``Camera.size``.
    """

    def __init__(self, model: mujoco.MjModel, geoms: np.ndarray, axes: np.ndarray, size: float) -> None:
        self._clouds = [(int(geom), _surface(model, int(geom))) for geom in geoms]
        self._axes = axes
        self._fine = _FINE / size

    def of(self, data: mujoco.MjData) -> np.ndarray:
        """The border of the robot as a simulation has it, (n, 2): to the right and up, metres."""
        hulls = []
        for geom, cloud in self._clouds:
            turned = cloud @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            hulls.append(cv2.convexHull((turned @ self._axes.T).astype(np.float32))[:, 0])
        corner = np.min([hull.min(axis=0) for hull in hulls], axis=0) - 4 / self._fine
        wide, tall = np.max([hull.max(axis=0) for hull in hulls], axis=0) + 4 / self._fine - corner
        drawing = np.zeros((math.ceil(tall * self._fine), math.ceil(wide * self._fine)), np.uint8)
        for hull in hulls:
            cv2.fillConvexPoly(drawing, np.round((hull - corner) * self._fine).astype(np.int32), 1)
        # What does not quite touch belongs together.
        near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
        found, _ = cv2.findContours(
            cv2.morphologyEx(drawing, cv2.MORPH_CLOSE, near), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        return corner + cv2.approxPolyDP(max(found, key=cv2.contourArea), 1.0, True)[:, 0] / self._fine


def _surface(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Points whose convex hull is the geom, in its own frame, (n, 3), metres."""
    kinds, kind, size = mujoco.mjtGeom, model.geom_type[geom], model.geom_size[geom]
    turn = np.linspace(0, 2 * math.pi, _ROUND, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(_ROUND)], axis=1)
    rings = [(math.cos(a), math.sin(a)) for a in np.linspace(-math.pi / 2, math.pi / 2, _ROUND // 2 + 1)]
    ball = np.concatenate([circle * wide + [0, 0, high] for wide, high in rings])
    if kind == kinds.mjGEOM_SPHERE:
        return ball * size[0]
    if kind == kinds.mjGEOM_ELLIPSOID:
        return ball * size
    if kind == kinds.mjGEOM_CAPSULE:
        return np.concatenate([ball * size[0] + [0, 0, end] for end in (-size[1], size[1])])
    if kind == kinds.mjGEOM_CYLINDER:
        return np.concatenate([circle * size[0] + [0, 0, end] for end in (-size[1], size[1])])
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        return model.mesh_vert[first : first + count : max(1, count // _MOST)].astype(float)
    middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    return middle + half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
