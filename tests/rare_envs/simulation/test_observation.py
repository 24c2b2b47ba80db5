"""What an ego observes."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.make import set_up
from rare_envs.sensors.lidar import perceive_traffic
from rare_envs.simulation.observation import CLIP, Sensing, observation_space, observe


def test_observation_by_hand() -> None:
    env = gym.make("rare_envs/CutIn-v0")
    x = [20.0, 15.0, 18.0, 10.0, 30.0, 3.6]
    observation, _ = env.reset(options={"x": x})
    cutter, lead = [10 / 50, -5 / 10, 3.6 / 4, 0.0], [45 / 50, -2 / 10, 0.0, 0.0]
    np.testing.assert_allclose(observation, [20 / 30, 0.0, 0.0, *cutter, *lead], rtol=1e-6)
    assert np.abs(observation).max() < CLIP
    assert observation_space(3).shape == (11,)


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_every_vehicle_observes_what_an_ego_in_its_place_would(env_id):
    world, space = set_up(env_id, observation="lidar", horizon=1.0)
    episode = world.start(torch.from_numpy(space.sample(4, np.random.default_rng(0))).float())
    for vehicle in range(world.scenario.vehicles):
        state = episode.state.seen_by(vehicle)
        as_ego = episode._replace(state=state, perception=perceive_traffic(state, world.scenario.road))
        for observation in ("features", "lidar"):
            torch.testing.assert_close(observe(episode, observation, vehicle), observe(as_ego, observation))


def test_lidar_is_computed_where_it_is_observed_or_needed() -> None:
    assert not Sensing("camera+features").uses_lidar
    assert Sensing("camera+lidar").uses_lidar
    assert Sensing("features", lidar=True).uses_lidar


def test_a_camera_starts_at_tick_0_with_the_weather_of_x() -> None:
    x, key = torch.tensor([[0.01, 30.0, 90.0, 2.0]]), torch.tensor([[0.5]])
    assert Sensing("features", weather=True).start_camera(x, key) is None
    context = Sensing("camera", weather=True).start_camera(x, key)
    assert context is not None
    assert context.tick.tolist() == [0]
    torch.testing.assert_close(context.weather.fog, torch.tensor([0.01]))
    torch.testing.assert_close(context.weather.sun_elevation, torch.tensor([torch.pi / 6]))
    clear = Sensing("camera").start_camera(x[:, :0], key[:, :0])
    assert clear is not None
    assert clear.weather.noise.tolist() == [0.0]
