"""Collecting what the policy does: batches for learning, whole episodes for evaluation.

``Collector`` keeps its lanes running between iterations, so a batch may be shorter than an
episode. ``EpisodeRules`` says how episodes start, how the demo phase moves, what a step is worth and
when an episode ends early; the class itself is the plain case; subclass it for another.

Shapes: N lanes, T control steps, o observations, a actions, q positions, v velocities,
f policy inputs, K lanes that restart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch

from onedemo.rl.policy import PolicySnapshot
from onedemo.sim import vector_env
from onedemo.types import Rollouts


@dataclass(frozen=True, kw_only=True, slots=True)
class Transitions(Rollouts):
    """Rollouts with the states *after* each step too, as they were before any reset."""

    next_obs: np.ndarray
    """Observations after the step, (N, T, o), float64."""
    next_qpos: np.ndarray
    """Positions after the step, (N, T, q), float64."""
    next_qvel: np.ndarray
    """Velocities after the step, (N, T, v), float64."""
    next_clock: np.ndarray
    """Demo step after the step, (N, T), int32: clock + 1 unless the rules say otherwise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Episodes:
    """N whole episodes, with the state after the last step: all states are (N, T + 1, ...)."""

    obs: np.ndarray
    """(N, T + 1, o)."""
    actions: np.ndarray
    """(N, T, a)."""
    qpos: np.ndarray
    """(N, T + 1, q)."""
    qvel: np.ndarray
    """(N, T + 1, v)."""
    clock: np.ndarray
    """Demo step of each state, (N, T + 1)."""
    rewards: np.ndarray
    """What each step was worth, as the rules say, (N, T)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """One control step of all lanes, as the environment made it."""

    obs: np.ndarray
    """Before the step, (N, o)."""
    actions: np.ndarray
    """As sampled, (N, a)."""
    clock: np.ndarray
    """Demo step before the step, (N,)."""
    elapsed: np.ndarray
    """Control steps since the episode began, this one included, (N,); an episode that ``Starts`` at a
    demo step counts from there."""
    next_obs: np.ndarray
    """After the step, before any reset, (N, o)."""
    next_qpos: np.ndarray
    """(N, q)."""
    next_qvel: np.ndarray
    """(N, v)."""
    rewards: np.ndarray
    """The environment's own, (N,)."""
    terminated: np.ndarray
    """Whether the environment ended the episode with it, (N,)."""
    truncated: np.ndarray
    """Whether it ended at the environment's time limit, (N,)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Starts:
    """Where some restarting lanes begin instead of standing at demo step 0."""

    lanes: np.ndarray
    """Which, (K,), lane numbers."""
    qpos: np.ndarray
    """(K, q)."""
    qvel: np.ndarray
    """(K, v)."""
    clock: np.ndarray
    """Demo step that the state belongs to, (K,)."""


class EpisodeRules:
    """The plain rules: a standing start, one demo step per control step, no early end, the given rewards."""

    def start(self, lanes: np.ndarray, rng: np.random.Generator) -> Starts | None:
        """Called when lanes restart; None leaves them all in the standard reset.

        Args:
            lanes: The lanes that restart, (K,).
            rng: The collector's generator: use no other, or a resumed run differs.
        """
        return None

    def advance(self, step: Step) -> np.ndarray:
        """The demo step after a control step, (N,). The episode ends once it is the horizon."""
        return step.clock + 1

    def stop(self, step: Step, next_clock: np.ndarray) -> np.ndarray:
        """True where the episode ends early, as in a terminal state, (N,)."""
        return np.zeros(len(step.clock), bool)

    def score(self, batch: Transitions) -> np.ndarray:
        """Rewards of a batch, (N, T), once it is whole; its own are those of the environment."""
        return batch.rewards

    def state_dict(self) -> dict[str, Any]:
        """What a resumed training needs of the rules, for ``torch.save``."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken."""


class Actor(Protocol):
    """What acts: a ``PolicySnapshot``, or plain noise."""

    @property
    def mean(self) -> np.ndarray:
        """One number for each of its inputs, (f,)."""
        ...

    def inputs(self, obs: np.ndarray, clock: np.ndarray) -> np.ndarray:
        """What it sees of observations (N, o) at demo steps (N,): (N, f), float32."""
        ...

    def act(self, inputs: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Actions, (N, a)."""
        ...


class Collector:
    """Steps a batched environment with a policy, batch after batch.

    Args:
        env: The lanes.
        seed: Of the resets and of the action noise.
        rules: How episodes start, advance and end.
        stagger: Shorten each lane's first episode differently, so that later batches see every
            part of an episode.
    """

    def __init__(
        self,
        env: vector_env.RobotVectorEnv,
        *,
        seed: int,
        rules: EpisodeRules | None = None,
        stagger: bool = True,
    ) -> None:
        self.env = env
        self.rules = rules or EpisodeRules()
        self._rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
        self._obs, _ = env.reset(seed=seed, options={"stagger": stagger})
        self._clock = np.zeros(env.num_envs, np.int32)
        self._begin(np.arange(env.num_envs))

    def collect(self, policy: Actor, steps: int, *, deterministic: bool = False) -> Transitions:
        """Goes on for T control steps in every lane.

        Args:
            policy: Acts; one snapshot for the whole batch.
            steps: T.
            deterministic: Take the mean action instead of a sample.

        Returns:
            What happened, lane-first.
        """
        env, size = self.env, self.env.robot
        rng = None if deterministic else self._rng

        def room(rows: int, *width: int, dtype: Any = np.float64) -> np.ndarray:
            # Time first, so that a step writes one piece of memory; turned lane first at the end.
            return np.empty((rows, env.num_envs, *width), dtype)

        states = {
            "obs": room(steps + 1, size.obs_size),
            "qpos": room(steps + 1, env.model.nq),
            "qvel": room(steps + 1, env.model.nv),
            "clock": room(steps + 1, dtype=np.int32),
            "inputs": room(steps + 1, len(policy.mean), dtype=np.float32),
        }
        deeds = {
            "actions": room(steps, size.action_size, dtype=np.float32),
            "rewards": room(steps),
            "terminated": room(steps, dtype=bool),
            "truncated": room(steps, dtype=bool),
        }
        lasts: list[tuple[int, np.ndarray, dict[str, np.ndarray]]] = []
        for t in range(steps + 1):
            now = {"obs": self._obs, "qpos": env.qpos, "qvel": env.qvel, "clock": self._clock}
            now["inputs"] = policy.inputs(self._obs, self._clock)
            for name, value in now.items():
                states[name][t] = value
            if t == steps:
                break
            outcome, last = self._step(policy.act(now["inputs"], rng))
            for name, value in outcome.items():
                deeds[name][t] = value
            if last is not None:
                lasts.append((t, *last))
        after = {name: rows[1:] for name, rows in states.items()}
        if lasts:  # where an episode ended, what came after the step is not what the next one started from
            steps_K = np.concatenate([np.full(len(lanes), t) for t, lanes, _ in lasts])
            lanes_K = np.concatenate([lanes for _, lanes, _ in lasts])
            ends = {name: np.concatenate([end[name] for *_, end in lasts]) for name in lasts[0][2]}
            ends["inputs"] = policy.inputs(ends["obs"], ends["clock"])
            after = {name: rows.copy() for name, rows in after.items()}
            for name, rows in after.items():
                rows[steps_K, lanes_K] = ends[name]
        columns = {name: rows[:-1] for name, rows in states.items()} | deeds
        columns |= {f"next_{name}": rows for name, rows in after.items()}
        batch = Transitions(**{name: rows.swapaxes(0, 1) for name, rows in columns.items()})
        return replace(batch, rewards=self.rules.score(batch))

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed training needs, as tensors and plain numbers."""
        env = {
            key: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
            for key, value in self.env.state_dict().items()
        }
        return {
            "env": env,
            "clock": torch.from_numpy(self._clock.copy()),
            "rng": self._rng.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken.

        Raises:
            ValueError: If the state is of another number of lanes or another robot.
        """
        env = {k: v.numpy() if isinstance(v, torch.Tensor) else v for k, v in state["env"].items()}
        self.env.load_state_dict(env)
        self._clock = state["clock"].numpy().copy()
        self._rng.bit_generator.state = state["rng"]
        self._obs = self.env.obs

    def _step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, dict[str, np.ndarray]] | None]:
        """One control step: what it brought, and the last states of the lanes that ended, if any did."""
        step, next_clock = take_step(self.env, self._obs, self._clock, actions, self.rules)
        already = step.terminated | step.truncated
        terminated = step.terminated | (self.rules.stop(step, next_clock) & ~already)
        truncated = (step.truncated | (next_clock >= self.env.horizon)) & ~terminated
        ended = terminated | truncated
        self._obs, self._clock = step.next_obs, np.where(ended, 0, next_clock).astype(np.int32)
        last = None
        if ended.any():
            lanes = np.flatnonzero(ended)
            ends = {"obs": step.next_obs, "qpos": step.next_qpos, "qvel": step.next_qvel, "clock": next_clock}
            last = lanes, {name: value[lanes] for name, value in ends.items()}
            late = ended & ~already  # ended by the rules, not by the environment
            if late.any():
                self.env.reset(options={"reset_mask": late})
            self._begin(lanes)
        outcome = {
            "actions": actions, "rewards": step.rewards, "terminated": terminated, "truncated": truncated,
        }  # fmt: skip
        return outcome, last

    def _begin(self, lanes: np.ndarray) -> None:
        starts = self.rules.start(lanes, self._rng)
        if starts is not None and len(starts.lanes):
            self.env.set_states(starts.lanes, starts.qpos, starts.qvel, elapsed=starts.clock)
            self._clock[starts.lanes] = starts.clock
        self._obs = self.env.obs


def take_step(
    env: vector_env.RobotVectorEnv,
    obs: np.ndarray,
    clock: np.ndarray,
    actions: np.ndarray,
    rules: EpisodeRules,
) -> tuple[Step, np.ndarray]:
    """One control step of all lanes: what happened, and the demo step after it, (N,), int32.

    Args:
        env: The lanes; those that end with the step have been reset afterwards.
        obs: What they show, (N, o).
        clock: Demo step of each, (N,).
        actions: As sampled, (N, a).
        rules: Move the demo phase.
    """
    elapsed = env.elapsed + 1
    next_obs, rewards, terminated, truncated, infos = env.step(actions)
    step = Step(
        obs=obs,
        actions=actions,
        clock=clock,
        elapsed=elapsed,
        next_obs=infos.get("final_obs", next_obs),
        next_qpos=infos["final_qpos"] if infos else env.qpos,
        next_qvel=infos["final_qvel"] if infos else env.qvel,
        rewards=rewards,
        terminated=terminated,
        truncated=truncated,
    )
    return step, rules.advance(step).astype(np.int32)


class WholeEpisodes(EpisodeRules):
    """Other rules without their starts and early ends; the phase stays at the horizon once it gets there."""

    def __init__(self, rules: EpisodeRules, horizon: int) -> None:
        self._rules, self._horizon = rules, horizon

    def advance(self, step: Step) -> np.ndarray:
        """As the other rules move it, up to the horizon."""
        return np.minimum(self._rules.advance(step), self._horizon)

    def score(self, batch: Transitions) -> np.ndarray:
        """As the other rules do."""
        return self._rules.score(batch)


@dataclass(frozen=True, kw_only=True, slots=True)
class Acting:
    """A policy that never changes and the rules that move the demo beside it, for the live view.

    Rules note what happens, so each user has an object of its own.
    """

    policy: PolicySnapshot
    """Acts."""
    rules: EpisodeRules
    """Move the demo phase; their starts and early ends are not used."""

    def step(
        self, env: vector_env.RobotVectorEnv, obs: np.ndarray, clock: np.ndarray
    ) -> tuple[Step, np.ndarray]:
        """One control step of all lanes by the policy's mean action, and the demo step after it, (N,).

        Args:
            env: The lanes, none of which may end with the step.
            obs: What they show, (N, o).
            clock: Demo step of each, (N,).
        """
        actions = self.policy.act(self.policy.inputs(obs, clock))
        return take_step(env, obs, clock, actions, WholeEpisodes(self.rules, self.policy.horizon))


def evaluate(
    policy: PolicySnapshot,
    env_name: str,
    *,
    episodes: int = 16,
    seed: int = 0,
    horizon: int | None = None,
    rules: EpisodeRules | None = None,
    deterministic: bool = True,
    nthread: int | None = None,
) -> Episodes:
    """Whole episodes from standing starts, the policy's mean action, nothing ends early.

    Args:
        policy: Acts.
        env_name: A registered environment.
        episodes: N.
        seed: Of the starts (and of the noise, if not deterministic).
        horizon: T; the policy's own horizon if None.
        rules: Move the demo phase and give the rewards, as ``WholeEpisodes``.
        deterministic: Take the mean action.
        nthread: Physics threads.

    Returns:
        The episodes.

    Raises:
        UserError: If the environment is unknown.
    """
    horizon = policy.horizon if horizon is None else horizon
    # One step more than there will be, so that neither time nor the demo phase ends an episode.
    env = vector_env.make(env_name, episodes, horizon=max(horizon, policy.horizon) + 1, nthread=nthread)
    whole = WholeEpisodes(rules or EpisodeRules(), policy.horizon)
    collector = Collector(env, seed=seed, rules=whole, stagger=False)
    batch = collector.collect(policy, horizon, deterministic=deterministic)
    env.close()

    def with_last(name: str) -> np.ndarray:
        states, after = getattr(batch, name), getattr(batch, f"next_{name}")
        return np.ascontiguousarray(np.concatenate([states, after[:, -1:]], axis=1))

    return Episodes(
        **{name: with_last(name) for name in ("obs", "qpos", "qvel", "clock")},
        actions=np.ascontiguousarray(batch.actions),
        rewards=np.ascontiguousarray(batch.rewards),
    )
