"""The Watch tab: the robot live beside the demo, what the trainer does, how it has gone so far."""

from __future__ import annotations

import math
import threading
import time
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
from mjviser import ViserMujocoScene

from onedemo.app.services.demo_images import version_of
from onedemo.app.services.live_rollout import Moment
from onedemo.app.ui import charts, progress
from onedemo.app.ui.strings import nobody_html
from onedemo.types import HALTED, Status

if TYPE_CHECKING:
    from onedemo.app.ui.session import Session

_DEMO_HZ = 15.0
"""How often the demo's frame is exchanged; the robot moves twice as often."""
_CONFIRM_SECONDS = 5.0
_APART_SECONDS = 0.1
"""If the demo is further from the robot's own time than this, both times are told."""
# As in the clips, so that robot and demo have one scale; the mouse turns it.
_CAMERA_POSITION = (0.0, -3.0, 1.02)
_CAMERA_TARGET = (0.0, 0.0, 1.02)
_CAMERA_FOV = 45.0
_LIMBS = ((0.91, 0.29, 0.17, 1.0), (0.13, 0.25, 0.47, 1.0), (0.20, 0.48, 0.76, 1.0), (0.97, 0.69, 0.15, 1.0))

_PHASES = {
    "starting": "Starting",
    "pretrain": "Waiting for ratings",
    "online": "Learning",
    "paused": "Paused",
    "done": "Done",
    "stopped": "Stopped",
    "failed": "Failed",
}


class Watch:
    """The Watch tab of one session."""

    title = "Watch"

    def __init__(self, session: Session) -> None:
        self._session = session
        self._client = session.client
        self._trainer = session.page.trainer
        self._live = session.page.live
        self._demo = self._trainer.demo
        self._version = version_of(self._trainer.store, self._trainer.run)
        self._lock = threading.RLock()
        self._scene: ViserMujocoScene | None = None
        self._frame = -1
        self._practised = False
        self._confirm_until = 0.0
        self._commands: list[Any] = []
        self._shown = False
        self._content: dict[int, str] = {}
        gui = session.client.gui
        self._strip = gui.add_html("")
        gui.add_html(_ROBOT)
        self._picture = gui.add_html("")
        self._time = gui.add_html("")
        self._parts = gui.add_html(progress.timeline_html([], self._demo.seconds))
        gui.add_html(_preload(self._demo.frames, self._demo.sha256))
        self._charts = charts.Charts(gui, has_reward=bool(self._demo.task), dark=session.dark)
        self._classes = gui.add_html("")
        self._gallery = gui.add_html("")
        gui.add_html(progress.PLAYER)
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
            self.refresh(self._trainer.status())

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
            store, run = self._trainer.store, self._trainer.run
            nobody = nobody_html(sum(store.ratings.by_class(run)), store.ratings.count_for_training(run))
            self._put(self._strip, strip_html(status, time.monotonic() < self._confirm_until) + nobody)
            new = self._trainer.store.runs.iterations(self._trainer.run, after=self._charts.last)
            self._charts.extend(new)
            if new:
                self._put(self._parts, progress.timeline_html(self._charts.rows, self._demo.seconds))
                self._put(self._gallery, progress.gallery_html(self._charts.rows, self._version))
            self._put(
                self._classes, charts.classes_html(self._trainer.store.ratings.by_class(self._trainer.run))
            )

    def close(self) -> None:
        """Leaves the live robot."""
        self._live.leave(self._client.client_id)

    # Controls

    def _key(self, label: str, hotkey: Any, action: Any) -> None:
        command = self._client.gui.add_command(label, hotkey=hotkey, modifier="alt")
        command.on_trigger(lambda _: action())
        self._commands.append(command)

    def _toggle(self) -> None:
        if self._trainer.status().phase in HALTED:
            self._trainer.resume()
            self._log("resumed the run")
        else:
            self._trainer.pause()
            self._log("paused the run")
        self.refresh(self._trainer.status())

    def _stop(self) -> None:
        # Stopping takes a second press: it cannot be taken back from here.
        with self._lock:
            sure = time.monotonic() < self._confirm_until
            self._confirm_until = 0.0 if sure else time.monotonic() + _CONFIRM_SECONDS
        if sure:
            self._log("stopped the run")
            self._trainer.stop()
        self.refresh(self._trainer.status())

    def _log(self, what: str) -> None:
        self._trainer.store.audit.add(self._session.rater.name, what, self._trainer.run)

    # The robot

    def _build_scene(self) -> None:
        # A model of its own, as the scene writes into it; without the floor, which is drawn calmer here.
        scene = ViserMujocoScene(self._client, drawn_model(self._live.model_path), num_envs=1)  # type: ignore[arg-type]
        scene.camera_tracking_enabled = False
        self._client.scene.add_grid(
            "/fixed_bodies/floor",
            infinite_grid=True,
            cell_size=0.5,
            section_size=1.0,
            cell_color=(206, 214, 223),
            section_color=(182, 193, 205),
            fade_distance=22.0,
            shadow_opacity=0.22,
            plane_opacity=0.0,
        )
        camera = self._client.camera
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.position = _CAMERA_POSITION
        camera.look_at = _CAMERA_TARGET
        camera.fov = math.radians(_CAMERA_FOV)
        self._scene = scene

    def _draw(self, moment: Moment) -> None:
        scene = self._scene
        if scene is None:
            return
        with self._client.atomic():
            scene.update_from_arrays(moment.xpos[None], moment.xmat[None])
            scene.fixed_bodies_frame.position = (-moment.x, 0.0, 0.0)
            frame = min(int(moment.demo_seconds * self._demo.fps), self._demo.frames - 1)
            if frame // max(1, round(self._demo.fps / _DEMO_HZ)) != self._frame:
                self._frame = frame // max(1, round(self._demo.fps / _DEMO_HZ))
                self._put(self._picture, frame_html(frame, self._demo.sha256))
                note = "" if moment.acting and self._practised else _UNPRACTISED
                where = time_html(moment.demo_seconds, moment.seconds, self._demo.seconds, note)
                self._put(self._time, where)
        self._client.flush()

    def _put(self, handle: Any, content: str) -> None:
        if self._content.get(id(handle)) != content:
            self._content[id(handle)] = content
            handle.content = content


_UNPRACTISED = "The robot has not practised yet: it needs ratings first."
_ROBOT = '<figure class="od-view od-robot"><figcaption>Robot, live</figcaption><div></div></figure>'


def strip_html(status: Status, confirming: bool) -> str:
    """What the trainer does, in figures, and its controls."""
    running = status.phase in ("starting", "pretrain", "online")
    figures = [
        ("Method", escape(status.method) or "–", ""),
        ("Iteration", f"{status.iteration:,}", ""),
        ("Steps", f"{charts.short(status.env_steps)}", f"of {charts.short(status.total_steps)}"),
        ("Speed", f"{status.steps_per_s:,.0f}", "steps/s"),
        ("Predictor", f"No. {status.snapshot}" if status.snapshot else "–", ""),
        ("Ratings", f"{status.ratings}", f"of {status.target_ratings}"),
    ]
    cells = "".join(f"<div><dt>{n}</dt><dd>{v} <small>{u}</small></dd></div>" for n, v, u in figures)
    toggle = "Pause" if running else "Try again" if status.phase == "failed" else "Resume"
    no_toggle = " disabled" if status.phase == "done" else ""
    no_stop = " disabled" if status.phase in ("done", "stopped") else ""
    stop = "Press again to stop" if confirming else "Stop"
    return (
        f'<div class="od-strip"><div class="od-state" data-phase="{escape(status.phase)}">'
        f"<b>{_PHASES.get(status.phase, escape(status.phase))}</b><span>{escape(status.message)}</span></div>"
        f'<dl class="od-figures">{cells}</dl><div class="od-controls">'
        f'<button type="button" class="od-button" data-key="alt+p"{no_toggle}>{toggle}</button>'
        f'<button type="button" class="od-button od-danger" data-key="alt+x"{no_stop}>{stop}</button>'
        "</div></div>"
    )


def frame_html(frame: int, sha256: str) -> str:
    """One frame of the demo; ``decoding=sync`` paints it without a gap."""
    return (
        '<figure class="od-view od-demonstration"><figcaption>Demonstration</figcaption>'
        f'<div><img src="{frame_address(frame, sha256)}" alt="" decoding="sync"></div></figure>'
    )


def frame_address(frame: int, sha256: str) -> str:
    """Where a frame of a demo is; another demo's are elsewhere, as browsers keep them."""
    return f"/demo/frames/{frame}.jpg?v={sha256[:8]}"


def time_html(demo_seconds: float, seconds: float, length: float, note: str) -> str:
    """How far along the demo the robot is.

    Args:
        demo_seconds: There, in the demo.
        seconds: Since the robot began; said if the demo has not moved on as fast.
        length: Of the demo, seconds.
        note: One sentence below it.
    """
    share = min(1.0, demo_seconds / length) if length else 0.0
    taken = f", {seconds:.1f} s into the attempt" if abs(seconds - demo_seconds) >= _APART_SECONDS else ""
    return (
        f'<div class="od-time"><i><i style="width:{100 * share:.1f}%"></i></i>'
        f"<span>Video at {demo_seconds:.1f} s of {length:.1f} s{taken}</span><em>{note}</em></div>"
    )


def _preload(frames: int, sha256: str) -> str:
    # Once fetched they stay in the browser's memory as long as these elements are there.
    images = "".join(f'<img src="{frame_address(n, sha256)}" alt="">' for n in range(frames))
    return f'<div class="od-preload" aria-hidden="true">{images}</div>'


def drawn_model(path: Path) -> mujoco.MjModel:
    """The robot without its floor, each limb in the colour it has in the clips."""
    spec = mujoco.MjSpec.from_file(str(path))
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            spec.delete(geom)
    model = spec.compile()
    for geom in range(model.ngeom):
        model.geom_matid[geom] = -1
        model.geom_rgba[geom] = _LIMBS[min(geom, len(_LIMBS) - 1)]
    return model
