"""Turns, contact and rewards against MuJoCo, gymnasium and values worked by hand."""

import mujoco
import numpy as np
import pytest

from onedemo.demos.ground_truth import load_hidden
from onedemo.demos.library import BUILT_IN
from onedemo.evaluation import metrics
from onedemo.robots import hopper
from onedemo.sim import task_rewards, vector_env

DT = 0.008


def test_net_turns():
    two_and_a_half = np.linspace(0, -5 * np.pi, 200)
    assert metrics.net_turns(two_and_a_half) == 2
    assert metrics.net_turns(-two_and_a_half) == -2
    assert metrics.net_turns(np.array([0.0, 0.1])) == 0, "a slight forward lean is no turn"
    wrapped = np.angle(np.exp(1j * two_and_a_half))
    assert metrics.net_turns(wrapped) == 2
    there_and_back = np.concatenate([two_and_a_half, two_and_a_half[::-1]])
    np.testing.assert_array_equal(metrics.net_turns(np.stack([there_and_back, np.zeros(400)])), [0, 0])


def path(angles, heights):
    """A stiff hopper whose torso has these angles and heights, (T, 6)."""
    qpos = np.zeros((len(angles), 6))
    qpos[:, 1], qpos[:, 2] = heights, angles
    return qpos


def test_clean_turns_count_only_what_the_foot_carries():
    turn = np.linspace(0, -2 * np.pi - 0.01, 100)
    high, low = np.full(100, 3.0), np.full(100, 0.3)
    flying = path(turn, high)
    rolling = path(turn, low)
    assert metrics.clean_turns(flying) == 1
    assert metrics.clean_turns(rolling) == 0
    # One clean turn, one on the ground, one clean: two, though three turns were made.
    mixed = np.concatenate([flying, rolling, flying])
    mixed[100:, 2] += turn[-1]
    mixed[200:, 2] += turn[-1]
    assert metrics.net_turns(mixed[:, 2]) == 3
    assert metrics.clean_turns(mixed) == 2
    # A touch half-way through a turn leaves two halves: nothing.
    touch = flying.copy()
    touch[50, 1] = 0.2  # upside down: the head
    assert metrics.clean_turns(touch) == 0
    np.testing.assert_array_equal(metrics.clean_turns(np.stack([flying, rolling])), [1, 0])
    assert metrics.clean_turns(path(-turn, high)) == -1


def demo_positions(name):
    return load_hidden(BUILT_IN / f"{name}.hidden.npz").qpos


def test_landings_of_the_demos():
    """The clean demo lands its three flips; the tumbling one never stands, the hop never turns."""
    clean, tumbling, hop = map(demo_positions, ("hopper-flip-clean", "hopper-backflip", "hopper-hop"))
    lanes = np.stack([clean, tumbling, hop])
    np.testing.assert_array_equal(metrics.landings(lanes, DT), [3, 0, 0])
    np.testing.assert_array_equal(metrics.net_turns(lanes[..., 2]), [3, 9, 0])


def test_a_landing_is_on_the_foot_upright_and_lasts():
    clean = demo_positions("hopper-flip-clean")
    first = 300  # stands after its first flip
    assert metrics.landings(clean[:first], DT) == 1
    over = int((clean[:, 2] <= metrics.LANDED_LEAN - 2 * np.pi).argmax())
    stay = round(metrics.LANDED_FOR_S / DT)
    assert metrics.landings(clean[: over + stay - 1], DT) == 0, "too short to tell"
    floating = clean[:first].copy()
    floating[over:, 1] += 0.5
    assert metrics.landings(floating, DT) == 0, "the foot never touches the ground"
    lying = clean[:first].copy()
    lying[over:, 1] = 0.2
    assert metrics.landings(lying, DT) == 0
    leaning = clean[:first].copy()
    leaning[over:, 2] -= 1.0
    assert metrics.landings(leaning, DT) == 0
    late = np.concatenate([clean[:over], np.repeat(floating[over : over + 1], 100, 0), clean[over:first]])
    assert metrics.landings(late, DT) == 0, "0.8 s in the air after the turn is over"
    shift = clean[:first].copy()
    shift[:, 2] = np.angle(np.exp(1j * shift[:, 2]))
    assert metrics.landings(shift, DT) == 1, "wrapped angles"


def random_qpos(count, seed):
    rng = np.random.default_rng(seed)
    low = [-3, 0.05, -9, -2.6, -2.6, -0.8]
    return rng.uniform(low, [3, 1.6, 9, 0, 0, 0.8], (count, 6))


def test_geometry_is_the_models():
    """Joints and clearances against MuJoCo's own kinematics and contacts."""
    env = vector_env.make("hopper", 1, nthread=0)
    model, data = env.model, mujoco.MjData(env.model)
    contacts = 0
    poses = random_qpos(300, 0)
    # The last ones rest within the contact margin: a part lies on the ground before it reaches it.
    gaps = hopper.clearances(poses[250:])
    lowest = np.minimum.reduce([gaps["torso"], gaps["thigh"], gaps["leg"]])
    poses[250:, 1] += np.linspace(0.0001, 0.004, 50) - lowest
    for qpos in poses:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        points, gaps = hopper.joint_points(qpos), hopper.clearances(qpos)
        for joint, point in (("thigh", "hip"), ("leg", "knee"), ("foot", "ankle")):
            np.testing.assert_allclose(
                data.joint(f"{joint}_joint").xanchor[[0, 2]], points[point], atol=1e-12
            )
        for part, gap in gaps.items():
            geom = data.geom(f"{part}_geom")
            end = geom.xpos[2] - abs(geom.xmat[8]) * model.geom(f"{part}_geom").size[1]
            assert gap == pytest.approx(end - model.geom(f"{part}_geom").size[0], abs=1e-9)
        floor = model.geom("floor").id
        ids = [model.geom(f"{part}_geom").id for part in ("torso", "thigh", "leg")]
        pairs = [set(pair) for pair in data.contact.geom]
        touching = any({floor, i} in pairs for i in ids)
        assert hopper.fallen(qpos) == touching
        contacts += touching
    assert 50 < contacts < 270


def test_backflip_reward_by_hand():
    obs = np.zeros(11)
    # height 1, x velocity -2, torso spin -3, joint velocities 4, 5, 6
    obs[[0, 5, 7, 8, 9, 10]] = 1, -2, -3, 4, 5, 6
    actions = np.array([2.0, -1.0, 0.5])
    # clipped: work 4 - 5 + 3 = 2;  3 (1 + 0.3 + 0.2 + 0.1) = 4.8
    assert task_rewards.backflip_reward(obs, actions) == pytest.approx(4.8)
    # raw: work 8 - 5 + 3 = 6;  3 (1 + 0.3 + 0.6 + 0.1) = 6
    assert task_rewards.backflip_reward(obs, actions, clip_actions=False) == pytest.approx(6.0)
    assert task_rewards.backflip_reward(np.tile(obs, (4, 5, 1)), np.tile(actions, (4, 5, 1))).shape == (
        4,
        5,
    )


def test_hop_reward_is_the_environments():
    env = vector_env.make("hopper", 8, nthread=0)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (80, 8, 3))
    qpos, qvel, rewards = [env.qpos], [env.qvel], []
    for action in actions:
        rewards.append(env.step(action)[1])
        qpos.append(env.qpos)
        qvel.append(env.qvel)
    qpos, qvel = np.stack(qpos, 1), np.stack(qvel, 1)
    actions, rewards = actions.swapaxes(0, 1), np.stack(rewards, 1)
    obs = env.robot.observe(qpos, qvel)
    np.testing.assert_allclose(task_rewards.task_reward("hop", obs, actions, qpos, qvel), rewards, atol=1e-9)
    assert task_rewards.task_reward("backflip", obs, actions, qpos, qvel).shape == (8, 80)
    alive = task_rewards.until_fall(qpos[:, 1:], qvel[:, 1:])
    upright = env.robot.healthy(qpos[:, 1:], qvel[:, 1:])
    first_fall = (~upright).argmax(1)
    assert (~upright).any(1).all()
    np.testing.assert_array_equal(alive.sum(1), first_fall + 1)
