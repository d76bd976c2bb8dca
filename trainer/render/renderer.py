"""Pictures of the robot from stored positions, without a screen.

The robot alone is drawn by MuJoCo, at twice the size and then averaged down (smooth edges at a
half of the price of multisampling); sky, floor and shadow come from ``onedemo.render.backdrop``.
The camera follows the robot along the track but keeps its height, so that a jump is seen as one;
it rises only when the robot would leave the picture. Where it is comes from ``onedemo.render.stage``.

Shapes: T pictures, q positions, H rows, W columns.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import mujoco
import numpy as np

from onedemo.render.backdrop import Window, whole_view
from onedemo.render.gl_context import open_context
from onedemo.render.stage import Eye, Shape, Stage
from onedemo.render.studio import EYE, studio_model
from onedemo.robots.camera import FOVY, Camera
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.robots.robot import Robot

WIDTH, HEIGHT = 480, 360
"""Size of what is learned from and of one side of a film, pixels."""
CLOSE_WIDTH, CLOSE_HEIGHT = 720, 540
"""Size of the robot's side of a clip, pixels: what a screen of 1440 x 900 has room for, drawn for all."""

_SCALE = 2
_CLOSE_SCALE = 1.5  # close up an edge is a smaller part of the picture: half the pixels to draw and read


@dataclass(frozen=True, kw_only=True, slots=True)
class CloseUp:
    """Part of what the camera sees, enlarged: its size and place are in metres of the robot's plane."""

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    scale: float
    """Pixels a metre."""
    bottom: float
    """Height of the lower edge above the floor, metres."""


def studio(width: int = WIDTH, height: int = HEIGHT, camera: Camera | None = None) -> CloseUp:
    """What pictures of a robot, or of the hopper, show as long as it does not rise out of them."""
    camera = camera or robot_named(DEFAULT).camera
    scale = whole_view(height, width, FOVY).focal / camera.distance
    return CloseUp(
        width=width, height=height, scale=float(scale), bottom=float(camera.height - height / 2 / scale)
    )


class Renderer:
    """Draws stored positions of one robot. Belongs to the thread that made it.

    Args:
        width: Pixels, even.
        height: Pixels, even.
        robot: Whose positions; the hopper if None.
        exact: Gives the same bits as ever, for what learns from pictures; else, for people, takes less than
            two thirds of the time and is a grey level off in some pixels.

    Raises:
        UserError: If this machine cannot draw without a screen, naming the missing package.
    """

    def __init__(
        self, width: int = WIDTH, height: int = HEIGHT, *, robot: Robot | None = None, exact: bool = True
    ) -> None:
        if width < 2 or height < 2 or width % 2 or height % 2:
            raise ValueError(f"the picture's size must be even and positive, got {width}x{height}")
        self.width, self.height = width, height
        self.robot = robot or robot_named(DEFAULT)
        """Whose positions it draws."""
        self._exact = exact
        self.between: Callable[[], None] = lambda: None
        """To be called by long jobs every tenth of a second: it may do something more urgent, or raise."""
        self._thread = threading.get_ident()
        # For people clips, too, are drawn, at another size.
        close = (0, 0) if exact else (int(CLOSE_HEIGHT * _CLOSE_SCALE), int(CLOSE_WIDTH * _CLOSE_SCALE))
        big = (max(height * _SCALE, close[0]), max(width * _SCALE, close[1]))
        self._model = studio_model(self.robot, width=big[1], height=big[0])
        self._stage = Stage(self.robot, self._model)
        self._context: Any = open_context(big[1], big[0])
        self._data = mujoco.MjData(self._model)
        self._mjr = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 16)
        for flag in ("SHADOW", "REFLECTION", "SKYBOX", "FOG", "HAZE"):
            self._scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0
        for kind in ("TENDON", "SKIN", "FLEXVERT", "FLEXEDGE", "FLEXFACE", "FLEXSKIN"):
            self._option.flags[getattr(mujoco.mjtVisFlag, f"mjVIS_{kind}")] = 0
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._view.fixedcamid = self._model.camera(EYE).id
        self._rect = mujoco.MjrRect(0, 0, width * _SCALE, height * _SCALE)
        self._room = (big[1], big[0])
        self._pixels = np.empty(big[0] * big[1] * 3, np.uint8)

    def render(self, qpos_Tq: np.ndarray) -> np.ndarray:
        """Draws one picture per row of positions.

        Args:
            qpos_Tq: Positions, (T, q), metres and radians.

        Returns:
            Pictures, (T, H, W, 3), uint8 RGB.

        Raises:
            ValueError: If the shape is wrong or a position is not finite.
            RuntimeError: If called from another thread or after ``close``.
        """
        qpos_Tq = self._checked(qpos_Tq)
        window = whole_view(self.height, self.width, FOVY)
        images = np.empty((len(qpos_Tq), self.height, self.width, 3), np.uint8)
        for image, qpos in zip(images, qpos_Tq, strict=True):
            shape = self._stage.pose(self._data, qpos)
            eye = self._stage.eye(self._data, shape)
            image[:] = self._stage.backdrop(self.width, self.height, eye, window, shape, exact=self._exact)
            self._draw(image, eye, window, shape, by=_SCALE, exact=self._exact)
        return images

    def close_ups(
        self, qpos_kq: np.ndarray, x_k: np.ndarray, close: CloseUp, rise_k: np.ndarray | None = None
    ) -> np.ndarray:
        """Draws part of what the camera sees, from beside given places and always from one height.

        Args:
            qpos_kq: Positions, (k, q), metres and radians.
            x_k: Place along the track that is in the middle of each picture, (k,), metres.
            close: Which part.
            rise_k: By how much the part is moved up in each picture, and the camera with it, (k,), metres;
                not at all if None.

        Returns:
            Pictures, (k, H, W, 3), uint8 RGB.

        Raises:
            ValueError, RuntimeError: As ``render``.
        """
        qpos_kq = self._checked(qpos_kq)
        stage, placing = self._stage, self.robot.camera
        images = np.empty((len(qpos_kq), close.height, close.width, 3), np.uint8)
        above = placing.height if rise_k is None else 0.0
        window = Window(
            focal=close.scale * placing.distance,
            column=close.width / 2,
            row=close.height - (above - close.bottom) * close.scale,
        )
        half = Window(focal=window.focal / 2, column=window.column / 2, row=window.row / 2)
        heights = np.full(len(qpos_kq), placing.height) if rise_k is None else rise_k
        for image, qpos, x, z in zip(images, qpos_kq, x_k, heights, strict=True):
            shape = stage.pose(self._data, qpos)
            eye = replace(stage.eye(self._data, shape), x=float(x), z=float(z))
            # The floor behind may be soft, at a quarter of the time.
            behind = stage.backdrop(close.width // 2, close.height // 2, eye, half, shape, exact=False)
            cv2.resize(behind, (close.width, close.height), dst=image, interpolation=cv2.INTER_LINEAR)
            self._draw(image, eye, window, shape, by=_CLOSE_SCALE, exact=False)
        return images

    def shapes(self, qpos_kq: np.ndarray) -> list[Shape]:
        """How far the robot's geoms reach at each of some positions, (k, q).

        Places away from the camera are counted from the plane that it is ``Camera.distance`` before.
        """
        found = []
        for qpos in np.asarray(qpos_kq, np.float64):
            shape = self._stage.pose(self._data, qpos)
            plane = np.array([0.0, self._stage.eye(self._data, shape).y, 0.0])
            found.append(Shape(shape.low - plane, shape.high - plane))
        return found

    def outline(self, qpos: np.ndarray) -> np.ndarray:
        """The border of the robot at some positions, (q,): right and above the floor, metres, (n, 2)."""
        self._stage.pose(self._data, np.asarray(qpos, np.float64))
        return self._stage.outline(self._data)

    def close(self) -> None:
        """Frees the GL context. Closing twice does nothing."""
        if self._context is not None:
            # Freed under another context, it would delete that one's textures and buffers.
            self._context.make_current()
            self._mjr.free()
            self._context.free()
            self._context = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _checked(self, qpos_Tq: np.ndarray) -> np.ndarray:
        """Positions, as doubles; from now on this thread draws."""
        if threading.get_ident() != self._thread:
            raise RuntimeError("a Renderer draws only in the thread that made it: use RenderThread")
        if self._context is None:
            raise RuntimeError("this Renderer is closed")
        qpos_Tq = np.asarray(qpos_Tq, np.float64)
        if qpos_Tq.ndim != 2 or qpos_Tq.shape[1] != self._model.nq:
            raise ValueError(f"positions must be (T, {self._model.nq}), got {qpos_Tq.shape}")
        if not np.isfinite(qpos_Tq).all():
            raise ValueError("positions must be finite")
        self._context.make_current()
        return qpos_Tq

    def _draw(
        self, image: np.ndarray, eye: Eye, window: Window, shape: Shape, *, by: float, exact: bool
    ) -> None:
        """Draws the robot, just posed, over what is behind it."""
        height, width = image.shape[:2]
        self._data.cam_xpos[self._view.fixedcamid] = self._stage.place(eye)
        self._data.cam_xmat[self._view.fixedcamid] = self._stage.turn
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._view, everything, self._scene
        )
        # Reading all of the picture would take longer than drawing the robot, which covers a tenth of it.
        x0, y0, x1, y1 = _part(shape, eye, window, width, height)
        if x0 >= x1 or y0 >= y1:
            return
        if not exact:  # one and a half is a whole number for an even one
            x0, y0, x1, y1 = x0 - x0 % 2, y0 - y0 % 2, x1 + x1 % 2, y1 + y1 % 2
        if (x1 - x0) * by > self._room[0] or (y1 - y0) * by > self._room[1]:
            by = 1  # a close-up in an exact renderer, whose pictures are smaller
        rect = mujoco.MjrRect(*(int(edge * by) for edge in (x0, y0, x1 - x0, y1 - y0)))
        pixels = self._pixels[: rect.height * rect.width * 3].reshape(rect.height, rect.width, 3)
        if exact:
            mujoco.mjr_render(self._rect, self._scene, self._mjr)
        else:  # clearing the rest, too
            self._look_at(rect, window, height, by)
            rect = mujoco.MjrRect(0, 0, rect.width, rect.height)
            mujoco.mjr_render(rect, self._scene, self._mjr)
        mujoco.mjr_readPixels(pixels, None, rect, self._mjr)
        (_paste if by == _SCALE else _paste_quickly)(image[height - y1 : height - y0, x0:x1], pixels)

    def _look_at(self, rect: mujoco.MjrRect, window: Window, height: int, by: float) -> None:
        """Narrows the view to a part of the picture, pixels from its lower left corner, ``by`` for one."""
        pixels = 2 * window.focal * by * math.tan(math.radians(FOVY) / 2)  # of all that the camera sees
        for camera in self._scene.camera:
            pixel = (camera.frustum_top - camera.frustum_bottom) / pixels
            camera.frustum_bottom = (rect.bottom - (height - window.row) * by) * pixel
            camera.frustum_top = camera.frustum_bottom + rect.height * pixel
            camera.frustum_center = (rect.left + rect.width / 2 - window.column * by) * pixel
            camera.frustum_width = rect.width / 2 * pixel


def _part(shape: Shape, eye: Eye, window: Window, width: int, height: int) -> tuple[int, int, int, int]:
    """What part of the picture can hold the robot: left, bottom, right, top, pixels from below."""
    low, high = shape.low.min(axis=0).tolist(), shape.high.max(axis=0).tolist()
    # Whatever is left of the middle is furthest from it where it is nearest to the camera, or else farthest.
    nearest = max(eye.distance + low[1] - eye.y, 0.1 * eye.distance)
    scales = (window.focal / nearest, window.focal / max(eye.distance + high[1] - eye.y, nearest))
    x0, x1 = (edge(scale * (x - eye.x) for scale in scales) + window.column
              for edge, x in ((min, low[0]), (max, high[0])))  # fmt: skip
    y0, y1 = (edge(scale * (z - eye.z) for scale in scales) + height - window.row
              for edge, z in ((min, low[2]), (max, high[2])))  # fmt: skip
    begin = [max(0, math.floor(edge) - 1) for edge in (x0, y0)]
    end = [min(size, math.ceil(edge) + 1) for edge, size in ((x1, width), (y1, height))]
    return begin[0], begin[1], end[0], end[1]


def _paste(image: np.ndarray, pixels: np.ndarray) -> None:
    """Lays the robot over the backdrop, in place; black, the clear colour, is see-through.

    Args:
        image: The backdrop, (H, W, 3), uint8.
        pixels: The robot on black, bottom row first, (2H, 2W, 3), uint8.
    """
    solid = cv2.bitwise_not(cv2.inRange(pixels, (0, 0, 0), (0, 0, 0)))
    size = image.shape[1::-1]
    robot = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)[::-1]
    cover = cv2.resize(solid, size, interpolation=cv2.INTER_AREA)[::-1, :, None]
    image[:] = robot + (image * (255 - cover.astype(np.uint16)) // 255).astype(np.uint8)


def _paste_quickly(image: np.ndarray, pixels: np.ndarray) -> None:
    """As ``_paste``, but for a grey level, in half the time; of pixels at any scale."""
    size = image.shape[1::-1]
    # Each pixel of the picture is the mean of the four around it, of two by two or of one and a half.
    method = cv2.INTER_AREA if pixels.shape[1] == 2 * size[0] else cv2.INTER_LINEAR
    seen = cv2.inRange(pixels, (0, 0, 0), (0, 0, 0))
    clear = cv2.flip(cv2.resize(seen, size, interpolation=method), 0)
    robot = cv2.flip(cv2.resize(pixels, size, interpolation=method), 0)
    behind = cv2.multiply(image, cv2.merge([clear] * 3), scale=1 / 255)
    cv2.add(behind, robot, dst=behind)
    image[:] = behind
