"""The robot as others draw it, with their cameras; and what codecs and blur do to such films.

Shapes: F frames, q positions, H rows, W columns; frames are uint8 RGB.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import av
import cv2
import gymnasium
import mujoco
import numpy as np

from onedemo.render.gl_context import open_context
from onedemo.render.renderer import Renderer
from onedemo.robots.camera import FOVY, Camera
from onedemo.robots.robot import Robot, model_of
from onedemo.vision.silhouette_pictures import Eye

GYMNASIUM = {"hopper": "Hopper-v5", "walker2d": "Walker2d-v5", "half-cheetah": "HalfCheetah-v5"}
"""Names of environments that draw our robots."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """A way to draw a robot."""

    eye: Eye
    """The camera that masks are drawn for: it is the look's own."""
    height: float | None
    """Of what the camera looks at, metres; it follows the robot along the floor. None: it is the model's own
    camera, which keeps its place beside the centre of mass."""
    size: tuple[int, int]
    """Columns and rows."""
    draw: Callable[[Robot, np.ndarray], np.ndarray]
    """Frames, (F, H, W, 3), of a robot in positions (F, q)."""

    def places(self, robot: Robot, qpos: np.ndarray) -> np.ndarray:
        """What the camera looks at: by the centre of mass, metres, (F, 3)."""
        model = model_of(robot.xml)
        data, places = mujoco.MjData(model), np.zeros((len(qpos), 3))
        mujoco.mj_forward(model, data)
        above = data.cam_xpos[0, 2] - data.subtree_com[0, 2]
        for place, q in zip(places, qpos, strict=True):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            place[:] = data.subtree_com[0]
            place[2] = place[2] + above if self.height is None else self.height
        return places


def gymnasium_frames(robot: Robot, qpos: np.ndarray) -> np.ndarray:
    """As gymnasium's environment renders, by the camera of its model that follows the robot."""
    env = gymnasium.make(GYMNASIUM[robot.name], render_mode="rgb_array", camera_name="track")
    env.reset(seed=0)
    frames = []
    for q in qpos:
        env.unwrapped.set_state(q, np.zeros(env.unwrapped.model.nv))  # type: ignore[attr-defined]
        frames.append(env.render())
    env.close()
    return np.asarray(frames)


def viser_frames(robot: Robot, qpos: np.ndarray) -> np.ndarray:
    """MuJoCo's drawing in mjviser's colours: the model's own limbs, a white sky, thin lines on the floor."""
    spec = mujoco.MjSpec.from_file(str(robot.xml))
    width, height = VISER.size
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.global_.fovy = VISER.eye.fovy
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.5] * 3
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
            texture.rgb1 = texture.rgb2 = [1.0] * 3
        elif texture.name == "texplane":
            texture.builtin, texture.mark = mujoco.mjtBuiltin.mjBUILTIN_FLAT, mujoco.mjtMark.mjMARK_EDGE
            texture.rgb1 = texture.rgb2 = [1.0] * 3
            texture.markrgb = [0.75] * 3
    model = spec.compile()
    model.mat_reflectance[:] = 0
    data, context = mujoco.MjData(model), open_context(width, height)
    renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, renderer)
    scene, option, camera = mujoco.MjvScene(model, 1000), mujoco.MjvOption(), mujoco.MjvCamera()
    scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
    rect, everything = mujoco.MjrRect(0, 0, width, height), mujoco.mjtCatBit.mjCAT_ALL.value
    camera.distance, camera.azimuth, camera.elevation = (
        VISER.eye.distance, VISER.eye.azimuth, VISER.eye.elevation,
    )  # fmt: skip
    frames = np.empty((len(qpos), height, width, 3), np.uint8)
    try:
        for frame, q in zip(frames, qpos, strict=True):
            data.qpos[:] = q
            mujoco.mj_forward(model, data)
            camera.lookat[:] = (data.subtree_com[0, 0], 0.0, VISER.height)
            mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
            mujoco.mjr_render(rect, scene, renderer)
            mujoco.mjr_readPixels(frame, None, rect, renderer)
    finally:
        context.make_current()
        renderer.free()
        context.free()
    return frames[:, ::-1]


def our_frames(robot: Robot, qpos: np.ndarray) -> np.ndarray:
    """As this program draws."""
    with Renderer(robot=robot) as renderer:
        return renderer.render(qpos)


def turned_frames(robot: Robot, qpos: np.ndarray) -> np.ndarray:
    """The same in other colours: all hues turned by a third of the circle."""
    frames = our_frames(robot, qpos)
    for frame in frames:
        colours = cv2.cvtColor(frame, cv2.COLOR_RGB2HSV)
        colours[..., 0] = (colours[..., 0] + np.uint8(60)) % 180
        frame[:] = cv2.cvtColor(colours, cv2.COLOR_HSV2RGB)
    return frames


def _view(fovy: float, distance: float) -> float:
    return 2 * distance * math.tan(math.radians(fovy) / 2)


_CAMERA = Camera()  # of a robot of the hopper's size
_STUDIO = Eye(azimuth=90, elevation=0, distance=_CAMERA.distance, view=_view(FOVY, _CAMERA.distance))
VISER = Look(
    eye=Eye(azimuth=90, elevation=0, distance=3.0, view=_view(45, 3.0)), height=1.02, size=(480, 360),
    draw=viser_frames,
)  # fmt: skip
LOOKS: Mapping[str, Look] = {
    "gymnasium": Look(
        eye=Eye(azimuth=90, elevation=0, distance=3.0, view=_view(45, 3.0)), height=None, size=(480, 480),
        draw=gymnasium_frames,
    ),
    "mjviser's colours": VISER,
    "ours, other colours": Look(eye=_STUDIO, height=_CAMERA.height, size=(480, 360), draw=turned_frames),
    "ours": Look(eye=_STUDIO, height=_CAMERA.height, size=(480, 360), draw=our_frames),
}  # fmt: skip


def coded(frames: np.ndarray, codec: str, options: Mapping[str, str], fps: float = 30.0) -> np.ndarray:
    """Frames after a codec had them, (F, H, W, 3)."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="matroska") as out:
        stream: Any = out.add_stream(codec, rate=round(fps), options=dict(options))
        stream.width, stream.height = frames.shape[2], frames.shape[1]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for frame in frames:
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), "rgb24")):
                out.mux(packet)
        for packet in stream.encode(None):
            out.mux(packet)
    buffer.seek(0)
    with av.open(buffer) as read:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in read.decode(video=0)])


def blurred(frames: np.ndarray, sigma: float = 1.5) -> np.ndarray:
    """Frames out of focus, and each mixed with the next as of a slow shutter."""
    soft = np.stack([cv2.GaussianBlur(frame, (0, 0), sigma) for frame in frames])
    mixed = [cv2.addWeighted(a, 0.75, b, 0.25, 0) for a, b in pairwise(soft)]
    return np.stack([*mixed, soft[-1]])


FAULTS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "H.264": lambda frames: coded(frames, "libx264", {"crf": "32", "preset": "veryfast"}),
    "VP9, blurred": lambda frames: coded(
        blurred(frames), "libvpx-vp9", {"crf": "40", "b": "0", "deadline": "realtime", "cpu-used": "8"}
    ),
    "MJPEG, blurred": lambda frames: coded(blurred(frames), "mjpeg", {"qmin": "12", "qmax": "12"}),
}
"""What happens to a video on its way."""
