"""Batched MuJoCo environments behind ``gymnasium.vector.VectorEnv``, and the registry of them.

All lanes are stepped by one call, into MuJoCo's C++ thread pool (``mujoco.rollout``) or into the
optional ``trainer/sim/warp_physics.py``; nothing here loops over lanes in Python. A lane's whole physical
state is (time, qpos, qvel): the contact solver's warm start is cleared before each control step, so a
state that was saved and put back goes on exactly as it would have.

Shapes: N lanes, o observations, a actions, q = v positions and velocities, S = 1 + q + v.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from onedemo.core.cpu import cores
from onedemo.errors import UserError
from onedemo.sim.physics import load_model, make_physics

_ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
_FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS.value)


@dataclass(frozen=True, kw_only=True, slots=True)
class EnvSpec:
    """One environment: a planar robot whose first coordinates are x, z and the torso angle.

    Defaults are those of gymnasium's Hopper-v5.
    """

    name: str
    xml: Path
    """The MuJoCo model."""
    obs_size: int
    """Observations: ``qpos[1:]`` and the clipped ``qvel``."""
    action_size: int
    """Motors, each driven in -1..1 (the model clamps)."""
    timestep: float
    """Physics step, seconds (the model's own)."""
    frame_skip: int
    """Physics steps in a control step."""
    horizon: int
    """Control steps in an episode unless asked otherwise."""
    camera: str
    """Camera that follows the robot."""
    velocity_limit: float = 10.0
    """Observed velocities are clipped to +- this, m/s and rad/s."""
    reset_noise: float = 5e-3
    """Half-width of the uniform noise on every position and velocity at a reset."""
    healthy_reward: float = 1.0
    """Reward of a step that ends healthy."""
    control_cost: float = 1e-3
    """Cost of the squared action, per step."""
    healthy_z: tuple[float, float] = (0.7, np.inf)
    """Open range of torso heights that count as healthy, metres."""
    healthy_angle: tuple[float, float] = (-0.2, 0.2)
    """Open range of torso angles that count as healthy, radians."""
    healthy_state: float = 100.0
    """Healthy: every other position and velocity is within +- this."""

    def __post_init__(self) -> None:
        if self.frame_skip < 1 or self.horizon < 1 or self.timestep <= 0:
            raise ValueError(f"{self.name}: frame_skip, horizon and timestep must be positive")

    @property
    def dt(self) -> float:
        """Control step, seconds."""
        return self.timestep * self.frame_skip


SPECS = {
    "hopper": EnvSpec(
        name="hopper",
        xml=_ASSETS / "hopper.xml",
        obs_size=11,
        action_size=3,
        timestep=0.002,
        frame_skip=4,
        horizon=1000,
        camera="track",
    ),
}
"""Every environment onedemo knows. To add one, add an entry."""


def spec(name: str) -> EnvSpec:
    """The environment of that name.

    Raises:
        UserError: If there is none; the message lists those there are.
    """
    if name not in SPECS:
        raise UserError(f"unknown environment {name!r}; choose one of: {', '.join(sorted(SPECS))}")
    return SPECS[name]


def make(
    name: str,
    num_envs: int,
    *,
    horizon: int | None = None,
    nthread: int | None = None,
    physics: str = "mujoco",
    terminate_when_unhealthy: bool = False,
) -> HopperVectorEnv:
    """Makes N lanes of a registered environment. Options as for ``HopperVectorEnv``.

    Raises:
        UserError: If the environment is unknown, or the physics is not installed.
        ValueError: If an option is out of range.
    """
    return HopperVectorEnv(
        num_envs,
        env_spec=spec(name),
        horizon=horizon,
        nthread=nthread,
        physics=physics,
        terminate_when_unhealthy=terminate_when_unhealthy,
    )


def observe(env_spec: EnvSpec, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """The observation of states: everything but x, velocities clipped.

    Args:
        env_spec: The environment.
        qpos: Positions, (..., q), metres and radians.
        qvel: Velocities, (..., v), metres/s and radians/s.

    Returns:
        Observations, (..., o).
    """
    limit = env_spec.velocity_limit
    return np.concatenate([qpos[..., 1:], np.clip(qvel, -limit, limit)], axis=-1)


def healthy(env_spec: EnvSpec, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Whether states are upright by the rule of gymnasium's Hopper-v5.

    Args:
        env_spec: The environment.
        qpos: Positions, (..., q).
        qvel: Velocities, (..., v).

    Returns:
        True where healthy, (...).
    """
    low_z, high_z = env_spec.healthy_z
    low_angle, high_angle = env_spec.healthy_angle
    z, angle = qpos[..., 1], qpos[..., 2]
    limit = env_spec.healthy_state
    inside = np.maximum(np.abs(qpos[..., 2:]).max(-1), np.abs(qvel).max(-1)) < limit
    return inside & (low_z < z) & (z < high_z) & (low_angle < angle) & (angle < high_angle)


class HopperVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N lanes of a planar robot: Hopper-v5's observations and rewards, episodes of fixed length.

    Falling does not end an episode: the stock limit of 0.2 rad would end any flip. Lanes that end
    restart within the same step (``AutoresetMode.SAME_STEP``); ``infos`` then holds ``final_obs``,
    ``final_qpos`` and ``final_qvel`` of all lanes as they were before the restart, each with the
    mask ``_final_...`` of the lanes that ended.

    Args:
        num_envs: Lanes.
        env_spec: The environment; Hopper if not given.
        horizon: Control steps in an episode; the environment's own if None.
        nthread: Physics threads; as many as this process may use if None, none beside the
            caller's if 0. Of "mujoco" only.
        physics: "mujoco", on the processor's cores, or "warp", on a GPU (``trainer/sim/warp_physics.py``).
        terminate_when_unhealthy: End an episode on a fall, as Hopper-v5 does (for baselines).

    Raises:
        ValueError: If an option is out of range.
        UserError: If the physics is not installed.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        env_spec: EnvSpec | None = None,
        horizon: int | None = None,
        nthread: int | None = None,
        physics: str = "mujoco",
        terminate_when_unhealthy: bool = False,
    ) -> None:
        self.env_spec = env_spec or SPECS["hopper"]
        self.num_envs = num_envs
        self.horizon = self.env_spec.horizon if horizon is None else horizon
        self.dt = self.env_spec.dt
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
        self.model = load_model(self.env_spec.xml)
        self._physics = make_physics(physics, self.model, self.env_spec.frame_skip, num_envs, nthread)
        self._initial = np.empty(mujoco.mj_stateSize(self.model, _FULL))
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), self._initial, _FULL)
        self._state = np.tile(self._initial, (num_envs, 1))
        self._positions = slice(1, 1 + self.model.nq)
        self._velocities = slice(1 + self.model.nq, None)
        self.elapsed = np.zeros(num_envs, np.int32)
        """Control steps since each lane's episode began, (N,)."""
        self._limit = np.full(num_envs, self.horizon, np.int32)
        inf, one = np.inf, np.float32(1)
        self.single_observation_space = gymnasium.spaces.Box(-inf, inf, (self.env_spec.obs_size,), np.float64)
        self.single_action_space = gymnasium.spaces.Box(-one, one, (self.env_spec.action_size,), np.float32)
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
        return observe(self.env_spec, self._state[:, self._positions], self._state[:, self._velocities])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts new episodes from the standard reset.

        One lane with a seed starts exactly where gymnasium's Hopper-v5 starts with that seed.

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
            actions: (N, a). The motors clamp them to -1..1; the control cost does not, as in
                gymnasium.

        Returns:
            Observations (N, o), rewards of Hopper-v5 (N,), terminated (N,), truncated (N,), infos.

        Raises:
            ValueError: If the actions have the wrong shape.
        """
        actions = np.asarray(actions, np.float64)
        if actions.shape != (self.num_envs, self.env_spec.action_size):
            raise ValueError(f"actions must be {self.action_space.shape}, got {actions.shape}")
        x_before = self._state[:, 1]
        self._state = self._physics.step(self._state, actions)
        self.elapsed += 1
        qpos, qvel = self._state[:, self._positions], self._state[:, self._velocities]
        upright = healthy(self.env_spec, qpos, qvel)
        rewards = (
            (self._state[:, 1] - x_before) / self.dt
            + self.env_spec.healthy_reward * upright
            - self.env_spec.control_cost * np.square(actions).sum(-1)
        )
        terminated = ~upright if self.terminate_when_unhealthy else np.zeros(self.num_envs, bool)
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
        if state.shape != (len(lanes), self._initial.size - 1) or not np.isfinite(state).all():
            raise ValueError(
                f"{len(lanes)} lanes need finite positions and velocities, "
                f"({len(lanes)}, {self._initial.size - 1}) together, got {state.shape}"
            )
        self._state[lanes, 1:] = state
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

    def _restart(self, lanes: np.ndarray) -> None:
        noise = self.env_spec.reset_noise
        size = (len(lanes), self._initial.size - 1)
        self._state[lanes] = self._initial
        self._state[lanes, 1:] += self.np_random.uniform(-noise, noise, size)
        self.elapsed[lanes] = 0
        self._limit[lanes] = self.horizon
