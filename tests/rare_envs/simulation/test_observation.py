"""Observations: numbers by hand, and what any vehicle observes."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.make import set_up
from rare_envs.sensors.lidar import perceive_traffic
from rare_envs.simulation.observation import CLIP, observation_space, observe


def test_observation_by_hand() -> None:
    env = gym.make("rare_envs/CutIn-v0")
    x = [20.0, 15.0, 18.0, 10.0, 30.0, 3.6]
    observation, _ = env.reset(options={"x": x})
    cutter, lead = [10 / 50, -5 / 10, 3.6 / 4, 0.0], [45 / 50, -2 / 10, 0.0, 0.0]
    np.testing.assert_allclose(observation, [20 / 30, 0.0, 0.0, *cutter, *lead], rtol=1e-6)
    assert np.abs(observation).max() < CLIP
    assert observation_space(3).shape == (11,)


@torch.inference_mode()
def test_what_the_cutter_observes_by_hand():
    world, _ = set_up("rare_envs/CutIn-v0")
    episode = world.start(torch.tensor([[20.0, 15.0, 18.0, 10.0, 30.0, 3.6]]))
    ego, lead = [-20 / 50, 5 / 10, -3.6 / 4, 0.0], [30 / 50, 3 / 10, -3.6 / 4, 0.0]
    seen = observe(episode, "features", vehicle=1)[0]
    np.testing.assert_allclose(seen, [15 / 30, 3.6 / 4, 0.0, *ego, *lead], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_every_vehicle_observes_what_an_ego_in_its_place_would(env_id):
    world, space = set_up(env_id, observation="lidar", horizon=1.0)
    episode = world.start(torch.from_numpy(space.sample(4, np.random.default_rng(0))).float())
    for vehicle in range(world.scenario.vehicles):
        state = episode.state.seen_by(vehicle)
        as_ego = episode._replace(state=state, perception=perceive_traffic(state, world.scenario.road))
        for observation in ("features", "lidar"):
            torch.testing.assert_close(observe(episode, observation, vehicle), observe(as_ego, observation))
