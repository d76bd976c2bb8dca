"""States that nobody has to reach first: random ones, for clips to ask about and for episodes to start in.

A random policy from a standing start never shows a flip, so no rating could ever say that a flip is
right. Random states of the robot, let go for a second, show a bit of everything that it can do.

Shapes: n states, N lanes, T control steps, q positions, v velocities, a actions.
"""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np

from onedemo.rl.rollouts import Collector, EpisodeRules, Starts, Transitions
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.robots.robot import Robot, floor_of, model_of
from onedemo.sim import vector_env
from onedemo.sim.kinematics import body_of

_TRIES = 20
"""Draws of twice as many states as are asked for."""
_SUNK = 0.05
"""Metres that a part may reach into the ground: contacts push it out within a few steps."""
_SLIDE_SPEED, _TURN_SPEED = 2.0, 4.0
"""Standard deviations of velocities where the robot does not say, m/s and rad/s."""
_TRIED, _SOUND_STEPS, _CALMEST = 32, 5, 0.01
"""States and control steps by which it is tried whether such velocities can be simulated; the least share."""
_SLIDE_SECONDS = 0.5
"""A slide goes from one end to the other in no less, within one deviation."""


def random_states(count: int, rng: np.random.Generator, name: str = DEFAULT) -> tuple[np.ndarray, np.ndarray]:
    """States spread over what the robot can be in: any angle, spin and height above the ground.

    Args:
        count: n.
        rng: Draws them.
        name: The robot.

    Returns:
        Positions (n, q), where the place on the floor is 0, and velocities (n, v).
    """
    of = robot_named(name)
    found = [np.zeros((0, of.positions))]
    for _ in range(_TRIES):
        if sum(map(len, found)) >= count:
            break
        qpos = _positions(of, 2 * count, rng)
        found.append(qpos[_sunk(of, qpos) < _SUNK])
    missing = count - sum(map(len, found))
    if missing > 0:  # a robot that hardly fits above its floor is lifted, or else left as it is
        qpos = _positions(of, missing, rng)
        if of.height is not None:
            qpos[:, of.height] += np.maximum(0, _sunk(of, qpos))
        found.append(qpos)
    qpos = np.concatenate(found)[:count]
    return qpos, rng.normal(0.0, _speeds(of) * _calm(of), (count, of.velocities))


def _sunk(of: Robot, qpos: np.ndarray) -> np.ndarray:
    """How deep the lowest part is in the floor, metres, (n,), negative above it; nothing is where none is."""
    floor = floor_of(model_of(of.xml))
    if floor is None or of.camera.up != 2:
        return np.full(len(qpos), -np.inf)
    return floor - np.minimum.reduce(list(body_of(of).clearances(qpos).values()))


def _positions(of: Robot, count: int, rng: np.random.Generator) -> np.ndarray:
    model = model_of(of.xml)
    qpos = np.tile(of.rest, (count, 1))
    first = {"planar": 3, "free": 7, "fixed": 0}[of.root]
    qpos[:, of.hidden] = 0
    if of.height is not None:
        qpos[:, of.height] = rng.uniform(*of.wild.heights, count)
    if of.root == "planar":
        qpos[:, 2] = rng.uniform(-np.pi, np.pi, count)
    elif of.root == "free":
        qpos[:, 3:7] = _turned(count, rng)
    if of.wild.joints is not None:
        ranges = np.array(of.wild.joints)
        qpos[:, first:] = rng.uniform(ranges[:, 0], ranges[:, 1], (count, len(ranges)))
        return qpos
    kinds = mujoco.mjtJoint
    for joint in np.flatnonzero(model.jnt_qposadr >= first):
        at, kind, limited = model.jnt_qposadr[joint], model.jnt_type[joint], model.jnt_limited[joint]
        if kind == kinds.mjJNT_BALL:
            qpos[:, at : at + 4] = _turned(count, rng)
        elif limited and kind != kinds.mjJNT_FREE:
            low, high = model.jnt_range[joint]
            qpos[:, at] = rng.uniform(low, high, count)
        elif kind == kinds.mjJNT_HINGE:
            qpos[:, at] = rng.uniform(-np.pi, np.pi, count)
        # What else there is stays where it rests: a thing beside the robot, a slide without an end.
    return qpos


def _turned(count: int, rng: np.random.Generator) -> np.ndarray:
    """Rotations of every kind, quaternions (n, 4)."""
    turned = rng.standard_normal((count, 4))
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


@lru_cache(maxsize=32)
def _calm(of: Robot) -> float:
    """Share of the usual velocities at which a robot's physics stays sound: a fish of 10 cm does not race."""
    if of.wild.speeds is not None:
        return 1.0
    rng, lanes = np.random.default_rng(0), np.arange(_TRIED)
    qpos, spread = _positions(of, _TRIED, rng), rng.normal(0.0, _speeds(of), (_TRIED, of.velocities))
    env = vector_env.RobotVectorEnv(of, _TRIED, nthread=0)
    share = 1.0
    while share > _CALMEST:
        lost = env.unstable
        env.set_states(lanes, qpos, share * spread)
        for _ in range(_SOUND_STEPS):
            env.step(np.zeros((_TRIED, of.action_size)))
        if env.unstable - lost <= _TRIED // 10:
            break
        share /= 2
    env.close()
    return share


def _speeds(of: Robot) -> np.ndarray:
    if of.wild.speeds is not None:
        return np.array(of.wild.speeds)
    model = model_of(of.xml)
    speeds = np.full(of.velocities, _TURN_SPEED)
    for joint in range(model.njnt):
        at = model.jnt_dofadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            speeds[at : at + 3] = _SLIDE_SPEED
        elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            reach = np.ptp(model.jnt_range[joint]) if model.jnt_limited[joint] else np.inf
            speeds[at] = min(_SLIDE_SPEED, reach / _SLIDE_SECONDS)  # a finger does not race
    return speeds


class RandomStarts(EpisodeRules):
    """Episodes start in a random state.

    Args:
        standing: Share of lanes that start standing all the same.
        name: The robot.
    """

    def __init__(self, standing: float = 0.0, name: str = DEFAULT) -> None:
        self._standing, self._name = standing, name

    def start(self, lanes: np.ndarray, rng: np.random.Generator) -> Starts | None:
        """Random states at demo step 0."""
        lanes = lanes[rng.random(len(lanes)) >= self._standing]
        qpos, qvel = random_states(len(lanes), rng, self._name)
        return Starts(lanes=lanes, qpos=qpos, qvel=qvel, clock=np.zeros(len(lanes), np.int32))


class HeldNoise:
    """A policy that sees nothing: random actions, each held for a few steps, so that they add up.

    Args:
        lanes: N.
        actions: a.
        hold: Control steps that an action is held, at most.
    """

    mean = np.zeros(1)

    def __init__(self, lanes: int, actions: int, hold: int = 10) -> None:
        self._hold = hold
        self._left = np.zeros(lanes, int)
        self._actions = np.zeros((lanes, actions), np.float32)

    def inputs(self, obs: np.ndarray, clock: np.ndarray) -> np.ndarray:
        """Nothing: (N, 1)."""
        return np.zeros((len(obs), 1), np.float32)

    def act(self, inputs: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Actions, (N, a); those whose time is over are drawn anew."""
        assert rng is not None, "noise needs a generator"
        over = self._left <= 0
        self._actions[over] = rng.standard_normal((int(over.sum()), self._actions.shape[1]), np.float32).clip(
            -1, 1
        )
        self._left[over] = rng.integers(1, self._hold + 1, int(over.sum()))
        self._left -= 1
        return self._actions.copy()


def wild_rollouts(
    env_name: str,
    *,
    lanes: int,
    steps: int,
    every: int,
    seed: int,
    standing: float = 0.0,
    nthread: int | None = None,
) -> Transitions:
    """What random actions do from random states.

    Args:
        env_name: The robot.
        lanes: N.
        steps: T.
        every: Control steps after which a lane starts in another random state.
        seed: Of states and actions.
        standing: Share of the starts that are standing ones.
        nthread: Physics threads.

    Returns:
        The rollouts; ``clock`` counts from each random start.
    """
    env = vector_env.make(env_name, lanes, horizon=every, nthread=nthread)
    collector = Collector(env, seed=seed, rules=RandomStarts(standing, env_name), stagger=False)
    rollouts = collector.collect(HeldNoise(lanes, env.robot.action_size), steps)
    env.close()
    return rollouts
