"""The Watch tab: the robot live beside the demo, what the trainer does, how it has gone so far."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from markupsafe import Markup
from mjviser import ViserMujocoScene

from onedemo.app.annotation.phases import NAMES, told
from onedemo.app.annotation.scale import ANSWERS
from onedemo.app.services.live_rollout import Moment
from onedemo.app.tabs import charts, progress
from onedemo.app.tabs.context import TabContext
from onedemo.app.templates import render
from onedemo.errors import UserError
from onedemo.render.stage import beside
from onedemo.render.studio import colours_of
from onedemo.robots.camera import Camera, visible_geoms
from onedemo.robots.robot import Robot
from onedemo.storage.rating_counts import Counts
from onedemo.types import HALTED, Status

_DEMO_HZ = 15.0
"""How often the demo's frame is exchanged; the robot moves twice as often."""
_CONFIRM_SECONDS = 5.0
_APART_SECONDS = 0.1
"""If the demo is further from the robot's own time than this, both times are told."""
_CAMERA_FOV, _HIGHER = 45.0, 0.14
"""A little wider than in the clips, and so much higher of the robot's size, metres; the mouse turns it."""
_DEEPER = 1.45
"""Exponent of a limb's colour: the browser's tone mapping makes colours paler than they are in clips."""


class Watch:
    """The Watch tab of one session."""

    title = "Watch"

    def __init__(self, context: TabContext) -> None:
        self._context, self._client = context, context.client
        self._training, self._store, self._run = context.training, context.store, context.run
        self._live, self._demo, self._version = context.live, context.demo, context.version
        self._lock = threading.RLock()
        self._scene: ViserMujocoScene | None = None
        self._frame = -1
        self._practised = False
        self._newest = 0
        self._filmed: int | None = None
        self._film: Future[Path] | None = None
        self._confirm_until = 0.0
        self._commands: list[Any] = []
        self._shown = False
        self._content: dict[int, str] = {}
        gui = context.client.gui
        self._strip = gui.add_html("")
        gui.add_html(str(render("watch.html:robot")))
        self._picture = gui.add_html("")
        self._time = gui.add_html("")
        gui.add_html(str(render("watch.html:reset")))
        frames = [frame_address(n, self._demo.sha256) for n in range(self._demo.frames)]
        gui.add_html(str(render("watch.html:preload", sources=frames)))
        gui.add_html(str(charts.run_html(self._run, has_reward=bool(self._demo.task))))
        self._below = gui.add_html("")
        gui.add_html(str(render("watch.html:gallery", run=self._run, version=self._version)))
        gui.add_html(str(render("watch.html:film")))
        self._put(self._picture, frame_html(0, self._demo.sha256))
        self._put(self._time, time_html(0, 0, self._demo.seconds, ""))

    def show(self) -> None:
        """Starts the live robot and the keys."""
        with self._lock:
            self._shown = True
            if self._scene is None:
                self._build_scene()
            self._live.watch(self._client.client_id, self._draw)
            self._key("Pause or resume training", "P", self._toggle)
            self._key("Stop training", "X", self._stop)
            self._key("Reset the view of the robot", "R", self._look)
            self.refresh(self._training.status())

    def hide(self) -> None:
        """Stops them."""
        with self._lock:
            self._shown = False
            self._live.leave(self._client.client_id)
            for command in self._commands:
                command.remove()
            self._commands.clear()

    def refresh(self, status: Status) -> None:
        """Counters and curves."""
        with self._lock:
            if not self._shown:
                return
            self._practised = status.iteration > 0
            store, run = self._store, self._run
            counts = sum(store.ratings.counts(run).values(), Counts())
            strip = render(
                "watch.html:strip", status=status, phase=NAMES[status.phase], told=told(status),
                counts=counts, confirming=time.monotonic() < self._confirm_until,
            )  # fmt: skip
            self._put(self._strip, strip)
            newest = store.runs.last_iteration(run)
            self._film_ahead(newest)
            below = render(
                "watch.html:below", counts=counts,
                timeline=progress.timeline_html(newest, self._demo.seconds),
                classes=render("parts.html:classes", counts=counts.classes, answers=ANSWERS),
            )  # fmt: skip
            self._put(self._below, below)

    def _film_ahead(self, newest: dict | None) -> None:
        """Has the film of the best rollout made while somebody watches, before they ask for it."""
        if newest is None or newest["number"] == self._newest or (self._film and not self._film.done()):
            return
        self._newest = newest["number"]
        best = self._store.runs.best_iteration(self._run)
        if best is None or best == self._filmed:
            return
        self._filmed = best
        with suppress(FileNotFoundError, UserError):  # what cannot be drawn is said to whoever presses
            self._film = self._training.rollout_picture(best, "webm")

    def close(self) -> None:
        """Leaves the live robot."""
        self._live.leave(self._client.client_id)

    # Controls

    def _key(self, label: str, hotkey: Any, action: Any) -> None:
        command = self._client.gui.add_command(label, hotkey=hotkey, modifier="alt")
        command.on_trigger(lambda _: action())
        self._commands.append(command)

    def _toggle(self) -> None:
        if self._training.status().phase in HALTED:
            self._training.resume()
            self._log("resumed the run")
        else:
            self._training.pause()
            self._log("paused the run")
        self.refresh(self._training.status())

    def _stop(self) -> None:
        # Stopping takes a second press: it cannot be taken back from here.
        with self._lock:
            sure = time.monotonic() < self._confirm_until
            self._confirm_until = 0.0 if sure else time.monotonic() + _CONFIRM_SECONDS
        if sure:
            self._log("stopped the run")
            self._training.stop(timeout_s=0)  # within its iteration it is shown to be stopping
        self.refresh(self._training.status())

    def _log(self, what: str) -> None:
        self._store.audit.add(self._context.rater.name, what, self._run)

    # The robot

    def _build_scene(self) -> None:
        camera = self._live.robot.camera
        # A model of its own, as the scene writes into it; without the floor, which is drawn calmer here.
        scene = ViserMujocoScene(self._client, drawn_model(self._live.robot), num_envs=1)  # type: ignore[arg-type]
        scene.camera_tracking_enabled = False
        # Two lamps instead of an environment map, whose shaders hold a browser without a GPU for seconds.
        shown = self._client.scene
        shown.configure_environment_map(None)
        shown.configure_default_lights(False)
        shown.add_light_directional("/lights/key", intensity=3.2, position=(0.5, -1.5, 4.0), cast_shadow=True)
        shown.add_light_directional("/lights/fill", intensity=1.6, position=(-1.5, -4.0, -1.0))
        shown.add_grid(
            "/fixed_bodies/floor",
            infinite_grid=True,
            cell_size=0.5 * camera.unit,
            section_size=camera.unit,
            cell_color=(206, 214, 223),
            section_color=(182, 193, 205),
            fade_distance=22.0 * camera.unit,
            shadow_opacity=0.22,
            plane_opacity=0.0,
            position=(0.0, 0.0, camera.floor),
        )
        self._scene = scene
        self._look()

    def _look(self) -> None:
        """Looks at the robot as the demonstration does."""
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction, camera.position, camera.look_at = view_of(self._live.robot.camera)
            camera.fov = math.radians(_CAMERA_FOV)

    def _draw(self, moment: Moment) -> None:
        scene = self._scene
        if scene is None:
            return
        with self._client.atomic():
            scene.update_from_arrays(moment.xpos[None], moment.xmat[None])
            scene.fixed_bodies_frame.position = tuple(-moment.place)
            frame = min(int(moment.demo_seconds * self._demo.fps), self._demo.frames - 1)
            if frame // max(1, round(self._demo.fps / _DEMO_HZ)) != self._frame:
                self._frame = frame // max(1, round(self._demo.fps / _DEMO_HZ))
                self._put(self._picture, frame_html(frame, self._demo.sha256))
                note = "" if moment.acting and self._practised else _UNPRACTISED
                where = time_html(moment.demo_seconds, moment.seconds, self._demo.seconds, note)
                self._put(self._time, where)
        self._client.flush()

    def _put(self, handle: Any, content: Markup) -> None:
        if self._content.get(id(handle)) != content:
            handle.content = self._content[id(handle)] = str(content)


_UNPRACTISED = "The robot has not practised yet."


def frame_html(frame: int, sha256: str) -> Markup:
    """One frame of the demo."""
    return render("watch.html:frame", source=frame_address(frame, sha256))


def frame_address(frame: int, sha256: str) -> str:
    """Where a frame of a demo is; another demo's are elsewhere, as browsers keep them."""
    return f"demo/frames/{frame}.jpg?v={sha256[:8]}"


def time_html(demo_seconds: float, seconds: float, length: float, note: str) -> Markup:
    """How far along the demo the robot is.

    Args:
        demo_seconds: There, in the demo.
        seconds: Since the robot began; said if the demo has not moved on as fast.
        length: Of the demo, seconds.
        note: One sentence below it.
    """
    return render(
        "watch.html:time", percent=100 * min(1.0, demo_seconds / length) if length else 0.0,
        demo_seconds=demo_seconds, length=length, note=note,
        attempt=seconds if abs(seconds - demo_seconds) >= _APART_SECONDS else None,
    )  # fmt: skip


def view_of(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From where the live robot is seen, but for its place as far as a camera follows it.

    Returns:
        The direction up, the camera's place and what it looks at, (3,) each.
    """
    right, up, _ = axes = np.eye(3)[[camera.right, camera.up, 2]]
    target = camera.middle * right + camera.depth * np.abs(camera.forward)
    if camera.up == 2:
        target = target + (camera.height + _HIGHER * camera.size + camera.floor) * axes[2]
    elif not camera.follows:
        target = target + camera.height * up
    return up, target - camera.distance * camera.forward, target


def drawn_model(robot: Robot) -> mujoco.MjModel:
    """The robot without its floor, each limb in the colour it has in the clips."""
    model = mujoco.MjModel.from_xml_path(str(robot.xml))
    floor = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_type[floor] = mujoco.mjtGeom.mjGEOM_SPHERE  # where a plane is, mjviser puts a floor of its own
    seen = visible_geoms(model)
    seen = seen[~floor[seen]]
    colours = colours_of(robot, model)
    if (apart := beside(robot, model)) is not None:
        model.geom_pos += apart
    model.geom_matid[:], model.geom_rgba[:, 3] = -1, 0
    model.geom_group[seen], model.site_group[:] = 0, 5
    for geom in seen:
        model.geom_rgba[geom] = in_this_light(colours[geom].tolist())
    return model


def in_this_light(colour: Sequence[float]) -> list[float]:
    """A colour as it must be for the live view to look like a clip: RGB to RGBA, 0..1."""
    return [*(part**_DEEPER for part in colour), 1.0]
