"""MuJoCo Warp against the physics on the processor, on Warp's processor device: no GPU is needed.

Kernels are compiled on the first run (about 20 s) and cached. Tolerances: ``trainer/sim/warp_physics.py``.
"""

import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest

from onedemo.config import load_config
from onedemo.errors import UserError
from onedemo.experiments.speed.figures import Skipped
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import Collector
from onedemo.rl.trpo import Trpo, TrpoConfig
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env
from onedemo.sim.physics import RolloutPhysics, load_model
from onedemo.training.learner import Learner

pytestmark = [
    pytest.mark.slow,  # its kernels are compiled first
    pytest.mark.skipif(  # not imported to see that: each worker collects all tests
        importlib.util.find_spec("mujoco_warp") is None,
        reason="the extra 'warp' is not installed: pip install 'onedemo[warp]'",
    ),
]

LANES = 96
POSITIONS, VELOCITIES = 5e-6, 5e-5


def make(lanes=LANES, **options):
    return vector_env.make("hopper", lanes, physics="warp", **options)


def actions_for(seed, lanes, steps):
    # Beyond the motors' range too: they clamp.
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (steps, lanes, 3))


@pytest.fixture(scope="module")
def states():
    """Positions and velocities of hoppers flying and tumbling, standing, and fallen, a third each."""
    rng = np.random.default_rng(1)
    third = LANES // 3
    qpos = np.tile([0, 1.25, 0, 0, 0, 0], (LANES, 1)) + rng.normal(0, 0.02, (LANES, 6))
    qvel = rng.normal(0, 0.1, (LANES, 6))
    qpos[:third, 1] += rng.uniform(0.2, 1, third)
    qpos[:third, 2] = rng.uniform(-3, 3, third)
    qvel[:third] += rng.normal(0, 3, (third, 6))
    env = vector_env.make("hopper", LANES, nthread=0)
    env.set_states(np.arange(LANES), qpos, qvel)
    for action in actions_for(2, LANES, 300):
        env.step(action)
    fallen = slice(2 * third, None)
    qpos[fallen], qvel[fallen] = env.qpos[fallen], env.qvel[fallen]
    assert (qpos[fallen, 1] < 0.5).mean() > 0.8
    return qpos, qvel


@pytest.fixture(scope="module")
def ours():
    """One for several tests: what a lane did before must not matter."""
    env = make()
    yield env
    env.close()


def started(env, states):
    env.set_states(np.arange(LANES), *states, elapsed=np.zeros(LANES))
    return env


def apart(ours, theirs):
    """How far each lane is from the other environment's: positions, velocities."""
    return np.abs(ours.qpos - theirs.qpos).max(1), np.abs(ours.qvel - theirs.qvel).max(1)


def own_jump(qpos, qvel, action):
    """How far the processor's velocities after one step scatter when the state is moved by rounding."""
    model = load_model(robot_named("hopper").xml)
    physics = RolloutPhysics(model, 4, 200, 0)
    state = np.tile(np.concatenate([[0], qpos, qvel]), (200, 1))
    state[1:, 1:] += np.random.default_rng(0).normal(0, 5e-7, (199, 12))
    after = physics.step(state, np.tile(action, (200, 1)))
    physics.close()
    return np.abs(after - after[0])[:, 7:].max()


def test_each_step_agrees_with_the_processor(ours, states):
    """Every lane within tolerance, unless a contact sets in or not: the processor's answer jumps too."""
    theirs = started(vector_env.make("hopper", LANES, nthread=0), states)
    beyond = 0
    for action in actions_for(3, LANES, 60):
        before = theirs.qpos, theirs.qvel
        started(ours, before)
        obs, rewards, *_ = ours.step(action)
        expected, expected_rewards, *_ = theirs.step(action)
        positions, velocities = apart(ours, theirs)
        agrees = (positions < POSITIONS) & (velocities < VELOCITIES)
        for lane in np.flatnonzero(~agrees):
            beyond += 1
            assert velocities[lane] < 2 * own_jump(before[0][lane], before[1][lane], action[lane])
        np.testing.assert_allclose(obs[agrees], expected[agrees], atol=VELOCITIES)
        # The reward divides a difference of positions by 8 ms.
        np.testing.assert_allclose(rewards[agrees], expected_rewards[agrees], atol=2 * POSITIONS / 0.008)
    assert beyond < 5


def test_trajectories_agree_as_long_as_chaos_lets_them(ours, states):
    theirs = started(vector_env.make("hopper", LANES, nthread=0), states)
    started(ours, states)
    seen = {}
    for step, action in enumerate(actions_for(4, LANES, 100), start=1):
        ours.step(action)
        theirs.step(action)
        positions, velocities = apart(ours, theirs)
        seen[step] = [np.quantile(error, q) for error in (positions, velocities) for q in (0.5, 0.9)]
    for step, bound in {1: 1, 5: 2, 25: 5, 100: 40}.items():
        np.testing.assert_array_less(seen[step], np.multiply(bound, [5e-7, 1e-6, 2e-6, 5e-6]))


def test_a_lane_depends_on_its_own_state_alone(ours, states):
    """Not on what it did before, nor on its neighbours, nor on how many they are: to the last bit."""
    action = actions_for(5, LANES, 1)[0]
    fresh = started(make(), states)
    fresh.step(action)
    ours.reset(seed=0)
    for other in actions_for(6, LANES, 30):
        ours.step(other)
    started(ours, states).step(action)
    np.testing.assert_array_equal(ours.qpos, fresh.qpos)
    np.testing.assert_array_equal(ours.qvel, fresh.qvel)
    few = make(5)
    chosen = np.array([80, 3, 50, 70, 20])
    few.set_states(np.arange(5), states[0][chosen], states[1][chosen])
    few.step(action[chosen])
    np.testing.assert_array_equal(few.qvel, fresh.qvel[chosen])


def test_episodes_end_and_begin_as_on_the_processor():
    ours, theirs = make(8, horizon=10), vector_env.make("hopper", 8, horizon=10, nthread=0)
    for env in (ours, theirs):
        env.reset(seed=3, options={"stagger": True})
    np.testing.assert_array_equal(ours.qpos, theirs.qpos)
    ends = 0
    for action in actions_for(7, 8, 25):
        obs, _, _, truncated, infos = ours.step(action)
        expected, _, _, expected_truncated, expected_infos = theirs.step(action)
        np.testing.assert_array_equal(truncated, expected_truncated)
        np.testing.assert_array_equal(obs[truncated], expected[truncated])  # the same new start
        np.testing.assert_allclose(obs, expected, atol=1e-4)
        ends += truncated.sum()
        if infos:
            np.testing.assert_allclose(infos["final_qpos"], expected_infos["final_qpos"], atol=1e-5)
    assert ends > 8
    np.testing.assert_allclose(
        ours.state_dict()["state"][:, 0], theirs.state_dict()["state"][:, 0], atol=1e-12
    )


def test_saved_state_goes_on_exactly():
    env = make(6, horizon=25)
    env.reset(seed=3, options={"stagger": True})
    actions = actions_for(8, 6, 60)
    for action in actions[:30]:
        env.step(action)
    saved = env.state_dict()
    resumed = make(6, horizon=25)
    resumed.load_state_dict(saved)
    for action in actions[30:]:
        for ours, theirs in zip(resumed.step(action)[:4], env.step(action)[:4], strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_learning_works_on_it():
    env = make(16, horizon=50)
    policy = Policy(PolicyConfig(), obs_size=11, action_size=3, horizon=50, seed=0)
    collector = Collector(env, seed=0)
    trpo = Trpo(policy, TrpoConfig(), seed=0)
    for _ in range(2):
        batch = collector.collect(policy.snapshot(), 25)
        assert batch.obs.shape == (16, 25, 11) and np.isfinite(batch.next_qvel).all()
        assert batch.truncated.any()
        stats = trpo.update(batch)
        assert 0 < stats.kl <= TrpoConfig().max_kl
    env.close()


def test_a_run_can_be_set_to_it():
    """The first steps of the random policy are the processor's, but for rounding."""
    config = load_config(None, {"method": "paper", "rollouts.lanes": 4, "rollouts.threads": 1})
    on_warp = replace(config, rollouts=replace(config.rollouts, physics="warp"))
    first, second = (Learner(c, 30, 30.0).random_rollouts().qpos[:, 1:6] for c in (config, on_warp))
    assert 0 < np.abs(first - second).max() < 1e-5


@pytest.mark.parametrize("room", [(1, 41), (14, 12)])
def test_contacts_without_room_are_an_error(room):
    from onedemo.sim import warp_physics

    lying = np.tile([0, 0.05, -np.pi / 2, 0, 0, 0], (4, 1))
    model = load_model(robot_named("hopper").xml)
    states = np.concatenate([np.zeros((4, 1)), lying, np.zeros((4, 6))], axis=1)
    warp_physics.WarpPhysics(model, 4, 4).step(states, np.zeros((4, 3)))
    with pytest.raises(RuntimeError, match=f"room for, {room[0]} a lane with {room[1]} constraints"):
        warp_physics.WarpPhysics(model, 4, 4, room=room).step(states, np.zeros((4, 3)))


def test_an_unknown_device_names_those_there_are():
    from onedemo.sim.warp_physics import WarpPhysics

    with pytest.raises(UserError, match=r"no device 'cuda:7' .* there are: cpu"):
        WarpPhysics(load_model(robot_named("hopper").xml), 4, 1, device="cuda:7")


def test_without_the_package_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    monkeypatch.delitem(sys.modules, "onedemo.sim.warp_physics", raising=False)
    with pytest.raises(UserError, match=r"pip install 'onedemo\[warp\]'"):
        make(2)


def test_an_unknown_physics_is_refused():
    with pytest.raises(ValueError, match="must be 'mujoco' or 'warp', got 'wrap'"):
        vector_env.make("hopper", 2, physics="wrap")


def test_the_bench_counts_steps_of_both():
    from onedemo.experiments.speed.warp import growth, measure

    taken = growth((2, 8), device="cpu", turns=1, lane_steps=64)
    assert set(taken.y) == {"mujoco", "warp"}
    assert all(len(line) == 2 and min(line) > 10 for line in taken.y.values())
    import warp

    if not warp.is_cuda_available():
        (skipped,) = measure(quick=True)
        assert isinstance(skipped, Skipped) and "no CUDA device" in skipped.reason
