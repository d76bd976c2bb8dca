"""The batched hopper against gymnasium's own, its resets and its saved state."""

from dataclasses import replace

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from helpers.paths import ROOT
from onedemo.errors import UserError
from onedemo.robots import library
from onedemo.robots.robot import Start
from onedemo.sim import vector_env

STEPS = 300


def stock(**options):
    return gymnasium.make("Hopper-v5", terminate_when_unhealthy=False, **options).unwrapped


def actions_for(seed, lanes, steps, scale=1.5):
    # Beyond the motors' range too: they clamp, the control cost does not.
    return np.random.default_rng(seed).uniform(-scale, scale, (steps, lanes, 3))


ROBOTS = {
    "hopper": ("Hopper-v5", {"terminate_when_unhealthy": False}),
    "walker2d": ("Walker2d-v5", {"terminate_when_unhealthy": False}),
    "half-cheetah": ("HalfCheetah-v5", {}),
    "swimmer": ("Swimmer-v5", {}),
    "ant": ("Ant-v5", {"terminate_when_unhealthy": False, "include_cfrc_ext_in_observation": False}),
    "humanoid": (
        "Humanoid-v5",
        {"terminate_when_unhealthy": False}
        | {
            f"include_{part}_in_observation": False
            for part in ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
        },
    ),
}


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_every_robot_observes_what_gymnasium_does(name):
    """300 steps of Gymnasium's environment of the same robot, its solver's warm start cleared before each.

    Ours is cleared, so that a state determines what follows. Not clearing theirs would compare rounding,
    which the tumbling of half-cheetah, ant and humanoid multiplies: the module's docstring has the figures.
    What no state determines (contact forces, inertias of the last stage of the integrator) is switched off.
    """
    number, options = ROBOTS[name]
    env = vector_env.make(name, 2, nthread=0)
    env.reset(seed=5)
    single = [gymnasium.make(number, **options).unwrapped for _ in range(2)]
    for lane, one in enumerate(single):
        one.reset(seed=0)
        one.set_state(env.qpos[lane], env.qvel[lane])
    low, high = np.array(env.robot.low), np.array(env.robot.high)
    worst = 0.0
    for action in np.random.default_rng(1).uniform(-1, 1, (STEPS, 2, len(low))):
        obs, *_ = env.step(action)
        for lane, one in enumerate(single):
            one.data.qacc_warmstart[:] = 0
            expected, *_ = one.step((low + high) / 2 + (high - low) / 2 * action[lane])
            worst = max(worst, np.abs(obs[lane] - expected).max())
    assert worst < 1e-9
    assert np.abs(obs[0] - obs[1]).max() > 0.1, "they moved, each in its way"
    env.close()


@pytest.mark.parametrize("seed", range(4))
def test_equals_gymnasium(seed):
    """Observations and rewards of Hopper-v5 as it ships, 300 steps, falling and tumbling included."""
    env = vector_env.make("hopper", 5, nthread=2)
    env.reset(seed=seed)
    single = [stock() for _ in range(5)]
    for lane, one in enumerate(single):
        one.reset(seed=0)
        one.set_state(env.qpos[lane], env.qvel[lane])
    worst = 0.0
    for action in actions_for(seed, 5, STEPS):
        obs, rewards, *_ = env.step(action)
        for lane, one in enumerate(single):
            expected, reward, *_ = one.step(action[lane])
            worst = max(worst, np.abs(obs[lane] - expected).max(), abs(rewards[lane] - reward))
    assert worst < 1e-9
    env.close()
    assert (obs[:, 0] < 0.7).any(), "no hopper fell: the test saw no contact of other parts"


def test_one_lane_starts_as_gymnasium_does():
    env = vector_env.make("hopper", 1, nthread=0)
    obs, _ = env.reset(seed=7)
    expected, _ = stock().reset(seed=7)
    np.testing.assert_array_equal(obs[0], expected)
    one_step, *_ = env.step(np.zeros((1, 3), np.float32))
    assert one_step.shape == (1, 11)


def test_termination_is_the_stock_rule():
    env = vector_env.make("hopper", 16, nthread=0, terminate_when_unhealthy=True)
    env.reset(seed=0)
    single = gymnasium.make("Hopper-v5").unwrapped
    single.reset(seed=0)
    falls = 0
    for action in actions_for(0, 16, 60):
        before = env.qpos, env.qvel
        _, _, terminated, truncated, infos = env.step(action)
        assert not truncated.any()
        for lane in range(16):
            single.set_state(before[0][lane], before[1][lane])
            single.data.qacc_warmstart[:] = 0
            expected, _, fell, _, _ = single.step(action[lane])
            assert fell == terminated[lane]
            if fell:
                falls += 1
                np.testing.assert_allclose(infos["final_obs"][lane], expected, atol=1e-9)
                assert env.elapsed[lane] == 0
                assert abs(env.qpos[lane, 1] - 1.25) < 0.01
    assert falls > 5


def test_time_limit_truncates_and_restarts_in_the_same_step():
    env = vector_env.make("hopper", 3, horizon=4, nthread=0)
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    env.reset(seed=0)
    for t in range(1, 9):
        obs, _, terminated, truncated, infos = env.step(np.ones((3, 3)))
        assert not terminated.any()
        assert truncated.all() == (t % 4 == 0)
        assert ("final_obs" in infos) == (t % 4 == 0)
    assert infos["_final_obs"].all()
    assert np.abs(infos["final_obs"] - obs).max() > 0.05
    assert (env.elapsed == 0).all()
    np.testing.assert_array_equal(
        infos["final_obs"],
        env.robot.observe(infos["final_qpos"], infos["final_qvel"]),
    )


def test_spaces_and_gymnasium_wrappers():
    env = vector_env.make("hopper", 4, horizon=10, nthread=0)
    wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    obs, _ = wrapped.reset(seed=1)
    assert env.observation_space.contains(obs)
    total = np.zeros(4)
    for _ in range(10):
        env.action_space.seed(0)
        obs, rewards, *_, infos = wrapped.step(env.action_space.sample())
        total += rewards
    np.testing.assert_allclose(infos["episode"]["r"], total)
    assert env.observation_space.contains(obs)
    wrapped.close()


def test_stagger_spreads_the_lanes_over_the_episode():
    env = vector_env.make("hopper", 10, horizon=100, nthread=0)
    env.reset(seed=0, options={"stagger": True})
    assert (env.elapsed == 0).all()
    ends = {}
    for t in range(1, 201):
        _, _, _, truncated, _ = env.step(np.zeros((10, 3)))
        for lane in np.flatnonzero(truncated):
            ends.setdefault(int(lane), []).append(t)
    assert [ends[lane][0] for lane in range(10)] == list(range(100, 0, -10))
    assert all(lane_ends[1] - lane_ends[0] == 100 for lane_ends in ends.values())


def test_reset_mask_leaves_the_other_lanes_alone():
    env = vector_env.make("hopper", 4, nthread=0)
    env.reset(seed=0)
    for action in actions_for(1, 4, 20):
        env.step(action)
    before = env.obs
    mask = np.array([False, True, False, True])
    after, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert (np.abs(after[mask] - before[mask]).max(1) > 0.01).all()
    assert env.elapsed.tolist() == [20, 0, 20, 0]


def test_set_states():
    env = vector_env.make("hopper", 4, horizon=50, nthread=0)
    env.reset(seed=0)
    qpos = np.tile([0.5, 1.4, -2.0, -0.3, -0.5, 0.2], (2, 1))
    qvel = np.tile([1.0, 2.0, -12.0, 0.0, 0.0, 0.0], (2, 1))
    env.set_states(np.array([3, 1]), qpos, qvel, elapsed=np.array([49, 10]))
    np.testing.assert_array_equal(env.qpos[[1, 3]], qpos)
    np.testing.assert_array_equal(env.qvel[[1, 3]], qvel)
    assert env.obs[1, 7] == -10, "observed velocities are clipped"
    _, _, _, truncated, _ = env.step(np.zeros((4, 3)))
    assert truncated.tolist() == [False, False, False, True]
    with pytest.raises(ValueError, match="finite"):
        env.set_states(np.array([0]), qpos[:1] * np.nan, qvel[:1])
    with pytest.raises(ValueError, match="2 lanes"):
        env.set_states(np.array([0, 1]), qpos[:1], qvel[:1])


def test_saved_state_goes_on_exactly():
    def run(env, first, last):
        seen = []
        for action in actions_for(5, 6, 60)[first:last]:
            obs, rewards, _, truncated, _ = env.step(action)
            seen.append((obs, rewards, truncated))
        return seen

    env = vector_env.make("hopper", 6, horizon=25, nthread=2)
    env.reset(seed=3, options={"stagger": True})
    run(env, 0, 30)
    saved = env.state_dict()
    expected = run(env, 30, 60)
    resumed = vector_env.make("hopper", 6, horizon=25, nthread=0)
    resumed.load_state_dict(saved)
    for ours, theirs in zip(run(resumed, 30, 60), expected, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="saved state"):
        vector_env.make("hopper", 5, nthread=0).load_state_dict(saved)


def test_a_lane_whose_physics_becomes_unstable_ends_and_is_counted(tmp_path, monkeypatch):
    """It ends in its last sound state, the others go on, and MuJoCo writes no file about it."""
    monkeypatch.chdir(tmp_path)
    robot = library.choose(ROOT / "tests/data/robots/unstable.xml", "unstable")
    robot = replace(robot, start=Start(positions=0, velocities=0))
    assert robot.frame_skip == 1, "MuJoCo puts it back within the only step: time alone tells"
    for skip, nthread in ((1, 0), (3, 2)):
        env = vector_env.RobotVectorEnv(replace(robot, frame_skip=skip), 4, nthread=nthread)
        env.reset(seed=0)
        rest = env.qpos
        pulled = np.zeros((4, 1))
        pulled[2] = 1
        for _ in range(3):
            before = env.obs
            obs, rewards, terminated, truncated, infos = env.step(pulled)
            ends = infos["final_obs"]
            assert terminated.tolist() == [False, False, True, False] and not truncated.any()
            assert infos["_final_obs"].tolist() == [False, False, True, False]
            np.testing.assert_array_equal(ends[2], before[2])
            assert np.isfinite(obs).all() and np.isfinite(ends).all() and np.isfinite(rewards).all()
            assert env.elapsed.tolist() == [env.elapsed[0], env.elapsed[0], 0, env.elapsed[0]]
        assert env.unstable == 3 and (env.qpos[[0, 1, 3], 2] < rest[[0, 1, 3], 2]).all()
        env.close()
    assert not list(tmp_path.iterdir())


def test_bad_input():
    with pytest.raises(UserError, match="choose one of: ant, half-cheetah, hopper"):
        vector_env.make("hoper", 4)
    with pytest.raises(ValueError, match="at least 1"):
        vector_env.make("hopper", 0)
    env = vector_env.make("hopper", 2, nthread=0)
    with pytest.raises(ValueError, match="actions must be"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="staggr"):
        env.reset(options={"staggr": True})


def test_stepping_without_the_search_for_islands_changes_no_bit():
    """A lane that falls and lies, so that several contacts act at once."""
    ends = []
    for islands in (False, True):
        env = vector_env.make("hopper", 8, nthread=0)
        flag = mujoco.mjtDisableBit.mjDSBL_ISLAND.value
        assert env.model.opt.disableflags & flag
        if islands:
            env.model.opt.disableflags &= ~flag
        env.reset(seed=3)
        actions = np.random.default_rng(3).uniform(-1, 1, (150, 8, 3))
        for action in actions:
            env.step(action)
        ends.append(np.concatenate([env.qpos, env.qvel], axis=1))
        env.close()
    np.testing.assert_array_equal(*ends)
    assert (ends[0][:, 1] < 0.5).any()
