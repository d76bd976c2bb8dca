"""The built-in robots: what they say of their models, and their kinematics against MuJoCo's own."""

import mujoco
import numpy as np
import pytest

from onedemo.errors import UserError
from onedemo.rl.random_states import random_states
from onedemo.robots import hopper
from onedemo.robots.registry import BUILT_IN, robot_named
from onedemo.robots.robot import body_name, model_of
from onedemo.sim import vector_env
from onedemo.sim.kinematics import HEIGHT_SCALE, MOTION_SCALE, body_of


@pytest.fixture(params=sorted(BUILT_IN))
def of(request):
    return robot_named(request.param)


@pytest.fixture
def states(of):
    qpos, qvel = random_states(20, np.random.default_rng(0), of.name)
    return qpos, 0.3 * qvel


def test_a_robot_says_what_its_model_is(of):
    env = vector_env.make(of.name, 2, nthread=0)
    obs, _ = env.reset(seed=0)
    assert env.model.opt.timestep == of.timestep
    assert (env.model.nq, env.model.nv, env.model.nu) == (of.positions, of.velocities, of.action_size)
    assert obs.shape == (2, of.obs_size)
    names = [body_name(env.model, b) for b in range(env.model.nbody)]
    assert set(of.limbs) <= set(names) and set(of.feet) <= set(of.limbs)
    env.close()


def test_an_observation_tells_the_state(of, states):
    qpos, qvel = of.state(of.observe(*states))
    assert not qpos[:, : of.unseen].any()
    np.testing.assert_array_equal(qpos[:, of.unseen :], states[0][:, of.unseen :])
    np.testing.assert_array_equal(qvel, np.clip(states[1], -of.velocity_limit, of.velocity_limit))


def test_parts_are_where_mujoco_puts_them(of, states):
    body, model = body_of(of), model_of(of.xml)
    data, names = mujoco.MjData(model), [body_name(model, b) for b in range(model.nbody)]
    gaps, points = body.clearances(states[0]), body.points(states[0])
    poses = body.pose(of.observe(*states))
    placed = body._place(states[0])
    spins, speeds = body._move(states[1], placed)
    for row, (qpos, qvel) in enumerate(zip(*states, strict=True)):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        root = data.body(of.limbs[0])
        height = root.xpos[of.camera.up] if of.name != "swimmer" else 0.0  # whom the camera follows up, too
        assert poses[row, 0] == pytest.approx(HEIGHT_SCALE * height)
        for name in of.limbs:
            number, speed = names.index(name), np.zeros(6)
            np.testing.assert_allclose(
                placed.positions[number][row], data.xpos[number], atol=1e-9, err_msg=name
            )
            np.testing.assert_allclose(placed.rotations[number][row].ravel(), data.xmat[number], atol=1e-9)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, number, speed, 0)
            np.testing.assert_allclose(
                np.concatenate([spins[number][row], speeds[number][row]]), speed, atol=1e-8
            )
            assert gaps[name].shape == (20,) and points[name].shape == (20, 2, 2)


def test_motion_is_the_derivative_of_the_pose(of, states):
    """One step along the velocities, with no physics in it."""
    body, model = body_of(of), model_of(of.xml)
    qpos, qvel = states
    poses = []
    for h in (1e-5, -1e-5):
        moved = qpos.copy()
        for place, velocity in zip(moved, qvel, strict=True):
            mujoco.mj_integratePos(model, place, velocity, h)
        poses.append(body.pose(of.observe(moved, qvel)))
    derivative = MOTION_SCALE * (poses[0] - poses[1]) / 2e-5
    small = np.abs(derivative) < 1.5  # motion is limited
    motion = body.motion(of.observe(qpos, qvel))
    small[:, 0] &= of.name != "swimmer"
    np.testing.assert_allclose(motion[small], derivative[small], atol=1e-6)
    assert small.mean() > 0.8 and motion.shape == (20, body.pose_size)


def test_planar_robots_are_known_as_such():
    planar = {name for name in BUILT_IN if body_of(robot_named(name)).planar}
    assert planar == {"hopper", "walker2d", "half-cheetah", "swimmer"}
    assert {name: robot_named(name).angles for name in sorted(BUILT_IN)} == {
        "ant": (), "half-cheetah": (1,), "hopper": (1,), "humanoid": (), "swimmer": (0,), "walker2d": (1,)
    }  # fmt: skip


def test_the_hoppers_own_geometry_is_that_of_its_model():
    qpos, _ = random_states(50, np.random.default_rng(1))
    general, own = body_of(robot_named("hopper")).clearances(qpos), hopper.clearances(qpos)
    for name, gap in own.items():
        np.testing.assert_allclose(general[name], gap, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(body_of(robot_named("hopper")).fallen(qpos), hopper.fallen(qpos))


def test_an_unknown_robot():
    with pytest.raises(UserError, match="unknown robot 'hoper'; choose one of: ant, half-cheetah, hopper"):
        robot_named("hoper")
