"""The hand-coded baseline and the trajectory optimiser on tiny budgets; the shipped demos."""

import json

import mujoco
import numpy as np
import pytest
import torch

from helpers.paths import DEMOS
from onedemo.baselines import handcoded_trpo, make_demo, trajectory_search
from onedemo.demos.ground_truth import HiddenStates, hidden_path, load_hidden, save_hidden
from onedemo.demos.library import find_demo
from onedemo.errors import UserError
from onedemo.evaluation.metrics import clean_turns, net_turns
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import evaluate
from onedemo.robots.hopper import clearances, fallen
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env
from onedemo.sim.task_rewards import backflip_reward, task_reward, until_fall


@pytest.fixture(autouse=True)
def one_thread():
    """As the command line does: these networks are too small to gain from more."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def tiny(task="backflip", **options):
    defaults = {"steps": 1000, "lanes": 4, "batch": 50, "horizon": 100, "evaluate_every": 2}
    return handcoded_trpo.HandcodedConfig(task=task, **(defaults | options))


@pytest.mark.parametrize("task", ["backflip", "hop"])
def test_training_on_a_hand_coded_reward(task, tmp_path):
    result = handcoded_trpo.train_handcoded(tiny(task), progress=False)
    assert [score.steps for score in result.curve] == [400, 800, 1000]
    assert result.best_score.reward_mean == max(score.reward_mean for score in result.curve)
    assert result.episode.qpos.shape == (101, 6)
    handcoded_trpo.save_result(tmp_path / "flip.v1", result)
    saved = load_hidden(tmp_path / "flip.v1.hidden.npz")
    np.testing.assert_array_equal(saved.qvel, result.episode.qvel)
    policy = Policy.from_dict(torch.load(tmp_path / "flip.v1.policy.pt", weights_only=True))
    episodes = evaluate(policy.snapshot(), "hopper", seed=1, nthread=0)
    assert (np.abs(episodes.qpos - saved.qpos).max((1, 2)) == 0).any(), "the episode is the policy's"
    report = json.loads((tmp_path / "flip.v1.json").read_text())
    assert report["config"]["task"] == task
    assert report["best"]["reward_max"] >= report["best"]["reward_mean"]


def test_same_seed_same_training():
    a, b, c = (handcoded_trpo.train_handcoded(tiny(seed=s, steps=400), progress=False) for s in (1, 1, 2))
    assert a.best_score.reward_mean == b.best_score.reward_mean
    assert a.best_score.reward_mean != c.best_score.reward_mean


@pytest.mark.slow
def test_backflips_begin_within_16_thousand_steps():
    """Not yet turns, but falling over backwards and kicking: twice the untrained reward."""
    untrained = Policy(PolicyConfig(kind="raw"), obs_size=11, action_size=3, horizon=250, seed=0)
    still = evaluate(untrained.snapshot(), "hopper", nthread=0)
    before = task_reward("backflip", still.obs, still.actions, still.qpos, still.qvel).sum(1).mean()
    config = handcoded_trpo.HandcodedConfig(steps=16_000, lanes=16, batch=250, horizon=250)
    after = handcoded_trpo.train_handcoded(config, progress=False).curve[-1].reward_mean
    assert after > 2 * before


def test_command_line_says_what_is_wrong():
    with pytest.raises(UserError, match="backflip, forward, hop"):
        tiny("flop")
    with pytest.raises(UserError, match="steps must be at least 1"):
        tiny(steps=0)


def test_timetable():
    plan = trajectory_search.FlipPlan(flips=2, period=2.0, start=0.5, roll=0.8)
    t = np.array([0.0, 0.4, 0.9, 1.4, 2.9, 4.5, 8.0])
    angle, arc, since = trajectory_search.timetable(plan, t)
    np.testing.assert_allclose(-angle / (2 * np.pi), [0, 0, 0.56, 1, 1.56, 2, 2], atol=0.02)
    np.testing.assert_allclose(since[:5], [-0.5, -0.1, 0.4, 0.9, 0.4])
    assert np.isnan(since[5:]).all(), "no third flip"
    # The apex of a ballistic arc of 0.8 s lies g t^2 / 8 = 0.785 m above the take-off.
    assert arc[2] == pytest.approx(trajectory_search.TAKE_OFF + 9.81 * 0.8**2 / 8)
    with pytest.raises(UserError, match="fit into its period"):
        trajectory_search.FlipPlan(period=1.0)
    with pytest.raises(UserError, match="elites"):
        trajectory_search.FlipPlan(samples=4)


def test_centre_of_mass_is_the_models():
    env = vector_env.make("hopper", 1, nthread=0)
    data = mujoco.MjData(env.model)
    data.qpos[:] = [0.3, 1.1, -2.0, -0.7, -1.1, 0.3]
    mujoco.mj_forward(env.model, data)
    ours = trajectory_search.centre_of_mass(data.qpos)
    np.testing.assert_allclose(ours, data.subtree_com[1][[0, 2]], atol=2e-3)


def test_short_optimisation_is_a_real_episode():
    """Also where time was turned back: nothing of what was given up may be left in it."""
    short = {"flips": 1, "start": 0.1, "roll": 0.1, "period": 0.3, "seconds": 0.84}
    search = {"samples": 6, "elites": 2, "knots": 3, "iterations": 1, "take_off_iterations": 1}
    straight, turned = (
        trajectory_search.optimise_flips(
            trajectory_search.FlipPlan(retries=n, **short, **search), progress=False
        )
        for n in (0, 2)
    )
    assert straight.qpos.shape == turned.qpos.shape == (106, 6)
    assert (straight.actions != turned.actions).any(), "no flip in 0.1 s: it was tried again"
    env = vector_env.make("hopper", 1, nthread=0)
    env.reset()
    env.set_states(np.array([0]), turned.qpos[:1], turned.qvel[:1])
    for t in range(105):
        env.step(turned.actions[t : t + 1])
        np.testing.assert_allclose(env.qpos[0], turned.qpos[t + 1], atol=1e-4)


def test_cost_of_the_ground():
    """One touch costs more than any pose; standing on the foot costs nothing of that kind."""
    plan = trajectory_search.FlipPlan()
    stance = np.array([0, 1.22, 0, 0, 0, 0])
    kneeling = np.array([0, 0.46, 0.4, -0.6, -1.9, 0])
    poses = np.stack([stance, kneeling])
    assert (clearances(poses)["leg"] < trajectory_search.SAFE).tolist() == [False, True]
    assert clearances(poses)["foot"][0] < 0.011
    stance_cost, kneeling_cost = trajectory_search.cost(plan, poses[:, None], 0 * poses[:, None], np.zeros(1))
    assert stance_cost < 5 < 30 < kneeling_cost


def test_a_demo_that_could_not_be_written_is_not_rendered(tmp_path):
    """What a command will leave is tried before its work begins: there are not even states to render here."""
    (tmp_path / "a.webm").mkdir()
    for name, words in (("a", "a.webm is a directory"), ("b/c", "a name is 1 to 64")):
        with pytest.raises(UserError, match=words):
            make_demo.main([name, "--task", "hop", "--source", "x", "--out", str(tmp_path)])
    with pytest.raises(UserError, match=r"cannot write .*gone"):
        make_demo.main(["a", "--task", "hop", "--source", "x", "--out", str(tmp_path / "gone")])


def test_hidden_states_refuse_what_they_are_not(tmp_path):
    hidden = HiddenStates(
        obs=np.zeros((4, 11)),
        actions=np.zeros((3, 3), np.float32),
        qpos=np.zeros((4, 6)),
        qvel=np.zeros((4, 6)),
    )
    path = hidden_path(tmp_path / "a.demo.mp4")
    assert path.name == "a.demo.hidden.npz"
    save_hidden(path, hidden)
    assert load_hidden(path).actions.dtype == np.float32
    with pytest.raises(UserError, match="no hidden states"):
        load_hidden(tmp_path / "missing.hidden.npz")
    for content in (b"", b"not a zip", path.read_bytes()[:200]):
        broken = tmp_path / "broken.hidden.npz"
        broken.write_bytes(content)
        with pytest.raises(UserError, match="does not hold"):
            load_hidden(broken)
    np.savez(tmp_path / "pickled.npz", obs=np.array([{}], dtype=object))
    with pytest.raises(UserError, match="does not hold"):
        load_hidden(tmp_path / "pickled.npz")
    with pytest.raises(ValueError, match=r"T \+ 1"):
        HiddenStates(obs=hidden.obs, actions=hidden.actions, qpos=hidden.qpos[:3], qvel=hidden.qvel)


@pytest.mark.parametrize("name", ["hopper-backflip", "hopper-hop", "hopper-flip-clean"])
def test_shipped_demos(name):
    """What the guide and the bench say about the built-in demos is true of their states."""
    hidden = load_hidden(DEMOS / f"{name}.hidden.npz")
    assert len(hidden.actions) == 1000
    assert np.abs(hidden.qpos[0] - [0, 1.25, 0, 0, 0, 0]).max() <= 0.005
    spec = robot_named("hopper")
    np.testing.assert_allclose(hidden.obs, spec.observe(hidden.qpos, hidden.qvel))
    reward = backflip_reward(hidden.obs[1:], hidden.actions).sum()
    if name == "hopper-backflip":
        assert net_turns(hidden.qpos[:, 2]) >= 4
        assert reward > 15_000
    elif name == "hopper-flip-clean":
        assert net_turns(hidden.qpos[:, 2]) == clean_turns(hidden.qpos) == 3
        assert not fallen(hidden.qpos).any(), "on the foot alone, all the time"
        assert hidden.qpos[-1, 1] > 1.1
        assert np.cos(hidden.qpos[-1, 2]) > 0.9, "upright at the end"
    else:
        assert until_fall(hidden.qpos[1:], hidden.qvel[1:]).all()
        assert hidden.qpos[-1, 0] > 8, "a lively hop goes forward"


@pytest.mark.parametrize("name, travel", [("walker2d-hop", 12), ("half-cheetah-run", 20)])
def test_shipped_demos_of_other_robots(name, travel):
    demo, hidden = find_demo(name, DEMOS), load_hidden(DEMOS / f"{name}.hidden.npz")
    robot = robot_named(demo.robot)
    assert 4 <= demo.seconds <= 8.1 and (DEMOS / f"{name}.webm").stat().st_size < 1 << 20
    np.testing.assert_allclose(hidden.obs, robot.observe(hidden.qpos, hidden.qvel))
    assert until_fall(hidden.qpos[1:], hidden.qvel[1:], robot).all()
    assert hidden.qpos[-1, 0] > travel, "metres"
