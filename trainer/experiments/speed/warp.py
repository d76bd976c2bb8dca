"""Physics on a GPU: control steps/s of the ``warp`` backend beside the processor's, by lanes."""

from __future__ import annotations

import importlib.util
import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np

from onedemo.baselines.handcoded_trpo import HandcodedConfig, train_handcoded
from onedemo.core.cpu import cores
from onedemo.experiments.speed.figures import Figure, Growth, Result, Skipped, by_turns, single
from onedemo.robots.registry import robot_named
from onedemo.sim.physics import Physics, RolloutPhysics, load_model

LANES = (512, 2048, 8192, 32768)
_SPEC = robot_named("hopper")
_CORES = cores()


def measure(quick: bool = False) -> list[Result]:
    """Steps/s of both backends for 512 to 32,768 lanes; skipped where there is no CUDA device.

    Args:
        quick: Up to 8,192 lanes and an eighth of the steps. The first run on a GPU compiles the kernels
            besides.
    """
    if importlib.util.find_spec("mujoco_warp") is None:
        return [Skipped(name="warp_lanes", reason="the extra 'warp' is not installed: not run")]
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    if not wp.is_cuda_available():
        return [Skipped(name="warp_lanes", reason="no CUDA device on this machine: not run")]
    if quick:
        return [growth(LANES[:3], device=None, turns=2, lane_steps=2**16)]
    return [growth(LANES, device=None, turns=3, lane_steps=2**19), whole_training(3_000_000, "cuda")]


def whole_training(steps: int, device: str) -> Figure:
    """The time of a whole backflip training, physics, policy and value function on the GPU.

    Args:
        steps: Control steps, all lanes together.
        device: Of policy and value function.
    """
    lanes = 512
    config = HandcodedConfig(
        task="backflip", steps=steps, lanes=lanes, batch=32_768 // lanes, physics="warp", device=device,
        evaluate_every=100,
    )  # fmt: skip
    began = time.perf_counter()
    result = train_handcoded(config, progress=False)
    score = result.curve[-1]
    return single(
        "gpu_backflip_s", f"a whole training of the hand-coded baseline, {steps:,} steps, {device}",
        [time.perf_counter() - began], unit="s",
        how=f"TRPO on the hand-coded reward, {lanes} lanes; final policy: reward {score.reward_mean:,.0f}, "
        f"{score.net_turns_mean:.1f} net turns; kernels were compiled before",
    )  # fmt: skip


def growth(lanes: Sequence[int], *, device: str | None, turns: int, lane_steps: int) -> Growth:
    """Median control steps/s of both backends at each number of lanes, taken by turns.

    The same states and actions; transfers to and from the device are part of the step. Hoppers
    start upright and fall, as they do under an untrained policy.

    Args:
        lanes: Numbers of lanes, ascending.
        device: Warp's name of a device; the first GPU if None.
        turns: Repetitions of each side.
        lane_steps: Control steps of a repetition, all lanes together.
    """
    from onedemo.sim.warp_physics import WarpPhysics

    model = load_model(_SPEC.xml)
    rates: dict[str, list[float]] = {}
    where = ""
    for count in lanes:
        warp = WarpPhysics(model, _SPEC.frame_skip, count, device)
        where = warp.device.name
        sides: dict[str, Physics] = {
            "mujoco": RolloutPhysics(model, _SPEC.frame_skip, count, _CORES),
            "warp": warp,
        }
        steps = max(8, lane_steps // count)
        runs = {name: _rate_of(physics, model.nu, count, steps) for name, physics in sides.items()}
        taken = by_turns(runs, turns)
        for name, values in taken.items():
            rates.setdefault(name, []).append(statistics.median(values))
            sides[name].close()
    return Growth(
        name="warp_lanes",
        title=f"Physics by lanes: MuJoCo Warp on {where}, MuJoCo on {_CORES} cores",
        x_label="lanes",
        y_label="control steps/s",
        x=list(lanes),
        y=rates,
    )


def _rate_of(physics: Physics, motors: int, lanes: int, steps: int) -> Callable[[], float]:
    """A repetition: the lanes from their start for some steps, in control steps/s."""
    rng = np.random.default_rng(0)
    state = np.zeros((lanes, 13))
    state[:, 2] = 1.25
    state[:, 1:] += rng.uniform(-_SPEC.start.positions, _SPEC.start.positions, (lanes, 12))
    actions = rng.uniform(-1, 1, (16, lanes, motors))

    def run() -> float:
        now, began = state, time.perf_counter()
        for step in range(steps):
            now = physics.step(now, actions[step % len(actions)])
        return lanes * steps / (time.perf_counter() - began)

    return run
