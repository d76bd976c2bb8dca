"""One control step of many robots: MuJoCo's threads on the processor, or MuJoCo Warp on a GPU.

Shapes: N lanes, a actions, S = 1 + q + v: time, positions and velocities (and what motors remember).
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np
from mujoco import rollout

from onedemo.robots.robot import compiled
from onedemo.sim import physics_profiling

_FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL.value)


def load_model(xml: Path) -> mujoco.MjModel:
    """The robot's model as it is stepped.

    A robot alone is one island of constraints: looking for islands is switched off, which changes no bit
    of what comes out and makes physics 1.08 times as fast. With things beside it that move it stays on.

    Args:
        xml: The robot's MJCF file.
    """
    model = compiled(xml)
    flag = getattr(mujoco.mjtDisableBit, "mjDSBL_ISLAND", None)  # MuJoCo before 4 does not look by itself
    if flag is not None and model.ntree <= 1:
        model.opt.disableflags |= flag.value
    return model


class Physics(Protocol):
    """What moves the lanes: rigid-body dynamics with no memory besides the states it is given."""

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """One control step of every lane, the same action held through its physics steps.

        Args:
            states: (time, qpos, qvel), (N, S), float64; not changed.
            actions: (N, a), float64; the motors clamp them.

        Returns:
            The states after it, (N, S), float64, a fresh array.
        """
        ...

    def close(self) -> None:
        """Frees threads or device memory."""
        ...


class RolloutPhysics:
    """``Physics`` on MuJoCo's own C++ thread pool, in float64.

    Args:
        model: The robot.
        frame_skip: Physics steps in a control step.
        num_envs: Lanes.
        nthread: Threads beside the caller's; 0 for none.

    Switches MuJoCo's profiling off in this process (``physics_profiling``).
    """

    def __init__(self, model: mujoco.MjModel, frame_skip: int, num_envs: int, nthread: int) -> None:
        physics_profiling.switch_off()
        self._models = [model] * num_envs
        self._frame_skip = frame_skip
        self._data = [mujoco.MjData(model) for _ in range(max(nthread, 1))]
        self._pool = rollout.Rollout(nthread=nthread)
        # One piece of the lanes for each thread: handing out smaller ones costs more than it evens out.
        self._chunk = -(-num_envs // max(nthread, 1))
        self._substeps = np.empty((num_envs, frame_skip, mujoco.mj_stateSize(model, _FULL)))
        self._control = np.empty((num_envs, frame_skip, model.nu))

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """See ``Physics.step``."""
        self._control[:] = actions[:, None]
        # Unchecked: shapes are right by construction, and the checks cost as much as the rest of a step.
        self._pool.rollout(
            self._models, self._data, states, self._control, control_spec=_CONTROL,
            skip_checks=True, nstep=self._frame_skip, state=self._substeps, chunk_size=self._chunk,
        )  # fmt: skip
        return self._substeps[:, -1].copy()

    def close(self) -> None:
        """Ends the threads."""
        self._pool.close()


def make_physics(kind: str, model: mujoco.MjModel, frame_skip: int, num_envs: int, nthread: int) -> Physics:
    """The physics of that kind, "mujoco" or "warp" (which chooses its threads itself).

    Raises:
        UserError: If the extra ``warp`` is not installed.
        ValueError: If there is no such kind.
    """
    if kind == "mujoco":
        return RolloutPhysics(model, frame_skip, num_envs, nthread)
    if kind == "warp":
        from onedemo.sim.warp_physics import WarpPhysics

        return WarpPhysics(model, frame_skip, num_envs)
    raise ValueError(f"physics must be 'mujoco' or 'warp', got {kind!r}")
