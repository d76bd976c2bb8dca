"""States that nobody has to reach first: random ones, for clips to ask about and for episodes to start in.

A random policy from a standing start never shows a flip, so no rating could ever say that a flip is
right. Random states of the robot, let go for a second, show a bit of everything that it can do.

Shapes: n states, N lanes, T control steps, q = v = 6 positions and velocities.
"""

from __future__ import annotations

import numpy as np

from onedemo.rl.rollouts import Collector, EpisodeRules, Starts, Transitions
from onedemo.sim import vector_env
from onedemo.sim.kinematics import clearances

_JOINTS = np.array([[-2.6, 0.05], [-2.6, 0.05], [-0.78, 0.78]])
"""Range of thigh, leg and foot, radians: that of the model's joints (hopper.xml), whose stops are soft."""
_HEIGHTS = (0.05, 1.9)
"""Metres, of the torso's centre."""
_SPREADS = np.array([1.5, 2.0, 6.0, 4.0, 4.0, 4.0])
"""Standard deviation of each velocity, m/s and rad/s."""
_SUNK = 0.05
"""Metres that a part may reach into the ground: contacts push it out within a few steps."""


def random_states(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """States spread over what the robot can be in: any torso angle, spin and height above the ground.

    Args:
        count: n.
        rng: Draws them.

    Returns:
        Positions (n, q), x = 0, and velocities (n, v).
    """
    kept = [np.zeros((0, 6))]
    while sum(map(len, kept)) < count:
        qpos = np.zeros((2 * count, 6))
        qpos[:, 1] = rng.uniform(*_HEIGHTS, len(qpos))
        qpos[:, 2] = rng.uniform(-np.pi, np.pi, len(qpos))
        qpos[:, 3:] = rng.uniform(_JOINTS[:, 0], _JOINTS[:, 1], (len(qpos), 3))
        lowest = np.minimum.reduce(list(clearances(qpos).values()))
        kept.append(qpos[lowest > -_SUNK])
    qpos = np.concatenate(kept)[:count]
    return qpos, rng.normal(0.0, _SPREADS, (count, len(_SPREADS)))


class RandomStarts(EpisodeRules):
    """Episodes start in a random state.

    Args:
        standing: Share of lanes that start standing all the same.
    """

    def __init__(self, standing: float = 0.0) -> None:
        self._standing = standing

    def start(self, lanes: np.ndarray, rng: np.random.Generator) -> Starts | None:
        """Random states at demo step 0."""
        lanes = lanes[rng.random(len(lanes)) >= self._standing]
        qpos, qvel = random_states(len(lanes), rng)
        return Starts(lanes=lanes, qpos=qpos, qvel=qvel, clock=np.zeros(len(lanes), np.int32))


class HeldNoise:
    """A policy that sees nothing: random actions, each held for a few steps, so that they add up.

    Args:
        lanes: N.
        hold: Control steps that an action is held, at most.
    """

    mean = np.zeros(1)

    def __init__(self, lanes: int, hold: int = 10) -> None:
        self._hold = hold
        self._left = np.zeros(lanes, int)
        self._actions = np.zeros((lanes, 3), np.float32)

    def inputs(self, obs: np.ndarray, clock: np.ndarray) -> np.ndarray:
        """Nothing: (N, 1)."""
        return np.zeros((len(obs), 1), np.float32)

    def act(self, inputs: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Actions, (N, a); those whose time is over are drawn anew."""
        assert rng is not None, "noise needs a generator"
        over = self._left <= 0
        self._actions[over] = rng.standard_normal((int(over.sum()), 3), np.float32).clip(-1, 1)
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
    collector = Collector(env, seed=seed, rules=RandomStarts(standing), stagger=False)
    rollouts = collector.collect(HeldNoise(lanes), steps)
    env.close()
    return rollouts
