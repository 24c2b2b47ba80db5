"""A learned driver as ego: what it does with a bicycle on a road, and what it answers to an environment."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from agents import LearnedDriver, LearnedEgo, load_driver
from rare_envs.control.actions import MAX_ACCELERATION
from rare_envs.sensors.lidar import CURVATURE_COLUMN, SPEED_COLUMN
from rare_envs.simulation.observation import LIDAR_SCALES
from rare_envs.traffic.vehicle_models import STEERING_LIMIT, bicycle, steering_for

DT = 0.1


@pytest.fixture
def driver(policy):
    return LearnedDriver(policy)


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steering_at_low_speed(dtype):
    """As far as the wheels go and to the right side, finite with its gradient at standstill."""
    speed = torch.zeros(3, dtype=dtype, requires_grad=True)
    wanted = torch.tensor([-0.3, 0.0, 0.3], dtype=dtype, requires_grad=True)
    steering = steering_for(wanted, speed)
    torch.testing.assert_close(steering, torch.tensor([-STEERING_LIMIT, 0.0, STEERING_LIMIT], dtype=dtype))
    for gradient in torch.autograd.grad(steering.sum(), (speed, wanted)):
        assert bool(gradient.isfinite().all())
