"""What the policy sees, that its NumPy copy acts as the network does, and that it saves itself."""

import io
import math

import numpy as np
import pytest
import torch

from onedemo.rl.policy import Normaliser, Policy, PolicyConfig, Tanh, ValueFunction, mlp
from onedemo.rl.policy_inputs import HARMONICS, KINDS, feature_size, policy_inputs


def policy(kind="clock", seed=0, table=None):
    built = Policy(
        PolicyConfig(kind=kind, log_std=-0.3),
        obs_size=11,
        action_size=3,
        horizon=1000,
        seed=seed,
        table=table,
    )
    with torch.no_grad():  # actions that depend on the state
        built.mean[-1].weight.mul_(100)
    return built


@pytest.mark.parametrize("kind", KINDS)
def test_inputs(kind):
    rng = np.random.default_rng(0)
    obs, clock = rng.standard_normal((2, 5, 11)), rng.integers(0, 1000, (2, 5))
    table = rng.standard_normal((1000, 4)) if kind == "table" else None
    features = policy_inputs(obs, clock, 1000, kind, table)
    assert features.shape == (2, 5, feature_size(11, kind, 4))
    turned = obs.copy()
    turned[..., 1] -= 2 * np.pi
    same = np.allclose(policy_inputs(turned, clock, 1000, kind, table), features)
    assert same == (kind != "raw"), "after a whole turn everything looks the same"
    one = policy_inputs(obs[1, 2], clock[1, 2], 1000, kind, table)
    np.testing.assert_allclose(one, features[1, 2])


def test_clock_by_hand():
    # A quarter of the way: the line is at -0.5, the first harmonic at sin 90 and cos 90 degrees,
    # the second at sin 180, cos 180, and the others at whole turns.
    clock = policy_inputs(np.zeros(11), np.array(250), 1000, "clock")[12:]
    np.testing.assert_allclose(clock, [-0.5, 1, 0, 0, 0, 0, 0, -1, 1, 1, 1], atol=1e-12)
    assert len(clock) == 1 + 2 * len(HARMONICS)
    end = policy_inputs(np.zeros((2, 11)), np.array([1000, 1500]), 1000, "clock")
    np.testing.assert_array_equal(end[0], end[1])


def test_table_by_hand():
    table = np.arange(20.0).reshape(10, 2)
    shown = policy_inputs(np.zeros((3, 11)), np.array([0, 4, 99]), 10, "table", table)[:, 12:]
    np.testing.assert_array_equal(shown, [[0, 1], [8, 9], [18, 19]])


def test_wrong_kinds():
    with pytest.raises(ValueError, match="clock, table, pose, raw"):
        policy_inputs(np.zeros(11), np.array(0), 10, "time")
    with pytest.raises(ValueError, match="clock, table, pose, raw"):
        PolicyConfig(kind="time")
    with pytest.raises(ValueError, match="needs a table"):
        policy_inputs(np.zeros(11), np.array(0), 10, "table")
    with pytest.raises(ValueError, match="needed by kind"):
        policy("clock", table=np.zeros((10, 2)))
    with pytest.raises(ValueError, match="widths"):
        PolicyConfig(hidden=())


def test_normaliser_is_the_mean_and_deviation_of_all_it_saw():
    rng = np.random.default_rng(0)
    normaliser, batches = Normaliser(3), []
    for size in (1, 7, 40):
        batches.append(rng.normal([5, -1, 0], [1, 10, 0.1], (2, size, 3)))
        normaliser.update(batches[-1])
    seen = np.concatenate([batch.reshape(-1, 3) for batch in batches])
    np.testing.assert_allclose(normaliser.mean, seen.mean(0))
    np.testing.assert_allclose(normaliser.var, seen.var(0))


def test_snapshot_acts_as_the_network():
    trained = policy()
    rng = np.random.default_rng(0)
    obs, clock = 3 * rng.standard_normal((64, 11)), rng.integers(0, 1000, 64)
    trained.observe(obs, clock)
    snapshot = trained.snapshot()
    inputs = snapshot.inputs(obs, clock)
    assert inputs.dtype == np.float32
    assert np.abs(inputs.mean(0)).max() < 0.2
    with torch.no_grad():
        mean = trained(torch.from_numpy(inputs)).numpy()
    np.testing.assert_allclose(snapshot.act(inputs), mean, atol=1e-5)
    assert np.abs(mean).max() > 0.1
    samples = np.stack([snapshot.act(inputs, rng) for _ in range(2000)])
    assert samples.dtype == np.float32
    np.testing.assert_allclose((samples - mean).std((0, 1)), math.exp(-0.3), rtol=0.02)
    np.testing.assert_allclose(samples.mean(0), mean, atol=0.1)


def test_a_snapshot_that_acts_in_torch_acts_as_the_one_in_numpy():
    trained = policy()
    obs, clock = np.random.default_rng(0).standard_normal((64, 11)), np.arange(64)
    plain, torched = trained.snapshot(), trained.snapshot(on_device=True)
    inputs = plain.inputs(obs, clock)
    acts = [snapshot.act(inputs, np.random.default_rng(1)) for snapshot in (plain, torched)]
    np.testing.assert_allclose(*acts, atol=1e-5)
    before = torched.act(inputs)
    with torch.no_grad():
        trained.mean[-1].bias.add_(1.0)
    np.testing.assert_array_equal(torched.act(inputs), before)


def test_snapshot_does_not_change_when_the_policy_does():
    trained = policy()
    snapshot = trained.snapshot()
    obs, clock = np.ones((1, 11)), np.zeros(1, int)
    before = snapshot.act(snapshot.inputs(obs, clock))
    with torch.no_grad():
        for parameter in trained.parameters():
            parameter.add_(1.0)
    trained.observe(5 + np.random.default_rng(0).standard_normal((9, 11)), np.zeros(9, int))
    np.testing.assert_array_equal(snapshot.act(snapshot.inputs(obs, clock)), before)
    now = trained.snapshot()
    assert (now.act(now.inputs(obs, clock)) != before).all()


def test_log_prob_by_hand():
    trained = policy()
    inputs = torch.zeros(1, trained.input_size)
    with torch.no_grad():
        mean = trained(inputs)
        at_mean = trained.log_prob_of(mean, mean)
        one_off = trained.log_prob_of(mean, mean + math.exp(-0.3))
    # log N(mu) = -log sigma - log sqrt(2 pi) per action; one deviation off costs 1/2 each.
    assert at_mean.item() == pytest.approx(3 * (0.3 - 0.5 * math.log(2 * math.pi)), abs=1e-5)
    assert (at_mean - one_off).item() == pytest.approx(1.5, abs=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_saved_and_loaded_without_pickled_code(kind):
    table = np.random.default_rng(0).standard_normal((1000, 2)) if kind == "table" else None
    trained = policy(kind, seed=4, table=table)
    obs, clock = np.random.default_rng(1).standard_normal((20, 11)), np.arange(20)
    trained.observe(obs, clock)
    file = io.BytesIO()
    torch.save(trained.to_dict(), file)
    file.seek(0)
    loaded = Policy.from_dict(torch.load(file, weights_only=True)).snapshot()
    snapshot = trained.snapshot()
    np.testing.assert_array_equal(
        loaded.act(loaded.inputs(obs, clock)), snapshot.act(snapshot.inputs(obs, clock))
    )


def test_seeds_and_the_global_generator():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    a, b, c = mlp((4, 8, 2), 1.0, 0), mlp((4, 8, 2), 1.0, 0), mlp((4, 8, 2), 1.0, 1)
    assert torch.equal(a[0].weight, b[0].weight)
    assert not torch.equal(a[0].weight, c[0].weight)
    assert torch.equal(torch.rand(3), expected), "building a network drew from the global generator"


def test_rescaling_the_value_function_keeps_its_values():
    value = ValueFunction(5, (16,), seed=0)
    inputs = torch.randn(100, 5, generator=torch.Generator().manual_seed(0))
    value.rescale(torch.linspace(0, 10, 50))
    with torch.no_grad():
        before = value(inputs)
        targets = value.rescale(torch.linspace(500, 900, 50))
        after = value(inputs)
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-3)
    assert value.return_mean.item() == pytest.approx(0.8 * 5 + 0.2 * 700)
    torch.testing.assert_close(targets * value.return_std + value.return_mean, torch.linspace(500, 900, 50))


def test_tanh_is_torchs_in_value_and_gradient():
    x = torch.linspace(-12, 12, 401, dtype=torch.float64, requires_grad=True)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        theirs, ours = torch.tanh(x.to(dtype)), Tanh()(x.to(dtype))
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)
        slopes = [torch.autograd.grad(y.sum(), x)[0] for y in (ours, theirs)]
        torch.testing.assert_close(*slopes, rtol=tolerance, atol=tolerance)
