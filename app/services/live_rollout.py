"""The robot acting with the newest policy, in real time, for everybody who watches.

The demo beside it is where the run's rules put it: where the demo phase adapts to the robot, so it does
here, as in practice. One thread simulates one robot and hands each state to all watchers;
while nobody watches it sleeps. It keeps no state that training could see.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from onedemo.rl.rollouts import Acting
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.robots.robot import Robot, body_name, model_of
from onedemo.sim.vector_env import RobotVectorEnv

log = logging.getLogger("onedemo.page")

_BEHIND_SECONDS = 0.25
"""If it falls behind by more than this it drops the rest rather than run after it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Moment:
    """What a watcher draws."""

    xpos: np.ndarray
    """Positions of the bodies, (bodies, 3), metres; the robot's own place on the floor is taken out."""
    xmat: np.ndarray
    """Their orientations, (bodies, 3, 3)."""
    place: np.ndarray
    """Where the robot is on the floor, (3,), metres; 0 on each axis on which no camera follows it."""
    demo_seconds: float
    """How far along the demo it is."""
    seconds: float
    """Since the episode began."""
    acting: bool
    """Whether a policy acts, or the robot stands because there is none yet."""


Watcher = Callable[[Moment], None]


class Live:
    """The live robot of one run.

    Args:
        acting: Gives what acts in the next episode, or None while there is nothing.
        seconds: Length of an episode: the demo's.
        robot: Which; the hopper if None.
        frames_per_second: How often watchers are called.
    """

    def __init__(
        self, acting: Callable[[], Acting | None], seconds: float, robot: Robot | None = None,
        *, frames_per_second: float = 30.0,
    ) -> None:  # fmt: skip
        self._acting = acting
        self.robot = robot or robot_named(DEFAULT)
        self._dt = self.robot.dt
        self._horizon = max(1, round(seconds / self._dt))
        self._pause = 1 / frames_per_second
        self._watchers: dict[object, Watcher] = {}
        self._wake = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="onedemo-live", daemon=True)
        self._thread.start()

    def watch(self, key: object, watcher: Watcher) -> None:
        """Calls ``watcher`` ``frames_per_second`` times a second, from the live thread, until ``leave``."""
        with self._wake:
            self._watchers[key] = watcher
            self._wake.notify()

    def leave(self, key: object) -> None:
        """Ends ``watch``."""
        with self._wake:
            self._watchers.pop(key, None)

    def close(self) -> None:
        """Ends the thread."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(timeout=5)

    def _run(self) -> None:
        # One step more than an episode has: it is begun anew here, not by the environment.
        env = RobotVectorEnv(self.robot, 1, horizon=self._horizon + 1, nthread=0)
        model = model_of(self.robot.xml)
        data = mujoco.MjData(model)
        obs, _ = env.reset(seed=0)
        acting: Acting | None = None
        clock, elapsed = np.zeros(1, np.int32), 0
        due = time.monotonic()
        while True:
            with self._wake:
                while not self._watchers and not self._closing:
                    self._wake.wait()
                    due = time.monotonic()
                if self._closing:
                    return
                watchers = list(self._watchers.values())
            if acting is None and (acting := self._acting()) is not None:
                clock, elapsed = np.zeros(1, np.int32), 0
            for _ in range(steps_due(time.monotonic() - due, self._dt)):
                due += self._dt
                if acting is None:  # the demo plays alone
                    clock, elapsed = (clock + 1) % self._horizon, (elapsed + 1) % self._horizon
                    continue
                step, clock = acting.step(env, obs, clock)
                obs, elapsed = step.next_obs, elapsed + 1
                if max(elapsed, clock[0]) >= self._horizon:
                    obs, _ = env.reset()
                    acting = self._acting()  # the same for a whole episode
                    clock, elapsed = np.zeros(1, np.int32), 0
            if time.monotonic() - due > self._dt:
                due = time.monotonic()
            moment = self._moment(env.qpos[0], model, data, int(clock[0]), elapsed, acting is not None)
            for watcher in watchers:
                try:
                    watcher(moment)
                except Exception:
                    log.exception("a watcher could not be served")
            time.sleep(max(0.005, self._pause - max(0.0, time.monotonic() - due)))

    def _moment(
        self, qpos: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData, clock: int, elapsed: int,
        acting: bool,
    ) -> Moment:  # fmt: skip
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        place = followed(self.robot) * data.subtree_com[_root(model, self.robot)]
        xpos = data.xpos.copy()
        xpos[1:] -= place
        return Moment(
            xpos=xpos,
            xmat=data.xmat.reshape(-1, 3, 3).copy(),
            place=place,
            demo_seconds=clock * self._dt,
            seconds=elapsed * self._dt,
            acting=acting,
        )


def followed(robot: Robot) -> np.ndarray:
    """On which world axes a camera follows the robot, (3,): 1 there, else 0; as that of the clips."""
    camera, axes = robot.camera, np.eye(3)
    if not camera.follows:
        return np.zeros(3)
    across = axes[camera.right]
    if camera.up != 2:
        return across + axes[camera.up]
    return across + np.abs(camera.forward) if robot.root == "free" else across


def _root(model: mujoco.MjModel, robot: Robot) -> int:
    """The body whose parts' centre of mass is followed."""
    names = [body_name(model, body) for body in range(model.nbody)]
    return int(model.body_rootid[names.index(robot.limbs[0])])


def steps_due(behind: float, dt: float) -> int:
    """How many control steps to make now.

    Args:
        behind: Seconds between the simulated time and now.
        dt: Seconds per control step.
    """
    return int(min(max(behind, 0.0), _BEHIND_SECONDS) / dt)
