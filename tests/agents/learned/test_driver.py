"""Learned drivers: one batched pass against a loop over networks, the noise and the limits."""

import numpy as np
import pytest
import torch

from agents import LearnedDriver
from agents.learned.networks import HEAD_SIZE, AutoregressiveNoise, WeightDistribution, head_weights
from tests.agents.learned.heads import replace_head


@pytest.fixture
def driver(policy):
    return LearnedDriver(policy, colour=AutoregressiveNoise((0.95, 0.8), (0.0, -0.3)))


def test_one_pass_equals_a_loop_over_networks(driver, features, generator):
    """Three ticks with noise: each scenario by a network of its own, vehicle by vehicle."""
    batch, vehicles = 32, 5
    weights = head_weights(driver.policy) + 0.01 * torch.randn(batch, HEAD_SIZE, generator=generator)
    networks = [replace_head(driver.policy, row) for row in weights]
    memory = driver.begin(torch.randn(batch, vehicles, 2, 2, generator=generator))
    for _ in range(3):
        x = features(batch, vehicles)
        xi = torch.randn(batch, vehicles, 2, generator=generator)
        eps, after = driver.colour.step(memory, xi)
        action, memory = driver.act(x, weights, xi, memory)
        for b, network in enumerate(networks):
            for m in range(vehicles):
                mean, log_std = network(x[b, m])
                scaling = network.scaling
                expected = scaling.action_mean + scaling.action_std * (mean + log_std.exp() * eps[b, m])
                expected = torch.stack((expected[0].clamp(-8.0, 4.0), expected[1].clamp(-0.3, 0.3)))
                torch.testing.assert_close(action[b, m], expected, atol=1e-5, rtol=0.0)
        torch.testing.assert_close(memory, after)


def test_the_network_runs_once_for_all(driver, features, generator):
    rows = []
    with driver.policy.first.register_forward_hook(lambda module, inputs, output: rows.append(len(output))):
        driver.act(features(7, 3), torch.randn(7, HEAD_SIZE, generator=generator))
    assert rows == [21]


def test_own_weights_and_none_agree(driver, features):
    x = features(4, 2)
    weights = head_weights(driver.policy).expand(4, HEAD_SIZE)
    torch.testing.assert_close(driver.act(x, weights)[0], driver.act(x)[0], atol=1e-6, rtol=0.0)


def test_weights_may_come_as_draws_of_a_distribution(driver, features, weight_distribution, rng):
    x = features(4, 2)
    weights = torch.from_numpy(weight_distribution.sample(4, rng))
    action, _ = driver.act(x, weights)
    assert action.dtype == torch.float32
    torch.testing.assert_close(action, driver.act(x, weights.float())[0])


def test_white_noise_forgets(policy, features, generator):
    driver = LearnedDriver(policy)
    x, xi = features(3, 2), torch.randn(3, 2, 2, generator=generator)
    first, _ = driver.act(x, None, xi, torch.ones(3, 2, 2, 2))
    torch.testing.assert_close(first, driver.act(x, None, xi, torch.zeros(3, 2, 2, 2))[0])


def test_without_innovations_the_mean_acts(driver, features):
    x = features(3, 2)
    action, _ = driver.act(x, memory=torch.full((3, 2, 2, 2), 5.0))
    mean, _ = driver.policy(x)
    scaling = driver.policy.scaling
    torch.testing.assert_close(action, scaling.action_mean + scaling.action_std * mean)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_actions_stay_within_their_limits(policy, features, sign):
    driver = LearnedDriver(policy, acceleration=(-5.0, 3.0), yaw_rate=(-0.1, 0.2))
    fresh, memory = torch.full((2, 3, 2), sign * 1e3), torch.zeros(2, 3, 2, 2)
    action, _ = driver.act(features(2, 3), innovations=fresh, memory=memory)
    expected = torch.tensor([-5.0, -0.1] if sign < 0 else [3.0, 0.2])
    torch.testing.assert_close(action, expected.expand(2, 3, 2))


def test_strides_and_precision_of_the_input_do_not_matter(driver, features):
    x = features(4, 6)
    action, _ = driver.act(x[:, ::2])
    torch.testing.assert_close(action, driver.act(x[:, ::2].contiguous())[0])
    double, _ = driver.act(x[:, ::2].double())
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), action)


def test_actions_have_gradients_in_features_and_weights(driver, features, generator):
    x = (0.1 * features(2, 2)).requires_grad_()
    weights = head_weights(driver.policy).repeat(2, 1).requires_grad_()
    action, _ = driver.act(x, weights, torch.randn(2, 2, 2, generator=generator), torch.ones(2, 2, 2, 2))
    of_x, of_weights = torch.autograd.grad(action.sum(), (x, weights))
    assert bool(of_x.isfinite().all()) and of_x.abs().sum() > 0.0
    assert of_weights.count_nonzero() == 2 * HEAD_SIZE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": torch.zeros(4, 51)}, r"features of shape \(B, M, 51\), got \(4, 51\)"),
        ({"weights": torch.zeros(HEAD_SIZE)}, r"weights of shape \(4, 404\), got \(404,\)"),
        ({"innovations": torch.zeros(4, 2)}, r"innovations of shape \(4, 3, 2\)"),
        ({"innovations": torch.zeros(4, 3, 2)}, "memory beside the innovations"),
        ({"innovations": torch.zeros(4, 3, 2), "memory": torch.zeros(4, 3, 2)}, r"memory of shape \(4, 3, 2, 2\)"),
    ],
)
def test_wrong_shapes_are_refused(driver, change, message):
    with pytest.raises(ValueError, match=message):
        driver.act(**{"features": torch.zeros(4, 3, 51), **change})


@pytest.mark.parametrize("name", ["features", "weights", "innovations", "memory"])
def test_arrays_in_place_of_tensors_are_refused(driver, name):
    with pytest.raises(TypeError, match=f"{name} as a torch.Tensor, got ndarray"):
        driver.act(**{"features": torch.zeros(4, 3, 51), name: np.zeros((4, 3, 51))})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"acceleration": (4.0,)}, "two numbers"),
        ({"acceleration": (4.0, -8.0)}, "ascending"),
        ({"yaw_rate": (float("nan"), 0.3)}, "ascending"),
        ({"weights": WeightDistribution(np.zeros(3), np.eye(3))}, "404 weights"),
    ],
)
def test_impossible_drivers_are_refused(policy, change, message):
    with pytest.raises(ValueError, match=message):
        LearnedDriver(policy, **change)
