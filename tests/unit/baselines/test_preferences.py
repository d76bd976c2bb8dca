"""Learning from preferences: the reward model against known rewards, the comparer, tiny trainings."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from onedemo.app.cli.main import main
from onedemo.baselines import preference_reward, preferences
from onedemo.baselines.preference_reward import Comparison, RewardConfig, fit_reward, most_disputed
from onedemo.baselines.preferences import PreferencesConfig, comparisons_due, draw_pairs, train_preferences
from onedemo.baselines.synthetic_comparer import Comparer, ComparisonBudgetSpent, agreement
from onedemo.demos.ground_truth import load_hidden
from onedemo.errors import UserError
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import Collector
from onedemo.sim import vector_env
from onedemo.sim.task_rewards import backflip_reward
from onedemo.types import Segment

QUICK = RewardConfig(updates=150)


@pytest.fixture(autouse=True)
def one_thread():
    """As the command line does: these networks are too small to gain from more."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def synthetic(rng, steps=40):
    """A segment whose observations and actions drift around a level of their own."""
    obs = rng.normal(0, 1, 11) + 0.5 * rng.normal(0, 1, (steps, 11))
    actions = 0.3 * (rng.normal(0, 1, 3) + rng.normal(0, 1, (steps, 3)))
    return Segment(obs=obs, actions=actions, qpos=np.zeros((steps, 6)), qvel=np.zeros((steps, 6)))


def synthetic_pairs(count, seed):
    rng = np.random.default_rng(seed)
    return [(synthetic(rng), synthetic(rng)) for _ in range(count)]


def linear_reward(segment):
    """What the predictors can see of it: height, the second joint, a velocity and an action."""
    obs, actions = segment.obs, np.clip(segment.actions, -1, 1)
    return obs[:, 0] - obs[:, 3] - 0.5 * obs[:, 7] + 2 * actions[:, 1]


def labelled(pairs):
    sums = [[linear_reward(segment).sum() for segment in pair] for pair in pairs]
    return [Comparison(pair=p, preference=float(a > b)) for p, (a, b) in zip(pairs, sums, strict=True)]


def ranks(x):
    return np.argsort(np.argsort(x))


@pytest.fixture(scope="module")
def fitted():
    return fit_reward(labelled(synthetic_pairs(150, seed=0)), QUICK, seed=0)


@pytest.fixture(scope="module")
def batch():
    """Two staggered lanes of an untrained policy; each passes the end of an episode of 100 steps."""
    policy = Policy(PolicyConfig(kind="raw"), obs_size=11, action_size=3, horizon=100, seed=0)
    env = vector_env.make("hopper", 2, horizon=100, nthread=0)
    return Collector(env, seed=0).collect(policy.snapshot(), 160)


def test_a_linear_reward_is_recovered_in_order(fitted):
    """Segments never compared are ranked as the hidden reward ranks them; chance gives 0."""
    ensemble, fit = fitted
    fresh = [segment for pair in synthetic_pairs(100, seed=1) for segment in pair]
    learned = [ensemble.rewards(s.obs, s.actions).sum() for s in fresh]
    true = [linear_reward(s).sum() for s in fresh]
    assert np.corrcoef(ranks(learned), ranks(true))[0, 1] > 0.85
    assert fit.unseen_accuracy > 0.75
    assert fit.loss < fit.unseen_loss < math.log(2)


def test_a_reward_from_turned_answers_is_turned(fitted):
    turned = [replace(c, preference=1 - c.preference) for c in labelled(synthetic_pairs(150, seed=0))]
    ensemble, _ = fit_reward(turned, QUICK, seed=0)
    segment = synthetic(np.random.default_rng(5), steps=500)
    rewards = [e.rewards(segment.obs, segment.actions) for e in (fitted[0], ensemble)]
    assert np.corrcoef(*rewards)[0, 1] < -0.5


def test_ties_teach_equality():
    pairs = synthetic_pairs(60, seed=0)
    ensemble, fit = fit_reward([Comparison(pair=p, preference=0.5) for p in pairs], QUICK, seed=0)
    assert np.abs(ensemble.probabilities(pairs) - 0.5).max() < 0.2
    assert math.isnan(fit.unseen_accuracy), "nobody was right or wrong"
    with pytest.raises(ValueError, match=r"0, 0\.5 or 1"):
        Comparison(pair=pairs[0], preference=0.7)
    with pytest.raises(ValueError, match="at least one comparison"):
        fit_reward([], QUICK, seed=0)


def test_the_reward_is_normalised_and_depends_on_answers_and_seed_alone(fitted):
    comparisons = labelled(synthetic_pairs(150, seed=0))
    obs, actions = (
        np.stack([getattr(s, name) for c in comparisons for s in c.pair]) for name in ("obs", "actions")
    )
    rewards = fitted[0].rewards(obs, actions)
    assert rewards.shape == (300, 40)
    assert rewards.mean() == pytest.approx(0, abs=1e-3)
    assert rewards.std() == pytest.approx(1, abs=1e-3)
    torch.rand(7)  # the global generator plays no part
    again, other = (fit_reward(comparisons, QUICK, seed=seed)[0] for seed in (0, 1))
    np.testing.assert_array_equal(again.rewards(obs, actions), rewards)
    assert (other.rewards(obs, actions) != rewards).any()


def test_members_differ_and_the_most_disputed_pairs_are_taken(fitted):
    ensemble, _ = fitted
    candidates = synthetic_pairs(60, seed=2)
    probabilities = ensemble.probabilities(candidates)
    assert probabilities.shape == (3, 60)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(probabilities[a] - probabilities[b]).max() > 0.02
    variance = probabilities.var(axis=0)
    chosen = [
        next(i for i, p in enumerate(candidates) if p is c) for c in most_disputed(ensemble, candidates, 6)
    ]
    left = np.delete(variance, chosen)
    assert len(set(chosen)) == 6
    assert variance[chosen].min() >= left.max() > 0
    assert most_disputed(ensemble, [], 6) == []


def test_noise_bounds_what_one_answer_can_cost():
    """0.9 p + 0.05: an answer against all evidence costs -ln 0.05 nats and not more."""
    losses = preference_reward._losses(torch.tensor([50.0, 50.0, 0.0]), torch.tensor([1.0, 0.0, 1.0]), 0.1)
    np.testing.assert_allclose(losses, [-math.log(0.95), -math.log(0.05), math.log(2)], rtol=1e-5)


def test_the_comparer_goes_by_the_backflip_reward_and_keeps_to_its_budget():
    rng = np.random.default_rng(0)
    still = synthetic(rng)
    obs = still.obs.copy()
    obs[:, 7] -= 10.0  # spins backwards
    obs[:, 0] = 1.0
    spinning = replace(still, obs=obs)
    comparer = Comparer(budget=3)
    assert comparer.compare(spinning, still) == 1.0
    assert comparer.compare(still, spinning) == 0.0
    assert comparer.compare(still, still) == 0.5
    with pytest.raises(ComparisonBudgetSpent, match="budget of 3"):
        comparer.compare(still, spinning)
    assert comparer.given == 3


def test_pairs_never_span_the_end_of_an_episode(batch):
    pairs = draw_pairs(batch, 200, 60, np.random.default_rng(0))
    assert len(pairs) == 200
    seen = set()
    for segment in (segment for pair in pairs for segment in pair):
        lane, start = np.argwhere((batch.qpos == segment.qpos[0]).all(-1))[0]
        np.testing.assert_array_equal(np.diff(batch.clock[lane, start : start + 60]), 1)
        seen.add((int(lane), int(start)))
    assert {lane for lane, _ in seen} == {0, 1}
    assert len(seen) > 50
    assert draw_pairs(batch, 5, 101, np.random.default_rng(0)) == [], "no episode is that long"


def test_agreement_is_a_correlation_with_the_hand_coded_reward(batch):
    true = backflip_reward(batch.next_obs, batch.actions)
    assert agreement(batch, 3 * true + 1, 20) == pytest.approx(1)
    assert agreement(batch, -true, 20) == pytest.approx(-1)


def test_online_comparisons_are_annealed():
    config = PreferencesConfig(pretrain=200, online=150, annealing=1000)
    due = [comparisons_due(config, steps, last=4000) for steps in (0, 1000, 2000, 3000, 4000, 5000)]
    assert due[0] == 200
    assert due[4] == due[5] == 350
    gaps = np.diff(due[:5])
    assert (np.diff(gaps) < 0).all(), "fewer and fewer"
    # 150 ln(1 + 1) / ln(1 + 4) = 64.6
    assert due[1] == 264
    assert comparisons_due(config, 1000, last=0) == 350


def tiny(**options):
    defaults = {
        "pretrain": 12, "online": 6, "round": 6, "segment_seconds": 0.16, "steps": 800, "lanes": 4,
        "batch": 50, "horizon": 100, "evaluate_every": 2, "threads": 1, "reward": RewardConfig(updates=20),
    }  # fmt: skip
    return PreferencesConfig(**(defaults | options))


@pytest.mark.slow
def test_same_seed_same_policy():
    a, b, c = (
        train_preferences(tiny(seed=s, threads=n), progress=False) for s, n in ((1, 1), (1, 2), (2, 1))
    )
    assert [score.steps for score in a.curve] == [400, 800]
    assert [score.comparisons for score in a.curve][-1] == 18
    states = [result.final.state_dict() for result in (a, b, c)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not torch.equal(states[0]["mean.0.weight"], states[2]["mean.0.weight"])
    assert a.episode.qpos.shape == (101, 6)


def test_the_learner_sees_preferences_only(monkeypatch):
    """Answers turned round give another policy; the hand-coded reward has no other way in."""
    straight = train_preferences(tiny(), progress=False)
    compare = Comparer.compare
    monkeypatch.setattr(Comparer, "compare", lambda self, a, b: 1 - compare(self, a, b))
    turned = train_preferences(tiny(), progress=False)
    states = straight.final.state_dict(), turned.final.state_dict()
    assert not torch.equal(states[0]["mean.0.weight"], states[1]["mean.0.weight"])
    for module in (preferences, preference_reward):
        assert "motion" not in Path(module.__file__).read_text(), "rewards are the comparer's alone"


def test_settings_that_cannot_be():
    with pytest.raises(UserError, match="188 control steps"):
        PreferencesConfig(batch=100)
    with pytest.raises(UserError, match="pretrain must be at least 1"):
        tiny(pretrain=0)
    with pytest.raises(UserError, match="online must be 0 or more"):
        tiny(online=-1)
    with pytest.raises(ValueError, match=r"reward\.members"):
        RewardConfig(members=0)
    assert preferences.split_comparisons(350) == (200, 150)
    assert preferences.split_comparisons(2) == (1, 1)


@pytest.mark.slow
def test_command_line(tmp_path, capsys):
    """One iteration of the real size, with few comparisons."""
    out = tmp_path / "p"
    assert main(["baseline", "preferences", "--comparisons", "7", "--steps", "1000", "--out", str(out)]) == 0
    assert "reward_mean" in capsys.readouterr().out
    report = json.loads((tmp_path / "p.json").read_text())
    assert (report["config"]["pretrain"], report["config"]["online"]) == (4, 3)
    assert report["final"] == report["curve"][-1]
    assert report["final"]["comparisons"] == 7
    saved = torch.load(tmp_path / "p.policy.pt", weights_only=True)
    assert Policy.from_dict(saved).config.kind == "raw"
    assert load_hidden(tmp_path / "p.hidden.npz").actions.shape == (1000, 3)
    assert main(["baseline", "preferences", "--comparisons", "1", "--out", str(out)]) == 2
    assert "at least 2" in capsys.readouterr().err
