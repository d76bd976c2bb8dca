"""Physics: our batched robots beside the simulator's own limit, and the Hopper beside other batched Hoppers.

A rate is control steps per second, all lanes together. N lanes, T control steps, a actions.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from contextlib import nullcontext

import gymnasium
import mujoco
import numpy as np
from mujoco import rollout

from onedemo.core.cpu import cores
from onedemo.experiments.speed.figures import Growth, Result, Skipped, by_turns, ratio
from onedemo.robots.registry import BUILT_IN, robot_named
from onedemo.robots.robot import Robot, compiled
from onedemo.sim import physics_profiling, vector_env
from onedemo.sim.physics import load_model

LANES = 64
MISSING = "{} is not installed: pip install -e '.[bench]'"
"""Why a comparison was skipped."""
_SPEC = robot_named("hopper")
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL.value)


class Bare:
    """``mujoco.rollout`` on a robot and nothing around it: what a batched robot can reach.

    Args:
        lanes: N.
        robot: Which; the Hopper if None.
        shipped: The stock model, profiling and chunks as the Python package has them; else every
            setting that makes our own physics quick.
    """

    def __init__(self, lanes: int, robot: Robot | None = None, *, shipped: bool = False) -> None:
        self._robot = robot or _SPEC
        model = compiled(self._robot.xml) if shipped else load_model(self._robot.xml)
        self._models = [model] * lanes
        threads = min(cores(), lanes)
        self._pool = rollout.Rollout(nthread=threads)
        self._data = [mujoco.MjData(self._models[0]) for _ in range(max(1, threads))]
        self._chunk = None if shipped else -(-lanes // max(1, threads))
        self._shipped = shipped

    def run(self, states_NS: np.ndarray, actions_TNa: np.ndarray) -> float:
        """Steps the lanes once per row of actions, one call each, as a policy in the loop must.

        Returns:
            Seconds.
        """
        with physics_profiling.as_shipped() if self._shipped else nullcontext():
            return self._run(states_NS, actions_TNa)

    def _run(self, states_NS: np.ndarray, actions_TNa: np.ndarray) -> float:
        lanes, skip = len(states_NS), self._robot.frame_skip
        out = np.empty((lanes, skip, states_NS.shape[1]))
        control = np.empty((lanes, skip, actions_TNa.shape[2]))
        began = time.perf_counter()
        for actions in actions_TNa:
            control[:] = actions[:, None]
            self._pool.rollout(
                self._models, self._data, states_NS, control, control_spec=_CONTROL, skip_checks=True,
                nstep=skip, state=out, chunk_size=self._chunk,
            )  # fmt: skip
            states_NS = out[:, -1].copy()
        return time.perf_counter() - began

    def close(self) -> None:
        """Ends the pool's threads."""
        self._pool.close()


def full_states(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Positions (N, q) and velocities (N, v) as MuJoCo's full physics states at time 0, (N, S)."""
    return np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel], axis=1)


def measure(quick: bool = False) -> list[Result]:
    """Our batched Hopper against bare MuJoCo, envpool and gymnasium, and the rate for 1 to 512 lanes."""
    turns, steps = (5, 40) if quick else (25, 125)
    return [
        *_against_bare(turns, steps),
        *_each_against_bare(turns, steps),
        *_against_envpool(turns, steps),
        *_against_gymnasium(3 if quick else 9, steps, quick),
        _by_lanes(3 if quick else 9, quick),
    ]


def _against_bare(turns: int, steps: int) -> list[Result]:
    rates = _ours_and_bare(LANES, steps, turns)
    shipped = _ours_and_bare(LANES, steps, turns, shipped=True)
    return [
        ratio(
            "physics_vs_bare", f"physics, batched Hopper, {LANES} lanes",
            ours=rates["ours"], theirs=rates["bare"], against=f"mujoco.rollout bare, {cores()} threads",
            reach=0.95, unit="steps/s",
            equal="the same states and actions, one call per control step, all cores; bare has every "
            "setting that makes ours quick: no argument checks, no profiling, no search for islands, one "
            "piece of the lanes a thread; ours also gives observations and rewards",
        ),
        ratio(
            "physics_vs_bare_as_shipped", "the same", ours=shipped["ours"], theirs=shipped["bare"],
            against=f"mujoco.rollout as the Python package has it, {cores()} threads", reach=None,
            unit="steps/s",
            equal="as above, but bare with the stock model and the package's profiling and sizes of pieces",
        ),
    ]  # fmt: skip


def _each_against_bare(turns: int, steps: int) -> list[Result]:
    """The same of each robot that comes with the program; the slower ones for fewer steps."""
    rows: list[Result] = []
    for name in BUILT_IN:
        robot = robot_named(name)
        steps_each = max(20, round(steps / (robot.velocities / _SPEC.velocities) ** 2))
        rates = _ours_and_bare(LANES, steps_each, turns, robot=robot)
        rows.append(
            ratio(
                f"physics_vs_bare_{name}", f"the same, {name}", ours=rates["ours"], theirs=rates["bare"],
                against=f"mujoco.rollout bare, {cores()} threads", reach=0.95, unit="steps/s",
                equal="as the first, of this robot",
            )
        )  # fmt: skip
    return rows


def _ours_and_bare(
    lanes: int, steps: int, turns: int, *, robot: Robot | None = None, shipped: bool = False
) -> dict[str, list[float]]:
    robot = robot or _SPEC
    env = vector_env.RobotVectorEnv(robot, lanes, horizon=10**9)
    bare = Bare(lanes, robot, shipped=shipped)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    low, high = np.array(robot.low), np.array(robot.high)
    actions = rng.uniform(-1, 1, (steps, lanes, robot.action_size))
    commands = (low + high) / 2 + (high - low) / 2 * actions
    for step in range(100):  # spread: some fall, some fly
        env.step(actions[step % steps])
    qpos, qvel, every = env.qpos, env.qvel, np.arange(lanes)

    def ours() -> float:
        env.set_states(every, qpos, qvel)
        return _rate(env.step, actions)

    def theirs() -> float:
        return actions[..., 0].size / bare.run(full_states(qpos, qvel), commands)

    rates = by_turns({"ours": ours, "bare": theirs}, turns)
    env.close()
    bare.close()
    return rates


def _rate(step: Callable[[np.ndarray], object], actions: np.ndarray) -> float:
    began = time.perf_counter()
    for action in actions:
        step(action)
    return actions[..., 0].size / (time.perf_counter() - began)


def _against_envpool(turns: int, steps: int) -> list[Result]:
    try:
        import envpool  # pyright: ignore[reportMissingImports]
    except ImportError:
        return [Skipped(name="physics_vs_envpool", reason=MISSING.format("envpool"))]
    peer = envpool.make_gymnasium("Hopper-v4", num_envs=LANES, num_threads=cores(), seed=0)
    env = vector_env.make("hopper", LANES, terminate_when_unhealthy=True)
    env.reset(seed=0)
    peer.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, LANES, _SPEC.action_size))
    rates = by_turns(
        {"ours": lambda: _rate(env.step, actions), "envpool": lambda: _rate(peer.step, actions)}, turns
    )
    env.close()
    peer.close()
    return [
        ratio(
            "physics_vs_envpool", "the same, episodes that end at a fall",
            ours=rates["ours"], theirs=rates["envpool"], against=f"envpool {envpool.__version__} Hopper-v4",
            reach=1.0, unit="steps/s",
            equal=f"{LANES} lanes, {cores()} threads, the same random actions, both restart after a fall; "
            "no profiling in either",
        )
    ]  # fmt: skip


def _against_gymnasium(turns: int, steps: int, quick: bool) -> list[Result]:
    """Against the better of both vector environments, each with its best number of lanes."""
    steps = min(steps, 100)
    makers: dict[str, Callable[[], gymnasium.vector.VectorEnv]] = {}
    for count in (1, 8) if quick else (1, 4, 16, 64):
        makers[f"SyncVectorEnv, {count}"] = lambda n=count: gymnasium.vector.SyncVectorEnv([stock_hopper] * n)
    for count in (2,) if quick else (2, 4, 16):
        makers[f"AsyncVectorEnv, {count}"] = lambda n=count: gymnasium.vector.AsyncVectorEnv(
            [stock_hopper] * n
        )
    pilot = {name: _gymnasium_rate(make, steps, 2)[-1] for name, make in makers.items()}
    best = max(pilot, key=lambda name: pilot[name])
    with physics_profiling.as_shipped():  # processes that a peer starts now keep it
        peer = makers[best]()
    env = vector_env.make("hopper", LANES, terminate_when_unhealthy=True)
    env.reset(seed=0)
    peer.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, LANES, _SPEC.action_size))
    long = np.random.default_rng(0).uniform(-1, 1, (steps, peer.num_envs, _SPEC.action_size))

    def theirs() -> float:
        with physics_profiling.as_shipped():
            return _rate(peer.step, long)

    sides = {"ours": lambda: _rate(env.step, actions), "gymnasium": theirs}
    rates = by_turns(sides, turns)
    env.close()
    peer.close()
    tried = ", ".join(f"{name} lanes {rate:,.0f}" for name, rate in pilot.items())
    return [
        ratio(
            "physics_vs_gymnasium", "the same", ours=rates["ours"], theirs=rates["gymnasium"],
            against=f"gymnasium {gymnasium.__version__} {best} lanes", reach=1.5, unit="steps/s",
            equal="Hopper-v5, random actions, both end and restart at a fall; MuJoCo's profiling is on in "
            f"gymnasium's, as shipped, and off in ours; tried (steps/s): {tried}",
        )
    ]  # fmt: skip


def stock_hopper() -> gymnasium.Env:
    """Hopper-v5 as gymnasium has it."""
    # In a process of its own, which its parent may have forked with profiling off: as shipped, it is on.
    if multiprocessing.parent_process() is not None:
        physics_profiling.switch_on()
    return gymnasium.make("Hopper-v5")


def _gymnasium_rate(make: Callable[[], gymnasium.vector.VectorEnv], steps: int, turns: int) -> list[float]:
    with physics_profiling.as_shipped():
        env = make()
        env.reset(seed=0)
        actions = np.random.default_rng(0).uniform(-1, 1, (steps, env.num_envs, _SPEC.action_size))
        rates = [_rate(env.step, actions) for _ in range(turns)]
        env.close()
        return rates


def _by_lanes(turns: int, quick: bool) -> Growth:
    sizes = (1, 64, 512) if quick else (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
    ours, bare = [], []
    for lanes in sizes:
        rates = _ours_and_bare(lanes, max(10, (2_000 if quick else 8_000) // lanes), turns)
        ours.append(float(np.median(rates["ours"])))
        bare.append(float(np.median(rates["bare"])))
    return Growth(
        name="physics_lanes", title="Physics by lanes", x_label="lanes", y_label="control steps/s",
        x=sizes, y={"onedemo": ours, "mujoco.rollout bare": bare},
    )  # fmt: skip
