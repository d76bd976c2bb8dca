"""sb3-contrib's TRPO with the work of ours: the same network, batch, conjugate gradient and value fit."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from sb3_contrib import TRPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import (  # pyright: ignore[reportMissingImports]
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
)

from onedemo.core.cpu import cores
from onedemo.experiments.speed.figures import Result, by_turns, ratio
from onedemo.experiments.speed.physics import stock_hopper
from onedemo.experiments.speed.training import LANES, STEPS, one_thread
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import Collector
from onedemo.rl.trpo import Trpo, TrpoConfig
from onedemo.sim import physics_profiling, vector_env


def measure(quick: bool = False) -> list[Result]:
    """Our TRPO against sb3-contrib's on its best stock environment and on our batched one."""
    with one_thread():
        return _measure(quick)


def _measure(quick: bool) -> list[Result]:
    batch = LANES * STEPS
    config = TrpoConfig(fisher_samples=batch)
    best, tried = best_of_stock_envs(config, batch, quick)
    ours = _Ours(config)
    theirs = Theirs(config, batch, best.make, best.threads, shipped=True)
    same = {
        threads: Theirs(config, batch, lambda: OursAsVecEnv(LANES), threads)
        for threads in ({1} if quick else {1, cores()})
    }
    sides: dict[str, _Ours | Theirs] = {"ours": ours, "best": theirs}
    sides |= {f"same, {threads}": side for threads, side in same.items()}
    rates = by_turns({name: side.run for name, side in sides.items()}, 2 if quick else 15)
    for side in sides.values():
        side.close()
    threads = max(same, key=lambda threads: np.median(rates[f"same, {threads}"]))
    equal = (
        f"Hopper with stock reward and termination, 2 x 64 tanh, batches of {batch}, "
        f"{config.cg_iterations} conjugate-gradient steps on the whole batch, {config.value_epochs} value "
        f"epochs in minibatches of {config.value_batch}; ours also normalises observations and returns"
    )
    peer = f"sb3-contrib {version('sb3-contrib')}"
    return [
        ratio(
            "train_vs_sb3_best", "TRPO training", ours=rates["ours"], theirs=rates["best"],
            against=f"{peer} on {best.name}", reach=3.0, unit="steps/s",
            equal=f"{equal}; MuJoCo's profiling is on in theirs, as shipped, and off in ours; tried: {tried}",
        ),
        ratio(
            "train_vs_sb3_same_env", "TRPO training", ours=rates["ours"], theirs=rates[f"same, {threads}"],
            against=f"{peer} on onedemo's batched Hopper, {LANES} lanes, torch threads {threads}", reach=1.5,
            unit="steps/s", equal=f"{equal}; no profiling in either",
        ),
    ]  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class StockEnv:
    """One way to give sb3 its Hoppers."""

    name: str
    make: Callable[[], VecEnv]
    threads: int
    """Of torch."""
    rate: float
    """Steps per second in the trial."""


def best_of_stock_envs(config: TrpoConfig, batch: int, quick: bool) -> tuple[StockEnv, str]:
    """Tries DummyVecEnv and SubprocVecEnv with 1 to 16 Hoppers, torch with one thread and with all.

    Returns:
        The fastest, and what all of them reached, in words.
    """
    kinds = [("DummyVecEnv", DummyVecEnv, n) for n in ((16,) if quick else (1, 2, 4, 8, 16))]
    kinds += [("SubprocVecEnv", SubprocVecEnv, n) for n in ((2,) if quick else (1, 2, 4, 8, 16))]
    tried = []
    for name, kind, count in kinds:
        for threads in sorted({1} if quick else {1, cores()}):
            make = _maker(kind, count)
            theirs = Theirs(config, batch if not quick else batch // 4, make, threads, shipped=True)
            rate = max(theirs.run() for _ in range(1 if quick else 2))
            theirs.close()
            tried.append(
                StockEnv(
                    name=f"{name} of {count}, torch threads {threads}", make=make, threads=threads, rate=rate
                )
            )
    words = ", ".join(f"{each.name}: {each.rate:,.0f}" for each in tried)
    return max(tried, key=lambda each: each.rate), f"{words} steps/s"


def _maker(kind: Any, count: int) -> Callable[[], VecEnv]:
    return lambda: kind([stock_hopper] * count)


class Theirs:
    """sb3-contrib's TRPO, an iteration at a time.

    Args:
        config: Ours, carried over.
        batch: Control steps of an iteration, all lanes together.
        make: Makes the environment.
        threads: Of torch while it learns.
        shipped: With MuJoCo's profiling on, as its Python package has it.
    """

    def __init__(
        self,
        config: TrpoConfig,
        batch: int,
        make: Callable[[], VecEnv],
        threads: int,
        *,
        shipped: bool = False,
    ) -> None:
        # A last minibatch that is smaller than the others: ours has it, too.
        warnings.filterwarnings("ignore", "You have specified a mini-batch size", UserWarning)
        self._profiling = physics_profiling.as_shipped if shipped else nullcontext
        with self._profiling():
            env = make()
        self._batch, self._threads = batch // env.num_envs * env.num_envs, threads
        self._model = TRPO(
            "MlpPolicy",
            env,
            n_steps=batch // env.num_envs,
            batch_size=config.value_batch,
            gamma=config.gamma,
            gae_lambda=config.lam,
            cg_max_steps=config.cg_iterations,
            cg_damping=config.damping,
            line_search_max_iter=config.backtracks,
            line_search_shrinking_factor=config.backtrack_factor,
            n_critic_updates=config.value_epochs,
            learning_rate=config.value_rate,
            target_kl=config.max_kl,
            policy_kwargs={"net_arch": [64, 64]},
            seed=0,
            device="cpu",
        )

    def run(self) -> float:
        """Steps per second of one iteration."""
        before = torch.get_num_threads()
        torch.set_num_threads(self._threads)
        began = time.perf_counter()
        with self._profiling():
            self._model.learn(self._batch, reset_num_timesteps=False)
        seconds = time.perf_counter() - began
        torch.set_num_threads(before)
        return self._batch / seconds

    def close(self) -> None:
        """Ends the environments."""
        self._model.get_env().close()  # type: ignore[union-attr]


class OursAsVecEnv(VecEnv):
    """Our batched Hopper in sb3's interface: the stock reward, episodes that end at a fall."""

    def __init__(self, lanes: int) -> None:
        self._env = vector_env.make("hopper", lanes, terminate_when_unhealthy=True)
        super().__init__(lanes, self._env.single_observation_space, self._env.single_action_space)
        self._actions = np.zeros((lanes, self._env.robot.action_size))

    def reset(self) -> np.ndarray:
        """Starts all lanes anew."""
        return self._env.reset(seed=0)[0].astype(np.float32)

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        """One control step of all lanes."""
        obs, rewards, terminated, truncated, infos = self._env.step(self._actions)
        notes: list[dict] = [{} for _ in range(self.num_envs)]
        ended = terminated | truncated
        for lane in np.flatnonzero(ended):
            notes[lane] = {
                "terminal_observation": infos["final_obs"][lane].astype(np.float32),
                "TimeLimit.truncated": bool(truncated[lane]),
            }
        return obs.astype(np.float32), rewards.astype(np.float32), ended, notes

    def close(self) -> None:
        """Ends the physics threads."""
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same attribute for every lane."""
        return [getattr(self._env, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not needed: lanes have no attributes of their own."""
        raise NotImplementedError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not needed: lanes have no methods of their own."""
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No lane is wrapped."""
        return [False] * self.num_envs


class _Ours:
    """Our TRPO on the stock reward, an iteration at a time."""

    def __init__(self, config: TrpoConfig) -> None:
        self._env = vector_env.make("hopper", LANES, terminate_when_unhealthy=True)
        self._policy = Policy(PolicyConfig(kind="raw"), obs_size=11, action_size=3, horizon=1000, seed=0)
        self._trpo = Trpo(self._policy, config, seed=0, threads=cores())
        self._collector = Collector(self._env, seed=0)

    def run(self) -> float:
        """Steps per second of one iteration."""
        began = time.perf_counter()
        batch = self._collector.collect(self._policy.snapshot(), STEPS)
        self._trpo.update(batch)
        return batch.clock.size / (time.perf_counter() - began)

    def close(self) -> None:
        """Ends the physics threads."""
        self._env.close()
