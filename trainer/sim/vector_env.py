"""Batched MuJoCo environments behind ``gymnasium.vector.VectorEnv``, and the registry of them.

All lanes are stepped by one call, into MuJoCo's C++ thread pool (``mujoco.rollout``) or into the
optional ``trainer/sim/warp_physics.py``; nothing here loops over lanes in Python. A lane's whole physical
state is (time, qpos, qvel), and what the motors remember: the contact solver's warm start is cleared before
each control step, so a state that was saved and put back goes on exactly as it would have.

That is the one difference from gymnasium's environments of the same robots, which keep the warm start from
step to step (``mujoco.rollout`` takes one and gives none back). With theirs cleared, too, 300 steps of each
robot agree to the last bit. As they ship, one step differs by rounding, which those robots amplify that
tumble: after 50 and 300 steps of random actions observations differ by 3e-15 and 1e-12 (hopper), 2e-13 and
1e-9 (walker2d), 2e-16 and 2e-14 (swimmer), but 5e-10 and 6 (half-cheetah), 6e-11 and 3 (ant) and, as its
solver stops after 50 iterations of a slow kind, 8e-6 and 5 (humanoid).

Shapes: N lanes, o observations, a actions, q positions, v velocities, S = 1 + q + v, or more where motors
remember.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from onedemo.core.cpu import cores
from onedemo.robots.registry import robot_named
from onedemo.robots.robot import Robot
from onedemo.sim.physics import load_model, make_physics

_FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
_FASTEST = 1e4
"""Velocities beyond it, m/s and rad/s, are of no robot: the physics has become unstable."""
_BEGIN = 1.0
"""Time at which episodes begin, s. MuJoCo puts a robot whose physics became unstable back to time 0."""


def make(
    name: str,
    num_envs: int,
    *,
    horizon: int | None = None,
    nthread: int | None = None,
    physics: str = "mujoco",
    terminate_when_unhealthy: bool = False,
) -> RobotVectorEnv:
    """Makes N lanes of the robot of that name. Options as for ``RobotVectorEnv``.

    Raises:
        UserError: If the robot is unknown, or the physics is not installed.
        ValueError: If an option is out of range.
    """
    return RobotVectorEnv(
        robot_named(name),
        num_envs,
        horizon=horizon,
        nthread=nthread,
        physics=physics,
        terminate_when_unhealthy=terminate_when_unhealthy,
    )


class RobotVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N lanes of a robot: its observations and gymnasium's reward, episodes of fixed length.

    Falling does not end an episode: the stock limit of a hopper's lean would end any flip. Lanes that end
    restart within the same step (``AutoresetMode.SAME_STEP``); ``infos`` then holds ``final_obs``,
    ``final_qpos`` and ``final_qvel`` of all lanes as they were before the restart, each with the
    mask ``_final_...`` of the lanes that ended. A lane whose physics becomes unstable (numbers without end,
    contacts without room) terminates in the last state that was sound, whatever the options say.

    Args:
        robot: The robot.
        num_envs: Lanes.
        horizon: Control steps in an episode; the robot's own if None.
        nthread: Physics threads; as many as this process may use if None, none beside the
            caller's if 0. Of "mujoco" only.
        physics: "mujoco", on the processor's cores, or "warp", on a GPU (``trainer/sim/warp_physics.py``).
        terminate_when_unhealthy: End an episode on a fall, as gymnasium does (for baselines).

    Raises:
        ValueError: If an option is out of range.
        UserError: If the physics is not installed.
    """

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        *,
        horizon: int | None = None,
        nthread: int | None = None,
        physics: str = "mujoco",
        terminate_when_unhealthy: bool = False,
    ) -> None:
        self.robot = robot
        self.num_envs = num_envs
        self.horizon = robot.horizon if horizon is None else horizon
        self.dt = robot.dt
        self.terminate_when_unhealthy = terminate_when_unhealthy
        if nthread is None:
            nthread = min(cores(), num_envs)
        if num_envs < 1 or self.horizon < 1 or nthread < 0:
            raise ValueError(
                "num_envs and horizon must be at least 1 and nthread at least 0, "
                f"got {num_envs}, {self.horizon} and {nthread}"
            )
        self.metadata = {
            "render_modes": [],
            "autoreset_mode": AutoresetMode.SAME_STEP,
            "render_fps": round(1 / self.dt),
        }
        self.model = load_model(robot.xml)
        self._physics = make_physics(physics, self.model, robot.frame_skip, num_envs, nthread)
        self._initial = np.empty(mujoco.mj_stateSize(self.model, _FULL))
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), self._initial, _FULL)
        self._initial[0] = _BEGIN
        self._initial[1 : 1 + self.model.nq] = robot.rest
        self._least = self.dt - robot.timestep / 2  # of a whole control step, seconds
        self._state = np.tile(self._initial, (num_envs, 1))
        self._positions = slice(1, 1 + self.model.nq)
        self._velocities = slice(1 + self.model.nq, 1 + self.model.nq + self.model.nv)
        low, high = np.array(robot.low), np.array(robot.high)
        # Where an action is the command, and the motors clamp it, there is nothing to do.
        self._as_commanded = bool(
            (low == -1).all() and (high == 1).all() and self.model.actuator_ctrllimited.all()
        )
        self._middle, self._reach = (low + high) / 2, (high - low) / 2
        self.elapsed = np.zeros(num_envs, np.int32)
        """Control steps since each lane's episode began, (N,)."""
        self.unstable = 0
        """Episodes that ended because their physics became unstable, of all lanes so far."""
        self._limit = np.full(num_envs, self.horizon, np.int32)
        inf, one = np.inf, np.float32(1)
        self.single_observation_space = gymnasium.spaces.Box(-inf, inf, (robot.obs_size,), np.float64)
        self.single_action_space = gymnasium.spaces.Box(-one, one, (robot.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def qpos(self) -> np.ndarray:
        """Positions now, a copy, (N, q), metres and radians."""
        return self._state[:, self._positions].copy()

    @property
    def qvel(self) -> np.ndarray:
        """Velocities now, a copy, (N, v), metres/s and radians/s."""
        return self._state[:, self._velocities].copy()

    @property
    def obs(self) -> np.ndarray:
        """Observations now, (N, o)."""
        return self.robot.observe(self._state[:, self._positions], self._state[:, self._velocities])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts new episodes from the standard reset.

        One lane with a seed starts exactly where gymnasium's environment starts with that seed.

        Args:
            seed: Seeds the one generator of all lanes.
            options: ``{"reset_mask": bool array (N,)}`` resets only those lanes.
                ``{"stagger": True}`` shortens the first episode of lane i to
                ``horizon * (N - i) / N`` steps, so that later batches shorter than the horizon
                see every part of the episode.

        Returns:
            Observations, (N, o), and an empty dictionary.

        Raises:
            ValueError: On an unknown option or a mask of the wrong shape.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        stagger = bool(options.pop("stagger", False))
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        if options or mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"reset takes stagger and reset_mask, a bool array ({self.num_envs},); "
                f"got {sorted(options)} and {mask.dtype} {mask.shape}"
            )
        self._restart(np.flatnonzero(mask))
        if stagger:
            lanes = np.arange(self.num_envs, 0, -1)
            self._limit[:] = np.ceil(self.horizon * lanes / self.num_envs)
        return self.obs, {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of every lane.

        Args:
            actions: (N, a), in -1..1. What lies beyond is clamped by the motors, but costs, as in
                gymnasium.

        Returns:
            Observations (N, o), gymnasium's rewards (N,), terminated (N,), truncated (N,), infos.

        Raises:
            ValueError: If the actions have the wrong shape.
        """
        actions = np.asarray(actions, np.float64)
        if actions.shape != (self.num_envs, self.robot.action_size):
            raise ValueError(f"actions must be {self.action_space.shape}, got {actions.shape}")
        commands = actions if self._as_commanded else self._middle + self._reach * actions.clip(-1, 1)
        before = self._state
        self._state = self._physics.step(before, commands)
        lost = self._lost(before)
        self.elapsed += 1
        qpos, qvel = self._state[:, self._positions], self._state[:, self._velocities]
        stock, upright = self.robot.stock, self.robot.healthy(qpos, qvel)
        rewards = stock.healthy * upright - stock.control * np.square(commands).sum(-1)
        if self.robot.across is not None:
            place = 1 + self.robot.across
            rewards += stock.forward * (self._state[:, place] - before[:, place]) / self.dt
        terminated = lost | ~upright if self.terminate_when_unhealthy else lost
        truncated = (self.elapsed >= self._limit) & ~terminated
        infos: dict[str, Any] = {}
        ended = terminated | truncated
        if ended.any():
            infos = {"final_obs": self.obs, "final_qpos": self.qpos, "final_qvel": self.qvel}
            infos |= {f"_{key}": ended.copy() for key in infos}
            self._restart(np.flatnonzero(ended))
        return self.obs, rewards, terminated, truncated, infos

    def set_states(
        self,
        lanes: np.ndarray,
        qpos: np.ndarray,
        qvel: np.ndarray,
        elapsed: np.ndarray | None = None,
    ) -> None:
        """Puts chosen lanes into given states.

        Args:
            lanes: K lane numbers, (K,).
            qpos: Positions, (K, q), metres and radians.
            qvel: Velocities, (K, v), metres/s and radians/s.
            elapsed: Control steps that count as gone in the episode, (K,); kept if None.

        Raises:
            ValueError: If the shapes disagree or a state is not finite.
        """
        lanes = np.asarray(lanes, np.intp)
        state = np.concatenate([np.atleast_2d(qpos), np.atleast_2d(qvel)], axis=1)
        width = self.robot.positions + self.robot.velocities
        if state.shape != (len(lanes), width) or not np.isfinite(state).all():
            raise ValueError(
                f"{len(lanes)} lanes need finite positions and velocities, "
                f"({len(lanes)}, {width}) together, got {state.shape}"
            )
        self._state[lanes, 1 : 1 + width] = state
        self._state[lanes, 1 + width :] = self._initial[1 + width :]  # what the motors remember
        if elapsed is not None:
            self.elapsed[lanes] = elapsed

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed training needs: arrays, and the generator as plain numbers."""
        return {
            "state": self._state.copy(),
            "elapsed": self.elapsed.copy(),
            "limit": self._limit.copy(),
            "rng": self.np_random.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken.

        Raises:
            ValueError: If the state is of another number of lanes or another robot.
        """
        physics = np.array(state["state"], np.float64)
        if physics.shape != self._state.shape:
            raise ValueError(f"the saved state is {physics.shape}, not {self._state.shape}")
        self._state = physics
        self.elapsed = np.array(state["elapsed"], np.int32)
        self._limit = np.array(state["limit"], np.int32)
        self.np_random.bit_generator.state = state["rng"]

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the physics: threads or device memory."""
        self._physics.close()

    def _lost(self, before: np.ndarray) -> np.ndarray:
        """The lanes whose last step was not sound, (N,): they are put back to where they were before it."""
        moved, took = self._state[:, self._velocities], self._state[:, 0] - before[:, 0]
        # The usual case, quickly; what is no number is neither less nor more.
        if took.min() > self._least and moved.max() < _FASTEST and moved.min() > -_FASTEST:
            return np.zeros(self.num_envs, bool)
        lost = ~((took > self._least) & (np.abs(moved).max(axis=1) < _FASTEST))
        self._state[lost] = before[lost]
        self.unstable += int(lost.sum())
        return lost

    def _restart(self, lanes: np.ndarray) -> None:
        noise, robot = self.robot.start, self.robot
        self._state[lanes] = self._initial
        shape = (len(lanes), robot.positions + robot.velocities)
        if noise.normal:
            spread = np.concatenate([
                self.np_random.uniform(-noise.positions, noise.positions, (len(lanes), robot.positions)),
                noise.velocities * self.np_random.standard_normal((len(lanes), robot.velocities)),
            ], axis=1)  # fmt: skip
        else:
            ends = np.repeat([noise.positions, noise.velocities], [robot.positions, robot.velocities])
            spread = self.np_random.uniform(-ends, ends, shape)
        self._state[lanes, 1 : 1 + shape[1]] += spread
        self.elapsed[lanes] = 0
        self._limit[lanes] = self.horizon
