"""Standing backflips with landings, by trajectory optimisation. It makes one of the demos.

``python -m onedemo.baselines trajectory_search --flips 3 --seed 0 --out PREFIX`` writes
``PREFIX.hidden.npz``. Nothing is learned: at every moment the cross-entropy method (Rubinstein
1999) searches the next second of motor commands for those that best keep a timetable of leaps, and
the first part of the best plan is carried out. Touching the ground with anything but the foot
costs more than anything else; where it happens all the same, time is turned back to before the
take-off and the search goes another way. What reinforcement learning finds for the same move is
tumbling over the ground; these flips are what a person would call a backflip.

Shapes: N candidate plans, T control steps ahead, K knots of a plan, a actions, q = v positions
and velocities.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from onedemo.core.outputs import check_prefix
from onedemo.demos.ground_truth import SUFFIX, HiddenStates, save_hidden
from onedemo.errors import UserError
from onedemo.evaluation.metrics import clean_turns, net_turns
from onedemo.robots.hopper import clearances, fallen, joint_points
from onedemo.sim import vector_env
from onedemo.sim.task_rewards import backflip_reward

GRAVITY = 9.81
STANDING = 1.2
"""Torso height of a relaxed stance, metres."""
TAKE_OFF = 0.7
"""Height of the centre of mass when the foot leaves the ground, metres."""
CROUCH = 0.35
"""Seconds before the flight at which the robot begins to crouch."""
LEAD = 0.1
"""Seconds by which the turn begins before the flight."""
SAFE = 0.015
"""Metres that knee, hip and head should keep from the ground; the ankle stands at 0.02."""
MASSES = {"torso": 3.53, "thigh": 3.93, "leg": 2.71, "foot": 5.09}
"""Of the hopper's parts, kg (hopper.xml, capsules of density 1000 kg/m3)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FlipPlan:
    """The timetable and the search."""

    flips: int = 3
    """How many flips are on the timetable."""
    period: float = 2.6
    """Seconds from one flip to the next."""
    start: float = 0.5
    """Seconds into its period at which a flip leaves the ground."""
    roll: float = 0.7
    """Seconds a flip takes."""
    seconds: float = 8.0
    """Length of the whole."""
    samples: int = 96
    """N: candidate plans per iteration of the search."""
    elites: int = 12
    """Best candidates that the next iteration's distribution is fitted to."""
    iterations: int = 3
    """Of the search, per knot."""
    take_off_iterations: int = 10
    """The same at a take-off, which decides the whole flip."""
    knots: int = 16
    """K: a plan is this many constant commands."""
    hold: int = 8
    """Control steps that one command lasts."""
    retries: int = 30
    """How often, in all, a fall turns time back. Later falls pass."""
    seed: int = 0
    """Of the search."""

    def __post_init__(self) -> None:
        for name in ("flips", "elites", "iterations", "take_off_iterations", "knots", "hold"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.samples < self.elites:
            raise UserError(f"samples ({self.samples}) must be at least elites ({self.elites})")
        if not 0 < self.start + self.roll <= self.period or min(self.roll, self.seconds) <= 0:
            raise UserError("a flip (start + roll) must fit into its period")


def optimise_flips(plan: FlipPlan, *, progress: bool = True) -> HiddenStates:
    """Searches, step by step, for motor commands that keep the timetable.

    Args:
        plan: Timetable and search.
        progress: Show a progress bar on standard error.

    Returns:
        The episode, from the standard reset.
    """
    ahead = plan.knots * plan.hold
    env = vector_env.make("hopper", plan.samples, horizon=ahead + 1)
    env.reset(seed=plan.seed)
    rng = np.random.default_rng(plan.seed)
    steps = round(plan.seconds / env.dt)
    qpos, qvel = [env.qpos[0]], [env.qvel[0]]
    actions: list[np.ndarray] = []
    means = [np.zeros((plan.knots, env.robot.action_size))]  # before each command, for rewinds
    retries = 0
    with tqdm(total=steps, unit="step", disable=not progress) as bar:
        while len(actions) < steps:
            best_Ka, q_Tq, v_Tv = _search(plan, env, qpos[-1], qvel[-1], len(actions), means[-1], rng)
            take = min(plan.hold, steps - len(actions))
            if retries < plan.retries and _failed(plan, q_Tq[:take], len(actions) * env.dt):
                retries += 1
                keep = _last_choice(plan, len(means) - 1, env.dt)
                del means[keep + 1 :], actions[keep * plan.hold :]
                del qpos[len(actions) + 1 :], qvel[len(actions) + 1 :]
            else:
                actions += [best_Ka[0]] * take
                qpos += list(q_Tq[:take])
                qvel += list(v_Tv[:take])
                means.append(np.concatenate([best_Ka[1:], best_Ka[-1:]]))
            bar.update(len(actions) - bar.n)
            turns = round(-qpos[-1][2] / (2 * np.pi), 2)
            bar.set_postfix(turns=turns, z=round(qpos[-1][1], 2), retries=retries)
    env.close()
    states = np.array(qpos), np.array(qvel)
    return HiddenStates(
        obs=env.robot.observe(*states),
        actions=np.array(actions, np.float32),
        qpos=states[0],
        qvel=states[1],
    )


def timetable(plan: FlipPlan, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the robot should do at times t.

    Args:
        plan: The timetable.
        t: Seconds since the start, any shape.

    Returns:
        Torso angle in radians, height of the centre of mass in flight in metres, and the seconds
        since this period's take-off (NaN after the last flip); shapes of t.
    """
    turn = np.floor(t / plan.period)
    since = t - turn * plan.period - plan.start
    phase = np.clip((since + LEAD) / (plan.roll + LEAD), 0, 1)
    done = np.minimum(turn + phase, plan.flips)
    arc = TAKE_OFF + GRAVITY / 2 * since * (plan.roll - since)  # ballistic, of that duration
    # A full turn and a little: whole turns are counted rounded down.
    angle = -2 * np.pi * done - 0.05 * np.minimum(done, 1)
    return angle, arc, np.where(turn < plan.flips, since, np.nan)


def cost(plan: FlipPlan, qpos_NTq: np.ndarray, qvel_NTv: np.ndarray, t_T: np.ndarray) -> np.ndarray:
    """How far candidate trajectories are from the timetable, mean over time, (N,)."""
    angle, arc, since = timetable(plan, t_T)
    flying = (since > 0) & (since < plan.roll)
    crouching = (since > -CROUCH) & (since <= 0)
    landing = (since >= plan.roll) & (since < plan.roll + 0.3)
    standing = ~(flying | crouching | landing)
    x, z, torso = (qpos_NTq[..., i] for i in range(3))
    gaps, point = clearances(qpos_NTq), joint_points(qpos_NTq)
    above = np.minimum(gaps["torso"], gaps["thigh"])
    lowest = np.minimum(above, gaps["leg"])
    centre = centre_of_mass(qpos_NTq)
    lean = centre[..., 0] - (point["heel"] + point["toe"])[..., 0] / 2
    cost_NT = (
        4 * np.minimum((torso - angle) ** 2, 6)
        + 6 * flying * (centre[..., 1] - arc) ** 2
        + 3 * ~(flying | crouching) * (z - STANDING) ** 2
        + 0.05 * qvel_NTv[..., 0] ** 2
        + 0.02 * x**2
        + 20 * np.maximum(0, 0.15 - above)  # a warning before the touch, where the search feels it
        + 60 * np.clip((SAFE - lowest) / SAFE, 0, 1)  # nothing but the foot on the ground
        + standing * (0.01 * np.square(qvel_NTv).sum(-1) + 2 * lean**2)
    )
    weight_T = np.ones(len(t_T))
    weight_T[-6:] = 3  # where the plan leads matters more than how it gets there
    return (cost_NT * weight_T).mean(1)


def centre_of_mass(qpos: np.ndarray) -> np.ndarray:
    """The hopper's centre of mass, (..., q) to (x, z) in metres, (..., 2)."""
    point = joint_points(qpos)
    middles = (
        ("torso", "top", "hip"),
        ("thigh", "hip", "knee"),
        ("leg", "knee", "ankle"),
        ("foot", "heel", "toe"),
    )
    moments = [MASSES[part] * (point[a] + point[b]) / 2 for part, a, b in middles]
    return np.sum(moments, axis=0) / sum(MASSES.values())


def _failed(plan: FlipPlan, qpos_Tq: np.ndarray, t: float) -> bool:
    """Whether the robot fell, or is not upright though no flip is on."""
    angle, _, since = timetable(plan, np.array(t))
    standing = not -CROUCH < since < plan.roll + 0.3
    return bool(fallen(qpos_Tq).any() or (standing and np.abs(qpos_Tq[:, 2] - angle).max() > 1))


def _last_choice(plan: FlipPlan, commands: int, dt: float) -> int:
    """How many commands to keep after a fall: a plan's length is given up, and the whole flip.

    In the air it is too late for another choice: what went wrong is the take-off.
    """
    flip = (commands * plan.hold * dt - plan.start + CROUCH) // plan.period
    crouch = int((flip * plan.period + plan.start - CROUCH) / (plan.hold * dt))
    return max(min(commands - plan.knots, crouch), 0)


def _search(
    plan: FlipPlan,
    env: vector_env.RobotVectorEnv,
    qpos_q: np.ndarray,
    qvel_v: np.ndarray,
    step: int,
    mean_Ka: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best plan found from one state, with the states it leads through."""
    t_T = (step + 1 + np.arange(plan.knots * plan.hold)) * env.dt
    std_Ka = np.full_like(mean_Ka, 0.6)
    best: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
    taking_off = -CROUCH < timetable(plan, t_T[0])[2] < LEAD
    for _ in range(plan.take_off_iterations if taking_off else plan.iterations):
        noise = rng.standard_normal((plan.samples, *mean_Ka.shape))
        plans_NKa = np.clip(mean_Ka + std_Ka * noise, -1, 1)
        plans_NKa[0] = mean_Ka
        if best is not None:
            plans_NKa[1] = best[1]
        qpos_NTq, qvel_NTv = _simulate(plan, env, qpos_q, qvel_v, plans_NKa)
        costs_N = cost(plan, qpos_NTq, qvel_NTv, t_T) + 0.002 * np.square(plans_NKa).sum((1, 2))
        order = np.argsort(costs_N)
        first = order[0]
        if best is None or costs_N[first] < best[0]:
            best = float(costs_N[first]), plans_NKa[first], qpos_NTq[first], qvel_NTv[first]
        elites = plans_NKa[order[: plan.elites]]
        mean_Ka = 0.8 * elites.mean(0) + 0.2 * elites[0]
        std_Ka = np.maximum(elites.std(0), 0.08)
    assert best is not None
    return best[1:]


def _simulate(
    plan: FlipPlan,
    env: vector_env.RobotVectorEnv,
    qpos_q: np.ndarray,
    qvel_v: np.ndarray,
    plans_NKa: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    lanes = np.arange(plan.samples)
    tile = (plan.samples, 1)
    env.set_states(lanes, np.tile(qpos_q, tile), np.tile(qvel_v, tile), elapsed=0 * lanes)
    qpos, qvel = [], []
    for k in range(plan.knots):
        for _ in range(plan.hold):
            env.step(plans_NKa[:, k])
            qpos.append(env.qpos)
            qvel.append(env.qvel)
    return np.stack(qpos, 1), np.stack(qvel, 1)


def main(argv: list[str] | None = None) -> None:
    """Command line; ``--help`` lists the options."""
    defaults = FlipPlan()
    parser = argparse.ArgumentParser(
        prog="python -m onedemo.baselines trajectory_search",
        description="Clean standing backflips by optimisation.",
    )
    parser.add_argument("--flips", type=int, default=defaults.flips)
    parser.add_argument("--period", type=float, default=defaults.period, help="seconds")
    parser.add_argument("--start", type=float, default=defaults.start, help="seconds")
    parser.add_argument("--roll", type=float, default=defaults.roll, help="seconds")
    parser.add_argument("--samples", type=int, default=defaults.samples)
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parser.add_argument("--out", type=Path, required=True, help="prefix of the file to write")
    args = parser.parse_args(argv)
    check_prefix(args.out, (SUFFIX,))
    options = {k: v for k, v in vars(args).items() if k != "out"}
    hidden = optimise_flips(FlipPlan(**options))
    save_hidden(args.out.with_name(args.out.name + SUFFIX), hidden)
    gaps = clearances(hidden.qpos)
    report = {
        "net_turns": int(net_turns(hidden.qpos[:, 2])),
        "clean_turns": int(clean_turns(hidden.qpos)),
        "turns": float((hidden.qpos[0, 2] - hidden.qpos[-1, 2]) / (2 * np.pi)),
        "backflip_reward": float(backflip_reward(hidden.obs[1:], hidden.actions).sum()),
        "lowest_part_but_foot": float(min(gaps[part].min() for part in ("torso", "thigh", "leg"))),
        "x": float(hidden.qpos[-1, 0]),
    }
    print(json.dumps(report))
