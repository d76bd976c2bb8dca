"""What a move was worth: turns, clean turns and the hand-coded rewards, from stored states.

Pure functions on arrays; no simulator runs here. The torso angle grows when the hopper leans
forward, so a backflip turns it by -2 pi.

Shapes: T states or steps along the last time axis, "..." any lanes before it, o observations,
a = 3 actions, q = 6 positions (x, z, torso angle, thigh, leg and foot joints).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from onedemo.sim import vector_env

CONTACT_MARGIN = 0.002
"""Metres between a part and the ground at which MuJoCo's contact sets in: a part can lie on the
ground at rest without reaching it. Both geoms have a margin of 0.001 (hopper.xml); MuJoCo 4 adds
them up."""

LANDED_LEAN = 0.5
"""Radians, 29 degrees: a torso no further from upright stands."""
LANDED_WITHIN_S = 0.5
"""Seconds after a turn by which the robot must stand."""
LANDED_FOR_S = 0.2
"""Seconds that it must stand: a robot that rolls on at a turn a second is upright for 0.16 s."""

# hopper.xml: length of each part along its own axis from joint to joint, metres.
_HALF_TORSO, _THIGH, _LEG = 0.2, 0.45, 0.5
_HEEL, _TOE = -0.13, 0.26  # ends of the foot, before and behind the ankle
_RADII = {"torso": 0.05, "thigh": 0.05, "leg": 0.04, "foot": 0.06}


def net_turns(torso_angle: np.ndarray) -> np.ndarray:
    """Backward turns from the first state to the last, forward turns counted against them.

    Rounded towards zero: a slight forward lean must not read as -1.

    Args:
        torso_angle: Radians, (..., T); wrapped angles are unwrapped.

    Returns:
        Whole turns, (...), int.
    """
    angle = np.unwrap(torso_angle, axis=-1)
    return np.trunc((angle[..., 0] - angle[..., -1]) / (2 * np.pi)).astype(int)


def turned(torso_angle: np.ndarray) -> np.ndarray:
    """Backward rotation from the first state to the last in turns, (..., T) radians to (...), not rounded."""
    angle = np.unwrap(torso_angle, axis=-1)
    return (angle[..., 0] - angle[..., -1]) / (2 * np.pi)


def farthest_turn(torso_angle: np.ndarray) -> np.ndarray:
    """The farthest backward rotation between any two states in order, turns: (..., T) radians to (...).

    A flip that starts from a forward lean, or after which the robot falls on its face, is seen whole.
    """
    angle = np.unwrap(torso_angle, axis=-1)
    return (np.maximum.accumulate(angle, axis=-1) - angle).max(axis=-1) / (2 * np.pi)


def clean_turns(qpos: np.ndarray) -> np.ndarray:
    """Backward turns made without any part but the foot touching the ground.

    Over each longest stretch of time in which nothing but the foot touches the ground, the net
    backward rotation is rounded towards zero to whole turns; the stretches are summed. Rolling
    over the torso therefore counts nothing, however fast.

    Args:
        qpos: Positions, (..., T, q).

    Returns:
        Whole turns, (...), int.
    """
    lanes = qpos.reshape(-1, *qpos.shape[-2:])
    turns = [_clean_turns(q[:, 2], ~touch) for q, touch in zip(lanes, fallen(lanes), strict=True)]
    return np.array(turns, int).reshape(qpos.shape[:-2])


def landings(qpos: np.ndarray, dt: float) -> np.ndarray:
    """Backward turns after which the robot stands.

    A turn is over when the torso first comes within ``LANDED_LEAN`` of the upright after it. It is landed
    if within ``LANDED_WITHIN_S`` the robot stands on its foot alone, and stays so for ``LANDED_FOR_S``:
    the torso within ``LANDED_LEAN`` of *that* upright, neither torso nor thigh nor leg on the ground,
    and the foot on it at the beginning. How the turn was made does not matter: see ``clean_turns``.

    Args:
        qpos: Positions, (..., T, q), the first of them about upright.
        dt: Seconds between them.

    Returns:
        Turns landed, (...), int; each counts once.
    """
    lanes = qpos.reshape(-1, *qpos.shape[-2:])
    grounded = clearances(lanes)["foot"] < CONTACT_MARGIN
    within, stay = round(LANDED_WITHIN_S / dt), round(LANDED_FOR_S / dt)
    landed = [
        _landings(np.unwrap(q[:, 2]), on_foot, touch, within, stay)
        for q, on_foot, touch in zip(lanes, grounded, fallen(lanes), strict=True)
    ]
    return np.array(landed, int).reshape(qpos.shape[:-2])


def fallen(qpos: np.ndarray) -> np.ndarray:
    """Whether torso, thigh or leg touches the ground.

    Args:
        qpos: Positions, (..., q).

    Returns:
        True where one does, (...).
    """
    gaps = clearances(qpos)
    return np.minimum.reduce([gaps["torso"], gaps["thigh"], gaps["leg"]]) < CONTACT_MARGIN


def clearances(qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Distance of the ground from each part's capsule, negative inside it.

    Args:
        qpos: Positions, (..., q).

    Returns:
        Metres, (...), of "torso", "thigh", "leg" and "foot".
    """
    z = {name: point[..., 1] for name, point in joint_points(qpos).items()}
    ends = {
        "torso": (z["top"], z["hip"]),
        "thigh": (z["hip"], z["knee"]),
        "leg": (z["knee"], z["ankle"]),
        "foot": (z["heel"], z["toe"]),
    }
    return {part: np.minimum(a, b) - _RADII[part] for part, (a, b) in ends.items()}


def joint_points(qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Where the hopper's joints and ends are: forward kinematics in the plane.

    Args:
        qpos: Positions, (..., q).

    Returns:
        (x, z) in metres, (..., 2), of "top", "hip", "knee", "ankle", "heel" and "toe".
    """
    torso = qpos[..., 2]
    # Joint axes point the other way than the torso's, so joint angles are subtracted.
    thigh, leg, foot = (torso - qpos[..., 3 : 3 + n].sum(-1) for n in (1, 2, 3))
    centre = qpos[..., :2]
    hip = centre - _HALF_TORSO * _up(torso)
    knee = hip - _THIGH * _up(thigh)
    ankle = knee - _LEG * _up(leg)
    return {
        "top": centre + _HALF_TORSO * _up(torso),
        "hip": hip,
        "knee": knee,
        "ankle": ankle,
        "heel": ankle + _HEEL * _ahead(foot),
        "toe": ankle + _TOE * _ahead(foot),
    }


def backflip_reward(next_obs: np.ndarray, actions: np.ndarray, *, clip_actions: bool = True) -> np.ndarray:
    """The hand-coded backflip reward known from the human-preferences literature.

    backroll (1 + 0.3 height + 0.1 work + 0.05 backslide), where backroll is the backward torso
    spin, work the sum of action times joint velocity, and backslide the backward speed
    (published beside Christiano et al. 2017). It also pays for thrashing limbs: report turns
    beside it.

    Args:
        next_obs: Observation after each step, (..., 11).
        actions: Action of each step, (..., 3).
        clip_actions: Count what the motors do (-1..1) rather than what the policy asked for.

    Returns:
        Reward per step, (...).
    """
    motors = np.clip(actions, -1, 1) if clip_actions else actions
    height, backslide, backroll = next_obs[..., 0], -next_obs[..., 5], -next_obs[..., 7]
    work = (motors * next_obs[..., 8:11]).sum(-1)
    return backroll * (1 + 0.3 * height + 0.1 * work + 0.05 * backslide)


def hop_reward(
    qpos: np.ndarray, next_qpos: np.ndarray, next_qvel: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """The reward of Hopper-v5: forward speed, upright, small actions.

    Unlike the stock environment nothing ends at a fall; ``until_fall`` cuts the sum there.

    Args:
        qpos: Positions before each step, (..., q).
        next_qpos: Positions after it, (..., q).
        next_qvel: Velocities after it, (..., v).
        actions: (..., a), not clipped.

    Returns:
        Reward per step, (...).
    """
    hopper = vector_env.spec("hopper")
    forward = (next_qpos[..., 0] - qpos[..., 0]) / hopper.dt
    upright = hopper.healthy_reward * vector_env.healthy(hopper, next_qpos, next_qvel)
    return forward + upright - hopper.control_cost * np.square(actions).sum(-1)


def until_fall(next_qpos: np.ndarray, next_qvel: np.ndarray) -> np.ndarray:
    """Whether each step belongs to the stock Hopper-v5 episode, the step that falls included.

    Args:
        next_qpos: Positions after each step, (..., T, q).
        next_qvel: Velocities after each step, (..., T, v).

    Returns:
        True up to the first fall, (..., T). The stock return is the sum of the rewards there.
    """
    upright = vector_env.healthy(vector_env.spec("hopper"), next_qpos, next_qvel)
    before = np.concatenate([np.ones_like(upright[..., :1]), upright[..., :-1]], axis=-1)
    return np.logical_and.accumulate(before, axis=-1)


def _backflip_task(
    next_obs: np.ndarray,
    actions: np.ndarray,
    qpos: np.ndarray,
    next_qpos: np.ndarray,
    next_qvel: np.ndarray,
) -> np.ndarray:
    return backflip_reward(next_obs, actions)


def _hop_task(
    next_obs: np.ndarray,
    actions: np.ndarray,
    qpos: np.ndarray,
    next_qpos: np.ndarray,
    next_qvel: np.ndarray,
) -> np.ndarray:
    return hop_reward(qpos, next_qpos, next_qvel, actions)


TaskReward = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]

TASK_REWARDS: dict[str, TaskReward] = {"backflip": _backflip_task, "hop": _hop_task}
"""Hand-coded reward of each task: (next_obs, actions, qpos, next_qpos, next_qvel), each
(..., n), to reward per step, (...)."""


def task_reward(
    task: str, obs: np.ndarray, actions: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
) -> np.ndarray:
    """The hand-coded reward of whole episodes, per step.

    Args:
        task: A key of ``TASK_REWARDS``.
        obs: (..., T + 1, o).
        actions: (..., T, a).
        qpos: (..., T + 1, q).
        qvel: (..., T + 1, v).

    Returns:
        (..., T).
    """
    after = (..., slice(1, None), slice(None))
    before = (..., slice(None, -1), slice(None))
    return TASK_REWARDS[task](obs[after], actions, qpos[before], qpos[after], qvel[after])


def _clean_turns(angle_T: np.ndarray, clean_T: np.ndarray) -> int:
    edges = np.diff(np.concatenate([[False], clean_T, [False]]).astype(int))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    angle_T = np.unwrap(angle_T)
    return int(np.trunc((angle_T[first] - angle_T[last]) / (2 * np.pi)).sum())


def _landings(
    angle_T: np.ndarray, on_foot_T: np.ndarray, fallen_T: np.ndarray, within: int, stay: int
) -> int:
    landed, turn = 0, 1
    while (over_T := angle_T <= LANDED_LEAN - 2 * np.pi * turn).any():
        first = int(over_T.argmax())
        upright_T = (np.abs(angle_T + 2 * np.pi * turn) <= LANDED_LEAN) & ~fallen_T
        tries = [t for t in range(first, first + within + 1) if t + stay <= len(angle_T)]
        landed += any(on_foot_T[t] and upright_T[t : t + stay].all() for t in tries)
        turn += 1
    return landed


def _up(angle: np.ndarray) -> np.ndarray:
    """Unit vector (x, z) along a part that points up at angle 0."""
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def _ahead(angle: np.ndarray) -> np.ndarray:
    """Unit vector (x, z) along a part that points ahead at angle 0."""
    return np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
