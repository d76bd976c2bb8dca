"""Figures of any robot against answers known beforehand."""

import numpy as np
import pytest

from onedemo.evaluation.robot_figures import energy, robot_figures, stock_rewards
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env
from onedemo.sim.kinematics import body_of


def still(name, steps=51):
    """A robot that rests, and motors that do nothing."""
    robot = robot_named(name)
    env = vector_env.make(name, 1, nthread=0)
    env.reset(seed=0)
    qpos, qvel = np.tile(env.qpos, (steps, 1)), np.zeros((steps, robot.velocities))
    env.close()
    return robot, qpos, qvel, np.zeros((steps - 1, robot.action_size))


@pytest.mark.parametrize("name", ["hopper", "walker2d", "half-cheetah", "swimmer", "ant", "humanoid"])
def test_the_hand_coded_reward_is_gymnasiums(name):
    """Of the same actions in the batched environment, whose rewards are checked against gymnasium's."""
    robot, rng = robot_named(name), np.random.default_rng(0)
    env = vector_env.make(name, 3, horizon=60, nthread=0)
    env.reset(seed=0)
    states, rewards = [(env.qpos, env.qvel)], []
    actions = rng.uniform(-1.5, 1.5, (3, 40, robot.action_size))
    for step in range(40):
        rewards.append(env.step(actions[:, step])[1])
        states.append((env.qpos, env.qvel))
    env.close()
    qpos, qvel = (np.stack(x, axis=1) for x in zip(*states, strict=True))
    np.testing.assert_allclose(
        stock_rewards(robot, qpos, qvel, actions), np.stack(rewards, axis=1), atol=1e-9
    )
    figures = robot_figures(robot, qpos, qvel, actions)
    assert all(x is None or (x.shape == (3,) and np.isfinite(x).all()) for x in figures.values())
    np.testing.assert_allclose(figures["stock_reward"], np.sum(rewards, axis=0), atol=1e-9)
    assert (figures["energy"] > 0).all()


def test_going_turning_and_leaning_are_told_apart():
    robot, qpos, qvel, actions = still("ant")
    seconds = np.arange(len(qpos)) * robot.dt
    qvel[:, 0], qvel[:, 5] = 1.5, 2 * np.pi / seconds[-1]  # a turn about its own upright axis
    figures = robot_figures(robot, qpos, qvel, actions)
    assert figures["travel"] == pytest.approx(1.5)
    assert figures["turned_round"] == pytest.approx(1.0)
    assert figures["turned_forward"] == pytest.approx(0, abs=1e-9) == figures["turned_sideways"]
    assert figures["height"] == pytest.approx(qpos[0, 2])
    assert figures["upright_seconds"] == pytest.approx(seconds[-1])


def test_a_planar_robot_turns_forward_alone():
    robot, qpos, qvel, actions = still("half-cheetah")
    turn = np.linspace(0, 4 * np.pi, len(qpos))
    qpos[:, 2], qvel[:, 2] = turn, turn[-1] / ((len(qpos) - 1) * robot.dt)
    figures = robot_figures(robot, qpos, qvel, actions)
    # Clockwise, as seen, is whichever way its root joint turns.
    sign = np.sign(body_of(robot).root_rates(qpos, qvel).spin[0, 0])
    assert figures["turned_forward"] == pytest.approx(2 * sign)
    assert "turned_round" not in figures and "turned_sideways" not in figures
    assert figures["upright_seconds"] == pytest.approx(robot.dt * (1 + (turn[1:] <= np.pi / 3).sum()))


def test_a_swimmer_seen_from_above_has_no_upright():
    assert robot_figures(*still("swimmer"))["upright_seconds"] is None


def test_energy_is_torque_times_turning():
    robot, qpos, qvel, actions = still("hopper", steps=126)  # a second
    qvel[:, 3:6], actions[:] = [[1.0, -2.0, 0.0]], [[0.5, 2.0, 1.0]]
    gear = 200.0  # Nm, of each motor of hopper.xml
    assert energy(robot, qpos, qvel, actions) == pytest.approx(gear * (0.5 * 1.0 + 1.0 * 2.0))
