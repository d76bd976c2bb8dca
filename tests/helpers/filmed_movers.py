"""Films of movers with what of each picture the mover is: drawn here, so that the truth is known."""

from __future__ import annotations

import io
import json
from pathlib import Path

import av
import cv2
import mujoco
import numpy as np

from helpers import stick_figure
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.library import BUILT_IN
from onedemo.render.renderer import CAMERA_DISTANCE, CAMERA_HEIGHT, FOVY, FREE_ABOVE, HOPPER_XML

FPS = 30.0
DT = 0.008


def positions(name: str, count: int = 240) -> np.ndarray:
    """What a built-in demo shows in each frame, (F, 6)."""
    with np.load(BUILT_IN / f"{name}.hidden.npz") as stored:
        qpos = stored["qpos"]
    frames = json.loads((BUILT_IN / f"{name}.json").read_bytes())["frames"]
    return qpos[steps_of_frames(min(frames, count), DT, FPS)]


class Film:
    """Pictures (F, H, W, 3), and the truth.

    That is: what the mover is (F, H, W), where the camera was (F,), metres, and the row of the floor (F,), or
    None.
    """

    def __init__(
        self,
        frames: np.ndarray,
        masks: np.ndarray,
        way: np.ndarray | None = None,
        floor: np.ndarray | None = None,
    ) -> None:
        self.frames, self.masks, self.way, self.floor = frames, masks, way, floor


def by_gymnasium(
    qpos: np.ndarray, size: tuple[int, int] = (240, 240), colour: tuple[float, ...] | None = None
) -> Film:
    """As gymnasium's own renderer and tracking camera draw the hopper, in its colours or in one other."""
    model = mujoco.MjModel.from_xml_path(str(HOPPER_XML))
    if colour is not None:
        model.geom_rgba[model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE] = (*colour, 1)
    return _drawn(model, qpos, size, "track")


def in_the_studio(qpos: np.ndarray, size: tuple[int, int] = (320, 240)) -> np.ndarray:
    """What of the program's own pictures is the robot, (F, H, W)."""
    model = mujoco.MjModel.from_xml_path(str(HOPPER_XML))
    model.vis.global_.fovy = FOVY
    return _drawn(model, qpos, size, None).masks


def _drawn(model: mujoco.MjModel, qpos: np.ndarray, size: tuple[int, int], camera: str | None) -> Film:
    width, height = size
    model.vis.global_.offwidth, model.vis.global_.offheight = max(640, 2 * width), max(480, 2 * height)
    data = mujoco.MjData(model)
    view: str | mujoco.MjvCamera = camera or mujoco.MjvCamera()
    frames, masks, way, floor = [], [], [], []
    with mujoco.Renderer(model, 2 * height, 2 * width) as renderer:
        for q in qpos:
            data.qpos[:] = q
            mujoco.mj_forward(model, data)
            if isinstance(view, mujoco.MjvCamera):
                view.azimuth, view.elevation, view.distance = 90, 0, CAMERA_DISTANCE
                top = _top(model, data)
                height_m = CAMERA_HEIGHT + max(0.0, top - CAMERA_HEIGHT - FREE_ABOVE)
                view.lookat[:] = data.subtree_com[0, 0], 0, height_m
            renderer.update_scene(data, view)
            frames.append(cv2.resize(renderer.render(), size, interpolation=cv2.INTER_AREA))
            renderer.enable_segmentation_rendering()
            shown = renderer.render()
            renderer.disable_segmentation_rendering()
            solid = (shown[..., 1] == mujoco.mjtObj.mjOBJ_GEOM) & (shown[..., 0] > 0)
            share = cv2.resize(solid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            masks.append(share > 0.5)
            way.append(data.subtree_com[0, 0])
            floor.append(_floor(model, data, height))
    return Film(np.stack(frames), np.stack(masks), np.array(way) - way[0], np.array(floor))


def _floor(model: mujoco.MjModel, data: mujoco.MjData, height: int) -> float:
    """The row at which the tracking camera, three metres away and level, sees the floor below the robot."""
    focal = height / 2 / np.tan(np.radians(model.vis.global_.fovy) / 2)
    return float(height / 2 + focal * data.camera("track").xpos[2] / -model.camera("track").pos[1])


def _top(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    solid = model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    reach = np.abs(data.geom_xmat[solid].reshape(-1, 3, 3)[:, 2, 2] * model.geom_size[solid, 1])
    return float((data.geom_xpos[solid, 2] + reach + model.geom_size[solid, 0]).max())


def figure(noise: float = 4.0, seed: int = 0) -> Film:
    """A drawn person does a backflip before a wall with a door and pictures; the camera stands."""
    rng = np.random.default_rng(seed)
    shown = stick_figure.backflip()
    empty = np.full(shown.shape[1:], (226, 232, 240), np.uint8)
    empty[205:] = (170, 160, 150)
    masks = cv2_any(np.abs(shown.astype(int) - empty).max(axis=-1) > 40)
    wall = empty.copy()
    for _ in range(14):
        x, y = rng.integers(0, 300), rng.integers(0, 150)
        w, h = rng.integers(10, 60, 2)
        colour = tuple(int(c) for c in rng.integers(90, 240, 3))
        cv2.rectangle(wall, (x, y), (x + int(w), y + int(h)), colour, -1)
    frames = np.where(masks[..., None], shown, wall)
    return Film(noisy(frames, noise, rng), masks)


def panned(seed: int = 0, speed: float = 2.5) -> Film:
    """The same person walks along a wall of bricks; a hand-held camera goes along, and shakes."""
    rng = np.random.default_rng(seed)
    still = figure(0.0)
    shown = stick_figure.backflip()
    count, height, width = shown.shape[:3]
    texture = rng.integers(60, 220, (height // 6 + 8, (width + 400) // 6 + 8, 3)).astype(np.uint8)
    texture = cv2.resize(texture, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    texture = cv2.GaussianBlur(texture, (0, 0), 1.5)
    shake = np.cumsum(rng.normal(0, 0.4, (count, 2)), axis=0)
    frames = []
    for index in range(count):
        x, y = 20 + speed * index + shake[index, 0], 20 + 0.3 * shake[index, 1]
        part = cv2.warpAffine(texture, np.float64([[1, 0, -x], [0, 1, -y]]), (width, height))
        frames.append(np.where(still.masks[index][..., None], shown[index], part))
    return Film(noisy(np.stack(frames), 3.0, rng), still.masks, speed * np.arange(count) + shake[:, 0])


def cv2_any(masks: np.ndarray) -> np.ndarray:
    """Masks without single pixels."""
    kernel = np.ones((2, 2), np.uint8)
    return np.stack([cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) for mask in masks]) > 0


def noisy(frames: np.ndarray, deviation: float, rng: np.random.Generator) -> np.ndarray:
    """As a camera in a dark room sees them."""
    grain = rng.normal(0, deviation, frames.shape) if deviation else 0
    return np.clip(frames + grain, 0, 255).astype(np.uint8)


def compressed(frames: np.ndarray, crf: int = 30) -> np.ndarray:
    """As they come out of an H.264 file; the higher ``crf``, the smaller and worse."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=int(FPS), options={"crf": str(crf), "preset": "veryfast"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        out.mux(stream.encode())
    file.seek(0)
    with av.open(file) as source:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in source.decode(video=0)])


def written(path: Path, frames: np.ndarray) -> Path:
    """An MP4 file of them."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FPS, frames.shape[2:0:-1])
    for frame in frames:
        video.write(frame[..., ::-1])
    video.release()
    return path


def overlap(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Intersection over union in each picture, (F,); 1 where both are empty."""
    both, either = (found & true).sum(axis=(1, 2)), (found | true).sum(axis=(1, 2))
    return np.where(either, both / np.maximum(either, 1), 1.0)
