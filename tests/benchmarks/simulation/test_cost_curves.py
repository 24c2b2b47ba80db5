"""The scenario of the cost curves: a queue, as HighwayEnv plays it."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from benchmarks.simulation import highway_env_reference as reference
from benchmarks.simulation.cost_curves import GAP, queue
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.simulation.rollout import rollout

TICKS = 50


@pytest.fixture
def env_id(vehicles):
    name = f"benchmark/TestQueue{vehicles}-v0"
    rare_envs.register_scenario(name, queue(vehicles))
    yield name
    SCENARIOS.remove(name)
    del gym.registry[name]


@pytest.mark.parametrize("vehicles", [2, 5])
def test_the_queue_is_that_of_highway_env(vehicles, env_id):
    problem = rare_envs.DrivingProblem(env_id, horizon=TICKS / 10, core="torch")
    end = rollout(problem.world, problem.driver, torch.tensor([[24.0]], dtype=torch.float64)).state
    road = reference.queue_road(vehicles, 24.0, GAP)
    reference.drive_road(road, TICKS)
    assert np.allclose(end.x[0], [each.position[0] for each in road.vehicles], atol=1e-6)
    assert np.allclose(end.speed[0], [each.speed for each in road.vehicles], atol=1e-6)
    assert end.speed[0, 0] < 24.0  # at 1.25 s behind the one ahead the ego brakes
