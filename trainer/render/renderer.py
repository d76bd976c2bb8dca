"""Pictures of the robot from stored positions, without a screen.

The robot alone is drawn by MuJoCo, at twice the size and then averaged down (smooth edges at a
half of the price of multisampling); sky, floor and shadow come from ``onedemo.render.backdrop``.
The camera follows the robot along the track but keeps its height, so that a jump is seen as one;
it rises only when the robot would leave the picture.

Shapes: T pictures, q positions, H rows, W columns.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import mujoco
import numpy as np

from onedemo.render.backdrop import Camera, Window, backdrop, whole_view
from onedemo.render.gl_context import open_context

WIDTH, HEIGHT = 480, 360
"""Size of what is learned from and of one side of a film, pixels."""
CLOSE_WIDTH, CLOSE_HEIGHT = 720, 540
"""Size of the robot's side of a clip, pixels: what a screen of 1440 x 900 has room for, drawn for all."""

HOPPER_XML = Path(str(gymnasium.__file__)).parent / "envs/mujoco/assets/hopper.xml"

_SCALE = 2
_CLOSE_SCALE = 1.5  # close up an edge is a smaller part of the picture: half the pixels to draw and read
LIMB_COLOURS = ((0.91, 0.29, 0.17), (0.13, 0.25, 0.47), (0.20, 0.48, 0.76), (0.97, 0.69, 0.15))
"""From the head down. Each limb its own colour: head and foot are told apart at any angle."""
FOVY = 39.0
"""Vertical field of view, degrees."""
CAMERA_HEIGHT = 0.88
"""Metres."""
CAMERA_DISTANCE = 3.0
"""Of the model's camera, metres."""
FREE_ABOVE = 0.95
"""The robot may rise this far above the camera before the camera follows, metres."""


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


def studio(width: int = WIDTH, height: int = HEIGHT) -> CloseUp:
    """What pictures of the robot show as long as it does not rise out of them."""
    scale = whole_view(height, width, FOVY).focal / CAMERA_DISTANCE
    return CloseUp(
        width=width, height=height, scale=float(scale), bottom=float(CAMERA_HEIGHT - height / 2 / scale)
    )


class Renderer:
    """Draws stored positions of one robot. Belongs to the thread that made it.

    Args:
        width: Pixels, even.
        height: Pixels, even.
        model_path: The robot's MJCF file; a planar robot with a plane for a floor.
        exact: Gives the same bits as ever, for what learns from pictures; else, for people, takes less than
            two thirds of the time and is a grey level off in some pixels.

    Raises:
        UserError: If this machine cannot draw without a screen, naming the missing package.
    """

    def __init__(
        self, width: int = WIDTH, height: int = HEIGHT, *, model_path: str | Path = HOPPER_XML,
        exact: bool = True,
    ) -> None:  # fmt: skip
        if width < 2 or height < 2 or width % 2 or height % 2:
            raise ValueError(f"the picture's size must be even and positive, got {width}x{height}")
        self.width, self.height = width, height
        self._exact = exact
        self.between: Callable[[], None] = lambda: None
        """To be called by long jobs every tenth of a second: it may do something more urgent, or raise."""
        self._thread = threading.get_ident()
        # For people clips, too, are drawn, at another size.
        close = (0, 0) if exact else (int(CLOSE_HEIGHT * _CLOSE_SCALE), int(CLOSE_WIDTH * _CLOSE_SCALE))
        big = (max(height * _SCALE, close[0]), max(width * _SCALE, close[1]))
        self._model = _studio_model(Path(model_path), width=big[1], height=big[0])
        self._context: Any = open_context(big[1], big[0])
        self._data = mujoco.MjData(self._model)
        self._mjr = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 16)
        for flag in ("SHADOW", "REFLECTION", "SKYBOX", "FOG", "HAZE"):
            self._scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
        self._option = mujoco.MjvOption()
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._view.fixedcamid = self._model.camera("track").id
        self._distance = -float(self._model.camera("track").pos[1])
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
            limbs_L4, top = self._pose(qpos)
            camera = Camera(
                x=float(self._data.subtree_com[0, 0]),
                z=CAMERA_HEIGHT + max(0.0, top - CAMERA_HEIGHT - FREE_ABOVE),
                distance=self._distance,
                fovy=FOVY,
            )
            image[:] = backdrop(self.width, self.height, camera, limbs_L4, exact=self._exact)
            self._draw(image, camera, window, limbs_L4, top, by=_SCALE, exact=self._exact)
        return images

    def close_ups(self, qpos_kq: np.ndarray, x_k: np.ndarray, close: CloseUp) -> np.ndarray:
        """Draws part of what the camera sees, from beside given places and always from one height.

        Args:
            qpos_kq: Positions, (k, q), metres and radians.
            x_k: Place along the track that is in the middle of each picture, (k,), metres.
            close: Which part.

        Returns:
            Pictures, (k, H, W, 3), uint8 RGB.

        Raises:
            ValueError, RuntimeError: As ``render``.
        """
        qpos_kq = self._checked(qpos_kq)
        images = np.empty((len(qpos_kq), close.height, close.width, 3), np.uint8)
        window = Window(
            focal=close.scale * self._distance,
            column=close.width / 2,
            row=close.height - (CAMERA_HEIGHT - close.bottom) * close.scale,
        )
        half = Window(focal=window.focal / 2, column=window.column / 2, row=window.row / 2)
        for image, qpos, x in zip(images, qpos_kq, x_k, strict=True):
            limbs_L4, top = self._pose(qpos)
            camera = Camera(x=float(x), z=CAMERA_HEIGHT, distance=self._distance, fovy=FOVY)
            # The floor behind may be soft, at a quarter of the time.
            behind = backdrop(close.width // 2, close.height // 2, camera, limbs_L4, exact=False, window=half)
            cv2.resize(behind, (close.width, close.height), dst=image, interpolation=cv2.INTER_LINEAR)
            self._draw(image, camera, window, limbs_L4, top, by=_CLOSE_SCALE, exact=False)
        return images

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

    def _pose(self, qpos: np.ndarray) -> tuple[np.ndarray, float]:
        """Moves the robot; its limbs and its top, as ``_limbs``."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        return _limbs(model, data)

    def _draw(
        self, image: np.ndarray, camera: Camera, window: Window, limbs_L4: np.ndarray, top: float, *,
        by: float, exact: bool,
    ) -> None:  # fmt: skip
        """Draws the robot, just posed, over what is behind it."""
        height, width = image.shape[:2]
        self._data.cam_xpos[self._view.fixedcamid] = (camera.x, -camera.distance, camera.z)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._view, everything, self._scene
        )
        # Reading all of the picture would take longer than drawing the robot, which covers a tenth of it.
        x0, y0, x1, y1 = _part(limbs_L4, top, camera, window, width, height)
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


def _studio_model(path: Path, *, width: int, height: int) -> mujoco.MjModel:
    """The robot alone, in flat strong colours under a soft light; physics is left as it is."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.offsamples = 0
    spec.visual.quality.numslices = 40
    spec.visual.headlight.ambient = [0.46] * 3
    spec.visual.headlight.diffuse = [0.26] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.camera("track").fovy = FOVY
    for light in spec.lights:
        light.dir = [0.35, 0.55, -1.0]
        light.diffuse, light.ambient, light.specular = [0.5] * 3, [0.0] * 3, [0.22] * 3
    limb = 0
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.rgba = [0, 0, 0, 0]  # the floor is drawn by the backdrop
        else:
            geom.material = ""
            geom.rgba = [*LIMB_COLOURS[limb % len(LIMB_COLOURS)], 1]
            limb += 1
    return spec.compile()


def _limbs(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, float]:
    """Per capsule (x low, x high, z low, radius), (L, 4), and the top of the whole, metres."""
    solid = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE.value
    radius = model.geom_size[solid, 0]
    axis = data.geom_xmat[solid].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[solid, 1:2]
    reach = np.abs(axis) + radius[:, None]
    low, high = data.geom_xpos[solid] - reach, data.geom_xpos[solid] + reach
    return np.stack([low[:, 0], high[:, 0], low[:, 2], radius], 1), float(high[:, 2].max())


def _part(
    limbs_L4: np.ndarray, top: float, camera: Camera, window: Window, width: int, height: int
) -> tuple[int, int, int, int]:
    """What part of the picture can hold the robot: left, bottom, right, top, pixels from below."""
    lowest, highest = limbs_L4.min(0).tolist(), limbs_L4.max(0).tolist()
    # Whatever is left of the middle is furthest from it where it is nearest to the camera, or else farthest.
    scales = (window.focal / (camera.distance - highest[3]), window.focal / camera.distance)
    x0, x1 = (edge(scale * (x - camera.x) for scale in scales) + window.column
              for edge, x in ((min, lowest[0]), (max, highest[1])))  # fmt: skip
    y0, y1 = (edge(scale * (z - camera.z) for scale in scales) + height - window.row
              for edge, z in ((min, lowest[2]), (max, top)))  # fmt: skip
    low = [max(0, math.floor(edge) - 1) for edge in (x0, y0)]
    high = [min(size, math.ceil(edge) + 1) for edge, size in ((x1, width), (y1, height))]
    return low[0], low[1], high[0], high[1]


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
