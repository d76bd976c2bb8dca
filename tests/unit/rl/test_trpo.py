"""The mathematics of TRPO against dense linear algebra and values worked by hand."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector

from onedemo.rl.fisher import conjugate_gradient, fisher_product, mean_kl
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import Collector
from onedemo.rl.trpo import Trpo, TrpoConfig, gae
from onedemo.sim import vector_env
from onedemo.types import Rollouts


def small_policy(seed=0, log_std=-0.2):
    policy = Policy(
        PolicyConfig(kind="raw", hidden=(4,), log_std=log_std),
        obs_size=3,
        action_size=2,
        horizon=10,
        seed=seed,
    )
    with torch.no_grad():
        policy.mean[-1].weight.mul_(50)
    return policy


def test_gae_by_hand():
    # gamma 0.5, lambda 0.5, so each later delta counts 0.25 times the one before.
    # Lane 0, no end: deltas 1 + .5*2 - 1 = 1, 1 + .5*4 - 2 = 1, 1 + .5*6 - 4 = 0
    #   advantages 1 + .25*1, 1 + .25*0, 0 = 1.25, 1, 0
    # Lane 1, terminal at t = 1: delta_1 = 1 - 2 = -1, and t = 2 is another episode
    #   advantages 1 + .25*(-1), -1, 0 = 0.75, -1, 0
    # Lane 2, time limit at t = 1: delta_1 = 1 + .5*4 - 2 = 1, t = 2 is another episode (delta 5)
    #   advantages 1 + .25*1, 1, 5 = 1.25, 1, 5
    rewards = np.array([[1.0, 1, 1], [1, 1, 1], [1, 1, 6]])
    values = np.tile([1.0, 2, 4], (3, 1))
    next_values = np.tile([2.0, 4, 6], (3, 1))
    terminated = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]], bool)
    ended = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 0]], bool)
    advantages = gae(rewards, values, next_values, terminated, ended, gamma=0.5, lam=0.5)
    np.testing.assert_allclose(advantages, [[1.25, 1, 0], [0.75, -1, 0], [1.25, 1, 5]])
    with pytest.raises(ValueError, match="one shape"):
        gae(rewards, values[:, :2], next_values, terminated, ended, gamma=0.5, lam=0.5)


def test_gae_with_lambda_one_is_the_discounted_return():
    rng = np.random.default_rng(0)
    rewards, values = rng.standard_normal((2, 4, 30))
    next_values = np.concatenate([values[:, 1:], rng.standard_normal((4, 1))], 1)
    never = np.zeros((4, 30), bool)
    discounts = 0.9 ** np.arange(30)
    returns = (rewards * discounts).sum(1) + 0.9**30 * next_values[:, -1]
    advantages = gae(rewards, values, next_values, never, never, gamma=0.9, lam=1.0)
    np.testing.assert_allclose(advantages[:, 0], returns - values[:, 0])


def test_conjugate_gradient_solves_a_dense_system():
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(20, 20, generator=generator, dtype=torch.float64)
    matrix = root @ root.T + torch.eye(20, dtype=torch.float64)
    b = torch.randn(20, generator=generator, dtype=torch.float64)
    exact = torch.linalg.solve(matrix, b)
    solved, left = conjugate_gradient(lambda v: matrix @ v, b, 40)
    torch.testing.assert_close(solved, exact)
    for n in (1, 3):
        x, left = conjugate_gradient(lambda v: matrix @ v, b, n)
        torch.testing.assert_close(left, b - matrix @ x)
    # Each iteration brings the energy norm down, and two are not enough.
    errors = []
    for n in (1, 2, 5, 10):
        error = conjugate_gradient(lambda v: matrix @ v, b, n)[0] - exact
        errors.append((error @ matrix @ error).item())
    assert errors == sorted(errors, reverse=True)
    assert errors[1] > 1e-3
    zero, _ = conjugate_gradient(lambda v: matrix @ v, torch.zeros_like(b), 5)
    assert not zero.any(), "no gradient, no direction"


def test_kl_against_torch():
    generator = torch.Generator().manual_seed(0)
    old, new = torch.randn(2, 50, 3, generator=generator)
    old_std, new_std = torch.rand(2, 3, generator=generator) + 0.3
    expected = torch.distributions.kl_divergence(
        torch.distributions.Normal(old, old_std), torch.distributions.Normal(new, new_std)
    )
    ours = mean_kl(old, old_std.log(), new, new_std.log())
    torch.testing.assert_close(ours, expected.sum(-1).mean())


def test_fisher_product_is_the_dense_fisher_matrix():
    """F = mean of J^T S^-1 J over the inputs for the mean, 2 I for the log deviation."""
    policy = small_policy().double()
    inputs = torch.randn(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights = list(policy.mean.parameters())
    count = sum(p.numel() for p in weights)
    fisher = torch.zeros(count + 2, count + 2, dtype=torch.float64)
    precision = torch.diag(torch.exp(-2 * policy.log_std.detach()))
    for x in inputs:
        rows = [
            torch.cat([g.flatten() for g in torch.autograd.grad(y, weights, retain_graph=True)])
            for y in policy(x[None])[0]
        ]
        jacobian = torch.stack(rows)
        fisher[:count, :count] += jacobian.T @ precision @ jacobian / len(inputs)
    fisher[count:, count:] = 2 * torch.eye(2, dtype=torch.float64)
    product = fisher_product(policy, inputs, damping=0.1)
    columns = torch.stack([product(v) for v in torch.eye(count + 2, dtype=torch.float64)])
    torch.testing.assert_close(columns, fisher + 0.1 * torch.eye(count + 2, dtype=torch.float64))


def test_fisher_product_does_not_depend_on_how_the_samples_are_cut():
    policy = small_policy().double()
    inputs = torch.randn(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    vector = torch.arange(parameters(policy).numel(), dtype=torch.float64)
    whole = fisher_product(policy, inputs, damping=0.1)(vector)
    torch.testing.assert_close(fisher_product(policy, inputs, damping=0.1, chunk=7)(vector), whole)


def paid(rollouts, rewards):
    """The same rollouts with other rewards, (N, T)."""
    return replace(rollouts, rewards=rewards)


def made_up_rollouts(policy, lanes=8, steps=100, seed=0):
    """One state after another, at random; what was done does not matter to what comes."""
    rng = np.random.default_rng(seed)
    snapshot = policy.snapshot()
    obs = rng.standard_normal((lanes, steps + 1, 3))
    clock = np.tile(np.arange(steps, dtype=np.int32), (lanes, 1))
    inputs = snapshot.inputs(obs[:, :-1], clock)
    none = np.zeros((lanes, steps), bool)
    return Rollouts(
        obs=obs[:, :-1],
        actions=snapshot.act(inputs, rng),
        qpos=np.zeros((lanes, steps, 6)),
        qvel=np.zeros((lanes, steps, 6)),
        clock=clock,
        inputs=inputs,
        next_inputs=snapshot.inputs(obs[:, 1:], clock + 1),
        rewards=np.zeros((lanes, steps)),
        terminated=none,
        truncated=none,
    )


def towards_the_first_state(rollouts):
    """Best where the first action equals the first observation, the second its opposite."""
    target = rollouts.obs[..., :1] * [1, -1]
    return -np.square(rollouts.actions - target).sum(-1)


@pytest.mark.parametrize("max_kl", [1e-3, 0.01, 0.1])
def test_the_step_stays_in_the_trust_region_and_uses_it(max_kl):
    policy = small_policy()
    trpo = Trpo(policy, TrpoConfig(max_kl=max_kl, gamma=0.0), seed=0)
    for seed in range(5):
        rollouts = made_up_rollouts(policy, seed=seed)
        inputs = torch.from_numpy(rollouts.inputs).flatten(0, 1)
        with torch.no_grad():
            old_mean, old_log_std = policy(inputs), policy.log_std.clone()
        stats = trpo.update(paid(rollouts, towards_the_first_state(rollouts)))
        with torch.no_grad():
            kl = mean_kl(old_mean, old_log_std, policy(inputs), policy.log_std).item()
        assert stats.accepted
        assert stats.improvement > 0
        assert kl <= max_kl * 1.0001
        assert kl > max_kl / 10
        assert stats.kl == pytest.approx(kl, rel=1e-3, abs=1e-7)


def largest_step(config, progress):
    """The longest of a few steps at one moment of a training, as measured afterwards, nats."""
    policy = small_policy()
    trpo = Trpo(policy, config, seed=0)
    longest = 0.0
    for seed in range(5):
        rollouts = made_up_rollouts(policy, seed=seed)
        inputs = torch.from_numpy(rollouts.inputs).flatten(0, 1)
        with torch.no_grad():
            old_mean, old_log_std = policy(inputs), policy.log_std.clone()
        assert trpo.update(paid(rollouts, towards_the_first_state(rollouts)), progress=progress).accepted
        with torch.no_grad():
            kl = mean_kl(old_mean, old_log_std, policy(inputs), policy.log_std).item()
        longest = max(longest, kl)
    return longest


def test_the_trust_region_shrinks_over_a_training():
    config = TrpoConfig(max_kl=0.1, final_kl=0.01, gamma=0.0)
    for progress, radius in ((0.0, 0.1), (0.5, 0.055), (0.9, 0.019), (1.0, 0.01)):
        longest = largest_step(config, progress)
        assert 0.6 * radius < longest <= 1.0001 * radius, progress


def test_the_trust_region_never_grows():
    """Whoever asks for a small radius and no other has it all the time."""
    config = TrpoConfig(max_kl=0.004, gamma=0.0)
    assert config.final_kl > config.max_kl
    assert 0.0024 < largest_step(config, 1.0) <= 0.004 * 1.0001


def test_learns_what_it_is_paid_for():
    policy = small_policy(log_std=0.0)
    trpo = Trpo(policy, TrpoConfig(max_kl=0.05, gamma=0.0), seed=0)
    rewards = []
    for seed in range(60):
        rollouts = made_up_rollouts(policy, seed=seed)
        reward = towards_the_first_state(rollouts)
        rewards.append(reward.mean())
        trpo.update(paid(rollouts, reward))
    # Doing nothing with no noise would get -2: the mean square of the target, twice.
    assert rewards[0] < -3
    assert rewards[-1] > -0.7
    assert policy.log_std.exp().max() < 0.6


def parameters(policy):
    return parameters_to_vector([*policy.mean.parameters(), policy.log_std]).detach()


def test_the_scale_of_the_rewards_does_not_matter():
    ends = []
    for scale in (1.0, 1024.0):
        policy = small_policy()
        trpo = Trpo(policy, TrpoConfig(), seed=0)
        for seed in range(3):
            rollouts = made_up_rollouts(policy, seed=seed)
            trpo.update(paid(rollouts, scale * towards_the_first_state(rollouts)))
        ends.append(parameters(policy))
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-3, atol=1e-4)


def test_nothing_to_gain_changes_nothing():
    policy = small_policy()
    rollouts = made_up_rollouts(policy)
    before = parameters(policy).clone()
    stats = Trpo(policy, TrpoConfig(gamma=0.0, value_epochs=0), seed=0).update(
        paid(rollouts, np.zeros(rollouts.clock.shape))
    )
    assert torch.isfinite(parameters(policy)).all()
    assert stats.kl <= TrpoConfig().max_kl
    if not stats.accepted:
        assert torch.equal(parameters(policy), before)


@pytest.mark.slow
def test_value_function_bootstraps_through_the_time_limit():
    """Reward 1 for ever, cut into episodes of 5 steps: V must still become 1 / (1 - gamma)."""
    policy = small_policy()
    base = made_up_rollouts(policy, lanes=16, steps=50)
    limit = np.tile(np.arange(50) % 5 == 4, (16, 1))
    for name, expected in (("truncated", 5.0), ("terminated", None)):
        fields = {key: getattr(base, key) for key in Rollouts.__slots__} | {name: limit}
        rollouts = Rollouts(**fields)
        trpo = Trpo(policy, TrpoConfig(gamma=0.8, value_epochs=20, value_rate=3e-3), seed=0)
        for _ in range(40):
            trpo.update(paid(rollouts, np.ones((16, 50))))
        with torch.no_grad():
            value = trpo.value(torch.from_numpy(rollouts.inputs)).mean().item()
        if expected:
            assert value == pytest.approx(expected, rel=0.05)
        else:  # mean over steps left 1..5 of (1 - .8^k) / (1 - .8)
            assert value == pytest.approx(np.mean([(1 - 0.8**k) / 0.2 for k in range(1, 6)]), 0.1)


def hopper(seed, rounds, lanes=16, steps=250):
    env = vector_env.make("hopper", lanes, nthread=0, terminate_when_unhealthy=True)
    policy = Policy(PolicyConfig(kind="raw"), obs_size=11, action_size=3, horizon=1000, seed=seed)
    trpo = Trpo(policy, TrpoConfig(), seed=seed)
    collector = Collector(env, seed=seed)
    per_episode = []
    for _ in range(rounds):
        batch = collector.collect(policy.snapshot(), steps)
        trpo.update(batch)
        per_episode.append(batch.rewards.sum() / batch.terminated.sum())
    return policy, trpo, collector, per_episode


@pytest.mark.slow
def test_hopper_learns_to_stay_up():
    """28 thousand steps of Hopper-v5: the reward of an episode grows several times."""
    *_, per_episode = hopper(0, 7)
    assert per_episode[0] < 30
    assert per_episode[-1] > 4 * per_episode[0]


def test_value_after_a_step_that_ended_an_episode_is_of_where_it_ended(monkeypatch):
    """There the next column belongs to another episode."""
    policy = small_policy()
    rollouts = made_up_rollouts(policy)
    ended = np.random.default_rng(0).random(rollouts.clock.shape) < 0.2
    elsewhere = np.where(ended[..., None], 3.0, rollouts.next_inputs).astype(np.float32)
    changed = {"next_inputs": elsewhere, "truncated": ended}
    rollouts = Rollouts(**{key: getattr(rollouts, key) for key in Rollouts.__slots__} | changed)
    trpo = Trpo(policy, TrpoConfig(), seed=0)
    trpo.update(paid(rollouts, rollouts.obs[..., 0]))  # V is zero everywhere before the first fit
    seen = {}

    def spy(rewards, values, next_values, *rest, **options):
        seen.update(values=values, next_values=next_values)
        return gae(rewards, values, next_values, *rest, **options)

    monkeypatch.setattr("onedemo.rl.trpo.gae", spy)
    with torch.no_grad():
        values = trpo.value(torch.from_numpy(rollouts.inputs)).numpy()
        next_values = trpo.value(torch.from_numpy(elsewhere)).numpy()
    trpo.update(paid(rollouts, rollouts.obs[..., 0]))
    np.testing.assert_allclose(seen["values"], values, atol=1e-6)
    np.testing.assert_allclose(seen["next_values"], next_values, atol=1e-6)
    assert np.abs(next_values[:, :-1] - values[:, 1:])[ended[:, :-1]].max() > 1e-3


def test_a_state_saved_before_the_fused_optimiser_goes_on_fused():
    *_, trpo, _, _ = hopper(0, 1, lanes=4, steps=50)
    saved = trpo.state_dict()
    saved["adam"]["param_groups"][0]["fused"] = None
    *_, fresh, _, _ = hopper(0, 0, lanes=4)
    fresh.load_state_dict(saved)
    assert fresh.state_dict()["adam"]["param_groups"][0]["fused"] is True


@pytest.mark.slow
def test_same_seed_same_policy_and_resumed_training_is_the_same():
    policy, *_ = hopper(3, 4, lanes=4, steps=100)
    again, trpo, collector, _ = hopper(3, 2, lanes=4, steps=100)
    file = io.BytesIO()
    torch.save(
        {
            "policy": again.to_dict(),
            "trpo": trpo.state_dict(),
            "collector": collector.state_dict(),
        },
        file,
    )
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    _, fresh_trpo, fresh_collector, _ = hopper(9, 0, lanes=4)
    resumed = Policy.from_dict(saved["policy"])
    trpo = Trpo(resumed, fresh_trpo.config, seed=77)
    trpo.load_state_dict(saved["trpo"])
    fresh_collector.load_state_dict(saved["collector"])
    for _ in range(2):
        batch = fresh_collector.collect(resumed.snapshot(), 100)
        trpo.update(batch)
    assert torch.equal(parameters(resumed), parameters(policy))
    other, *_ = hopper(4, 4, lanes=4, steps=100)
    assert not torch.equal(parameters(other), parameters(policy))


def test_bad_input():
    policy = small_policy()
    rollouts = made_up_rollouts(policy)
    trpo = Trpo(policy, TrpoConfig(), seed=0)
    with pytest.raises(ValueError, match="rewards must be finite"):
        trpo.update(paid(rollouts, np.zeros((8, 99))))
    with pytest.raises(ValueError, match="rewards must be finite"):
        trpo.update(paid(rollouts, np.full((8, 100), np.nan)))
    for name, value in {
        "max_kl": 0,
        "final_kl": 0,
        "gamma": 1.0,
        "lam": 1.1,
        "damping": -1,
        "backtrack_factor": 1,
        "cg_iterations": 0,
        "value_rate": 0,
    }.items():
        with pytest.raises(ValueError, match=name):
            TrpoConfig(**{name: value})
