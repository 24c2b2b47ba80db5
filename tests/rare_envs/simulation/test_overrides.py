"""Vehicles around the ego that take actions, and what drives them afterwards."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.make import set_up
from rare_envs.sensors.lidar import perceive_traffic
from rare_envs.simulation.observation import CLIP, observation_space, observe

every = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)


def start(env_id, n=4, **kwargs):
    world, space = set_up(env_id, **kwargs)
    x = torch.from_numpy(space.sample(n, np.random.default_rng(0))).float()
    return world, world.start(x)


def ego_action(n):
    return torch.tensor([[1.0, 0.002]]).expand(n, 2)


@every
@torch.inference_mode()
def test_a_commanded_vehicle_moves_as_an_ego_in_its_place_would(env_id):
    world, episode = start(env_id, horizon=2.0, drivers="idm")
    batch, n = episode.state.x.shape
    for vehicle in range(1, n):
        swapped = episode._replace(state=episode.state.seen_by(vehicle), background_state=None)
        driven, commanded = episode, torch.zeros(batch, n, dtype=torch.bool)
        commanded[:, vehicle] = True
        action = torch.zeros(batch, n, 2)
        action[:, vehicle] = ego_action(batch)
        for _ in range(5):
            driven = world.step(driven, action, commanded)
            swapped = world.step(swapped, ego_action(batch))
        for one, other in zip(driven.state[:4], swapped.state[:4], strict=True):
            torch.testing.assert_close(one[:, vehicle], other[:, 0], rtol=1e-6, atol=1e-5)
        others = [j for j in range(1, n) if j != vehicle]  # were never commanded
        assert not driven.overridden[:, others].any()


@torch.inference_mode()
def test_a_commanded_lead_brakes_as_in_the_textbook():
    world, _ = start("rare_envs/CarFollowing-v0")
    episode = world.start(torch.tensor([[20.0, 20.0, 50.0]]))
    action = torch.tensor([[[0.0, 0.0], [-4.0, 0.0]]])
    for _ in range(30):
        episode = world.step(episode, action, torch.tensor([[False, True]]))
    t, dt = 3.0, world.clock.dt
    assert float(episode.state.speed[0, 1]) == pytest.approx(20.0 - 4.0 * t, abs=1e-4)
    # explicit Euler moves with the old speed: half a tick of the acceleration more than v t - a t^2 / 2
    way = 20.0 * t - 2.0 * t**2 + 4.0 * t * dt / 2
    assert float(episode.state.x[0, 1]) == pytest.approx(55.0 + way, abs=1e-3)
    assert float(episode.lead.gap) == pytest.approx(50.0 + way - 60.0, abs=1e-3)


@every
@pytest.mark.parametrize("drivers", [None, "mgail"])
@torch.inference_mode()
def test_a_vehicle_that_is_commanded_no_longer_goes_on_from_where_it_is(env_id, drivers):
    world, episode = start(env_id, horizon=4.0, drivers=drivers, noise=False)
    batch, n = episode.state.x.shape
    action = torch.zeros(batch, n, 2)
    action[:, 1:] = torch.tensor([-1.0, 0.01])
    for tick in range(world.clock.ticks):
        before = episode.state
        commanded = torch.full((batch, n), tick < 10)
        episode = world.step(episode, action, commanded) if tick < 20 else world.step(episode, action[:, 0])
        moved = torch.hypot(episode.state.x - before.x, episode.state.y - before.y)
        assert (moved <= before.speed * world.clock.dt * 1.05 + 1e-3).all()  # the I-80 is longer on its outer lanes
        assert ((episode.state.speed - before.speed).abs() <= 1.0).all()


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
