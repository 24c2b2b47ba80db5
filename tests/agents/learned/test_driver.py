"""Learned drivers: one batched pass against a loop over networks, the noise and the limits; as egos, and by rule."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from agents import LearnedDriver, LearnedEgo, load_driver
from agents.learned.driver import RuleDriver
from agents.learned.networks import HEAD_SIZE, AutoregressiveNoise, WeightDistribution, head_weights
from rare_envs.control.actions import MAX_ACCELERATION
from rare_envs.control.idm import IDM
from rare_envs.sensors.lidar import AHEAD_BEAM, CURVATURE_COLUMN, RANGE_COLUMNS, RATE_COLUMNS, SPEED_COLUMN
from rare_envs.simulation.observation import LIDAR_SCALES
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.vehicle_models import bicycle
from tests.agents.learned.heads import replace_head

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
    for name in ("features", *change):
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


# --- as ego --------------------------------------------------------------------------------------


def test_the_ego_moves_the_bicycle_as_its_driver_wants(driver, features):
    perception = features(8, 3)
    perception[..., CURVATURE_COLUMN] = 0.0
    speed = torch.linspace(5.0, 30.0, 8)
    perception[:, 0, SPEED_COLUMN] = speed
    action, memory = LearnedEgo(driver).act(SimpleNamespace(perception=perception), None)
    wanted = driver.act(perception)[0][:, 0]
    zero = torch.zeros(8)
    _, _, heading, new_speed = bicycle(zero, zero, zero, speed, action[:, 0], action[:, 1], DT)
    torch.testing.assert_close(heading / DT, wanted[:, 1], atol=1e-5, rtol=0.0)
    torch.testing.assert_close(new_speed, speed + DT * wanted[:, 0])
    assert memory is None


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


@pytest.mark.parametrize("env_id", ["rare_envs/CarFollowing-v0", "rare_envs/Highway-v0"])
def test_what_is_simulated_replays_in_an_environment_step_by_step(env_id):
    settings = {"drivers": "idm", "horizon": 5.0}
    ego = LearnedEgo(load_driver("mgail"))
    problem = rare_envs.DrivingProblem(env_id, ego=ego, **settings)
    env = gym.make(env_id, observation="lidar", **settings)
    for x in problem.base.sample(3, np.random.default_rng(0)):
        observation, _ = env.reset(options={"x": x})
        over, taken = False, []
        while not over:
            action, _ = ego.predict(observation)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            taken.append(action)
        assert np.abs(taken).max() < 1.0  # never at a limit that the simulation does not have
        assert info["measure"] == pytest.approx(problem.evaluate(x[None])[0], abs=1e-3)


# --- by rule -------------------------------------------------------------------------------------


def seen(offset=0.0, heading=0.0, speed=15.0, ahead=100.0, rate=0.0):
    features = torch.zeros(1, 1, 51)
    features[..., :5] = torch.tensor([offset, heading, speed, 5.0, 2.0])
    features[..., RANGE_COLUMNS] = 100.0
    features[..., RANGE_COLUMNS.start + AHEAD_BEAM], features[..., RATE_COLUMNS.start + AHEAD_BEAM] = ahead, rate
    return features


def test_it_is_idm_on_the_beam_ahead():
    (action,), _ = RuleDriver().act(seen(ahead=22.5, rate=-3.0))
    expected = IDM().acceleration(torch.tensor([15.0]), Lead(torch.tensor([20.0]), torch.tensor([3.0])))
    assert action[0, 0] == pytest.approx(float(expected))


def test_it_steers_back_to_the_middle_and_along_the_road():
    driver = RuleDriver()
    assert driver.act(seen(offset=0.09))[0][0, 0, 1] == pytest.approx(-5 * 0.01, rel=1e-3)
    assert driver.act(seen(heading=0.01))[0][0, 0, 1] == pytest.approx(-0.05)
    assert driver.act(seen(offset=3.0))[0][0, 0, 1] == pytest.approx(-0.3)
