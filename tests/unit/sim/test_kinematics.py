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


# Any robot


@pytest.mark.parametrize("name", ["hopper", "walker2d", "half-cheetah", "ant", "humanoid"])
def test_what_touches_the_ground_is_what_mujoco_says(name):
    """There is contact where MuJoCo has one with the floor, which sets in at up to 2 cm."""
    robot, body = robot_named(name), body_of(robot_named(name))
    rollouts = wild_rollouts(name, lanes=8, steps=40, every=20, seed=0, nthread=0)
    qpos = rollouts.qpos[:, ::8].reshape(-1, robot.positions)
    obs = robot.observe(qpos, np.zeros((len(qpos), robot.velocities)))
    model = mujoco.MjModel.from_xml_path(str(robot.xml))
    data, floor = mujoco.MjData(model), np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    touches = []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        touches.append(any(np.isin(data.contact[c].geom, floor).any() for c in range(data.ncon)))
    contact, touches = body.contact(obs), np.array(touches)
    lowest = np.minimum.reduce(list(body.clearances(qpos).values()))
    np.testing.assert_allclose(contact, np.clip(1 - lowest / kinematics.CONTACT_REACH, 0, 1), atol=1e-9)
    assert touches.any() and not touches.all()
    assert contact[touches].min() > 0.3 and contact[lowest > 0.03].max() == 0


@pytest.mark.parametrize("name", ["walker2d", "half-cheetah", "swimmer", "ant", "humanoid"])
def test_the_motion_of_any_robot_is_the_derivative_of_its_pose(name):
    robot, body = robot_named(name), body_of(robot_named(name))
    rollouts = wild_rollouts(name, lanes=8, steps=20, every=20, seed=0, nthread=0)
    qpos = rollouts.qpos[:, 5]
    qvel = np.clip(rollouts.qvel[:, 5], -1, 1)
    if name == "swimmer":  # followed up the picture, too: its height is never another
        qvel[:, 1] = 0
    model = mujoco.MjModel.from_xml_path(str(robot.xml))
    after = qpos.copy()
    for q, v in zip(after, qvel, strict=True):
        mujoco.mj_integratePos(model, q, v, 1e-6)
    change = (body.pose(robot.observe(after, qvel)) - body.pose(robot.observe(qpos, qvel))) / 1e-6
    motion = body.motion(robot.observe(qpos, qvel)) / kinematics.MOTION_SCALE
    np.testing.assert_allclose(motion, change, atol=1e-4)
    assert body.pose(robot.observe(qpos, qvel)).shape == (8, body.pose_size)


def test_ends_are_compared_where_directions_do_not_say_where_they_are():
    """Limbs that hang at each other's ends need none; a humanoid's hips are beside its spine."""
    sizes = {name: body_of(robot_named(name)) for name in ("hopper", "walker2d", "ant", "humanoid")}
    ends = {name: (body.pose_size - 1) // 2 - len(body.weights) for name, body in sizes.items()}
    assert ends["hopper"] == ends["walker2d"] == ends["ant"] == 0 < ends["humanoid"]
    hopper, rollouts = sizes["hopper"], wild_rollouts("hopper", lanes=8, steps=40, every=20, seed=0)
    qpos = rollouts.qpos.reshape(-1, 6)
    points = np.stack(list(hopper.points(qpos).values()), axis=1) - qpos[:, None, None, :2]
    known = np.concatenate([np.ones((len(qpos), 1)), hopper.axes(qpos).reshape(len(qpos), -1)], axis=1)
    wanted = points.reshape(len(qpos), -1)
    found = known @ np.linalg.lstsq(known, wanted, rcond=None)[0]
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_what_is_rigid_or_small_counts_less():
    assert BODY.weights.tolist() == [1.0, 0.7, 0.7, 0.5]
    ant = body_of(robot_named("ant"))
    assert ant.weights.tolist() == [1, 1, 1, *([0, 0.7, 0.5] * 4)]  # hips are one piece with the torso
