"""Pose and motion against MuJoCo's own kinematics and against states that were simulated."""

import mujoco
import numpy as np
import pytest

from onedemo.annotators.oracle import appearance
from onedemo.rl.random_states import random_states, wild_rollouts
from onedemo.robots.hopper import clearances
from onedemo.robots.registry import robot_named
from onedemo.sim import kinematics
from onedemo.sim.kinematics import body_of

BODY = body_of(robot_named("hopper"))

HOPPER = robot_named("hopper")


@pytest.fixture(scope="module")
def states():
    """Random states; the torso has turned several times in some."""
    rng = np.random.default_rng(0)
    qpos, qvel = random_states(200, rng)
    qpos[:, 2] += 2 * np.pi * rng.integers(-3, 4, len(qpos))
    return qpos, qvel


def test_pose_is_where_mujoco_puts_the_parts(states):
    model = mujoco.MjModel.from_xml_path(str(HOPPER.xml))
    data = mujoco.MjData(model)
    for qpos, pose in zip(states[0], BODY.pose(HOPPER.observe(*states)), strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        assert pose[0] == pytest.approx(kinematics.HEIGHT_SCALE * data.body("torso").xpos[2])
        for part, (sine, cosine) in zip(
            ("torso", "thigh", "leg", "foot"), pose[1:].reshape(4, 2), strict=True
        ):
            up = data.body(part).xmat.reshape(3, 3)[:, 2]  # a part's own axis, which points up at angle 0
            np.testing.assert_allclose([sine, cosine], up[[0, 2]], atol=1e-9, err_msg=part)


def test_the_rater_looks_at_the_same_directions(states):
    weights = np.repeat([1.0, 0.7, 0.7, 0.5], 2)
    seen = appearance(*states, BODY)[:, 1:9] / weights
    np.testing.assert_allclose(BODY.pose(HOPPER.observe(*states))[:, 1:], seen, atol=1e-9)


def test_motion_is_how_the_pose_changes_in_a_simulation():
    rollouts = wild_rollouts("hopper", lanes=32, steps=60, every=60, seed=0, nthread=0)
    pose, motion = BODY.pose(rollouts.obs), BODY.motion(rollouts.obs)
    change = (pose[:, 2:] - pose[:, :-2]) / (2 * HOPPER.dt) * kinematics.MOTION_SCALE
    # Contacts and the limits of what is observed make jumps that no derivative follows.
    slow = (np.abs(motion) < 1.2).all(axis=-1) & (np.abs(rollouts.qvel) < 9).all(axis=-1)
    free = np.minimum.reduce(list(clearances(rollouts.qpos).values())) > 0.05
    looked_at = (slow & free)[:, 1:-1]
    assert looked_at.sum() > 300
    error = np.abs(change - motion[:, 1:-1])[looked_at]
    assert np.median(error, axis=0).max() < 0.01
    assert np.quantile(error, 0.95, axis=0).max() < 0.1
    assert np.abs(motion[:, 1:-1][looked_at]).mean(axis=0).min() > 0.1  # there was something to follow


def test_motion_is_the_derivative_of_the_pose(states):
    """One step along the velocities, with no physics in it."""
    qpos, qvel = states
    qvel = np.clip(qvel, -5, 5) / 2  # within what is observed and shown
    after, before = (BODY.pose(HOPPER.observe(qpos + h * qvel, qvel)) for h in (1e-5, -1e-5))
    derivative = kinematics.MOTION_SCALE * (after - before) / 2e-5
    np.testing.assert_allclose(BODY.motion(HOPPER.observe(qpos, qvel)), derivative, atol=1e-6)


def test_motion_is_limited():
    obs = np.zeros((2, 11))
    obs[:, 7:11] = [[10, -10, -10, -10], [0, 0, 0, 0]]  # the foot turns at 40 rad/s
    fast, still = BODY.motion(obs)
    assert np.abs(fast).max() == pytest.approx(kinematics.MOTION_SCALE * 12)
    assert not still.any()


def test_shapes_and_turns():
    obs = np.random.default_rng(1).normal(size=(2, 3, 11))
    turned = obs + 2 * np.pi * np.eye(11)[1]
    assert BODY.pose(obs).shape == BODY.motion(obs).shape == (2, 3, BODY.pose_size)
    np.testing.assert_allclose(BODY.pose(turned), BODY.pose(obs), atol=1e-9)
    np.testing.assert_allclose(BODY.motion(turned), BODY.motion(obs), atol=1e-9)
