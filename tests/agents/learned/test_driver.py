"""A learned driver: its network and noise by hand, the distribution of its weights, act, as ego, and by rule."""

import copy
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats

from agents import LearnedDriver, LearnedEgo
from agents.learned.driver import RuleDriver
from agents.learned.networks import (
    FEATURE_CLIP,
    HEAD_SIZE,
    HUMAN_NOISE,
    AutoregressiveNoise,
    Policy,
    WeightDistribution,
    head_weights,
)
from rare_envs.control.actions import MAX_ACCELERATION
from rare_envs.control.idm import IDM
from rare_envs.sensors.lidar import CURVATURE_COLUMN, SPEED_COLUMN
from rare_envs.simulation.observation import LIDAR_SCALES
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.state import bicycle
from tests.agents.learned.test_collision_avoidance import seen


def replace_head(policy: Policy, weights: torch.Tensor) -> Policy:
    """Return a copy of a network with other weights (404,) in its last layer, as `head_weights` has them."""
    changed, layer = copy.deepcopy(policy), weights.detach().view(4, 101)
    changed.head.weight.data, changed.head.bias.data = layer[:, :-1].clone(), layer[:, -1].clone()
    return changed


def test_forward_by_hand(policy, features):
    x = 5.0 * features(3, 2)  # some are clipped
    mean, log_std = policy(x)

    arrays = {name: value.double().numpy() for name, value in policy.state_dict().items()}
    z = (x.double().numpy() - arrays["feature_mean"]) / arrays["feature_std"]
    z = np.clip(z, -FEATURE_CLIP, FEATURE_CLIP)
    for layer in ("first", "second"):
        z = np.tanh(z @ arrays[f"{layer}.weight"].T + arrays[f"{layer}.bias"])
    out = z @ arrays["head.weight"].T + arrays["head.bias"]
    np.testing.assert_allclose(mean.numpy(), out[..., :2], atol=1e-5)
    cap = arrays["log_std_cap"]
    np.testing.assert_allclose(log_std.numpy(), cap - np.log1p(np.exp(cap - out[..., 2:])), atol=1e-5)


# --- noise ---------------------------------------------------------------------------------------


def sequence(colour, ticks, n=100_000, seed=0):
    generator = torch.Generator().manual_seed(seed)
    memory = colour.begin(torch.randn(n, 2, 2, generator=generator))
    values = []
    for _ in range(ticks):
        value, memory = colour.step(memory, torch.randn(n, 2, generator=generator))
        values.append(value)
    return torch.stack(values)


@pytest.mark.parametrize("colour", [HUMAN_NOISE, AutoregressiveNoise((0.95, 0.5), (0.0, 0.0)), AutoregressiveNoise()])
def test_noise_is_stationary_from_the_first_tick_and_obeys_the_recursion(colour):
    values = sequence(colour, 30)
    # the variance of n = 1e5 draws has a standard error of sqrt(2 / n) = 0.0045
    torch.testing.assert_close(values.var(dim=1), torch.ones(30, 2), atol=5 * 0.0045, rtol=0)
    for action, (a, b) in enumerate(zip(colour.first, colour.second, strict=True)):
        rho = [1.0, a / (1 - b)]
        for _ in range(19):
            rho.append(a * rho[-1] + b * rho[-2])
        for lag in (1, 5, 10, 20):
            found = float((values[0, :, action] * values[lag, :, action]).mean())
            assert found == pytest.approx(rho[lag], abs=5 / math.sqrt(100_000) * 1.5)


def test_balanced_noise_adds_up_to_nothing_but_what_is_fresh():
    noise = AutoregressiveNoise(HUMAN_NOISE.first, HUMAN_NOISE.second, balanced=True)
    memory = noise.begin(torch.randn(5, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    total = torch.zeros(5, 2, dtype=torch.float64)
    for _ in range(400):
        value, memory = noise.step(memory, torch.zeros(5, 2, dtype=torch.float64))
        total += value
    torch.testing.assert_close(total, torch.zeros_like(total), atol=1e-6, rtol=0)
    values = sequence(noise, 150)
    torch.testing.assert_close(values[-1].var(dim=0), torch.ones(2), atol=5 * 0.0045, rtol=0)


def test_noises_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="stationary"):
        AutoregressiveNoise((1.0, 0.5), (0.0, 0.0))
    with pytest.raises(ValueError, match="Expected coefficients of lag 2 of a noise that begins balanced"):
        AutoregressiveNoise((0.9, 0.9), (0.0, 0.0), balanced=True)


PRECISION = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, -0.5], [0.0, -0.5, 2.0]])
MEAN = np.array([1.0, -2.0, 0.5])


@pytest.fixture
def small():
    return WeightDistribution(MEAN, PRECISION)


def test_maps_are_inverse_and_density_is_theirs(weight_distribution, rng):
    """log p(x) = log phi(u) - log |dx / du| at u = the point in standard normal space."""
    u = rng.standard_normal((20, weight_distribution.dim))
    x = weight_distribution.from_standard_normal(u)
    np.testing.assert_allclose(weight_distribution.to_standard_normal(x), u, atol=1e-10)
    _, log_det = np.linalg.slogdet(weight_distribution.precision)
    np.testing.assert_allclose(
        weight_distribution.log_prob(x), stats.norm.logpdf(u).sum(axis=1) + 0.5 * log_det, rtol=1e-12
    )
    np.testing.assert_allclose(
        weight_distribution.covariance @ weight_distribution.precision, np.eye(weight_distribution.dim), atol=1e-8
    )
    np.testing.assert_array_equal(weight_distribution.cholesky, np.tril(weight_distribution.cholesky))


def test_what_is_no_law_is_refused(small):
    for given, message in (
        ((MEAN, PRECISION[:2]), r"got \(3,\) and \(2, 3\)"),
        ((MEAN * np.nan, PRECISION), "finite"),
        ((MEAN, PRECISION + np.triu(np.ones((3, 3)), 1)), "symmetric"),
        ((MEAN, -PRECISION), "positive definite"),
        ((MEAN, PRECISION, -1.0), "radius"),
    ):
        with pytest.raises(ValueError, match=message):
            WeightDistribution(*given)
    arrays = small.to_arrays()
    for wrong in ({"columns": arrays["columns"] + 1}, {"rows": arrays["columns"] + 1}, {"rows": arrays["rows"] - 1}):
        with pytest.raises(ValueError, match=r"upper triangle|exceeds|negative"):
            WeightDistribution.from_arrays({**arrays, **wrong})
    with pytest.raises(ValueError, match="same length"):
        WeightDistribution.from_arrays({**arrays, "precision": arrays["precision"][1:]})


DT = 0.1


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


def test_actions_stay_within_their_limits(policy, features):
    driver = LearnedDriver(policy, acceleration=(-5.0, 3.0), yaw_rate=(-0.1, 0.2))
    for sign, expected in ((-1.0, (-5.0, -0.1)), (1.0, (3.0, 0.2))):
        fresh, memory = torch.full((2, 3, 2), sign * 1e3), torch.zeros(2, 3, 2, 2)
        action, _ = driver.act(features(2, 3), innovations=fresh, memory=memory)
        torch.testing.assert_close(action, torch.tensor(expected).expand(2, 3, 2))
    with pytest.raises(ValueError, match="ascending"):
        LearnedDriver(policy, acceleration=(4.0, -8.0))
    with pytest.raises(ValueError, match="404 weights"):
        LearnedDriver(policy, weights=WeightDistribution(np.zeros(3), np.eye(3)))


def test_wrong_shapes_are_refused(driver):
    noise = torch.zeros(4, 3, 2)
    for change, message in (
        ({"features": torch.zeros(4, 51)}, r"features of shape \(B, M, 51\), got \(4, 51\)"),
        ({"weights": torch.zeros(HEAD_SIZE)}, r"weights of shape \(4, 404\), got \(404,\)"),
        ({"innovations": torch.zeros(4, 2)}, r"innovations of shape \(4, 3, 2\)"),
        ({"innovations": noise}, "memory beside the innovations"),
        ({"innovations": noise, "memory": noise}, r"memory of shape \(4, 3, 2, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            driver.act(**{"features": torch.zeros(4, 3, 51), **change})


# --- as ego --------------------------------------------------------------------------------------


def test_the_ego_turns_with_the_road(driver, features):
    """A bend of 1/500 m to the right is steered on top of what the driver does, and the driver sees it as a feature."""
    straight = features(4, 1)
    speed = torch.full((4,), 20.0)
    straight[:, 0, SPEED_COLUMN] = speed
    straight[..., CURVATURE_COLUMN] = 0.0
    bend = straight.clone()
    bend[..., CURVATURE_COLUMN] = 0.002
    yaw_rates = []
    for perception in (straight, bend):
        action, _ = LearnedEgo(driver).act(SimpleNamespace(perception=perception), None)
        zero = torch.zeros(4)
        _, _, heading, _ = bicycle(zero, zero, zero, speed, action[:, 0], action[:, 1], DT)
        yaw_rates.append(heading / DT)
    difference = driver.act(bend)[0][:, 0, 1] - driver.act(straight)[0][:, 0, 1]
    torch.testing.assert_close(yaw_rates[1] - yaw_rates[0], difference + 0.04, atol=1e-4, rtol=0.0)


def test_the_ego_predicts_what_it_does(driver, generator):
    """The environment's units and limits, one observation or many, and nothing random or remembered."""
    ego = LearnedEgo(driver)
    observation = 0.3 * torch.randn(16, 51, generator=generator)
    observation[:, SPEED_COLUMN] = 0.5
    perception = (observation * torch.tensor(LIDAR_SCALES))[:, None]
    observation = observation.numpy()
    physical, _ = ego.act(SimpleNamespace(perception=perception), None)
    action, memory = ego.predict(observation, state="kept", deterministic=False)
    expected = (physical / torch.tensor([MAX_ACCELERATION, 0.1])).clamp(-1.0, 1.0).numpy()
    np.testing.assert_allclose(action, expected, atol=1e-5)
    assert 0.0 < np.abs(action).min() and (np.abs(action) < 1.0).any()
    assert memory == "kept"
    np.testing.assert_allclose(ego.predict(observation[3])[0], action[3], atol=1e-5)
    assert ego.observation_space.contains(observation[3])
    assert ego.action_space.contains(action[3])
    with pytest.raises(ValueError, match=r'\(B, 51\), got \(1, 7\).*observation="lidar"'):
        ego.predict(np.zeros((1, 7), np.float32))


# --- by rule -------------------------------------------------------------------------------------


def test_it_is_idm_on_the_beam_ahead():
    (action,), _ = RuleDriver().act(seen(15.0, range_0=22.5, rate_0=-3.0).float())
    expected = IDM().acceleration(torch.tensor([15.0]), Lead(torch.tensor([20.0]), torch.tensor([3.0])))
    assert action[0, 0] == pytest.approx(float(expected))


def test_it_steers_back_to_the_middle_and_along_the_road():
    for place, expected in (
        ({"lane_offset": 0.09}, pytest.approx(-5 * 0.01, rel=1e-3)),
        ({"heading": 0.01}, pytest.approx(-0.05)),
        ({"lane_offset": 3.0}, pytest.approx(-0.3)),
    ):
        assert RuleDriver().act(seen(15.0, **place).float())[0][0, 0, 1] == expected
