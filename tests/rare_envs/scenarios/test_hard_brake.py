"""The braking lead: where and when it stands, by school physics."""

import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.simulation import drive


def test_the_lead_stops_after_its_braking_distance() -> None:
    """From 20 m/s at 4 m/s^2 it stands after v / a = 5 s and v^2 / 2a = 50 m, and then stays."""
    problem = rare_envs.DrivingProblem("rare_envs/HardBrake-v0", horizon=8.0)
    x = torch.tensor([[20.0, 100.0, 4.0]])
    states = [episode.state for episode in drive(problem.world, problem.driver, x)]
    speed = torch.stack([state.speed[0, 1] for state in states]).numpy()
    place = torch.stack([state.x[0, 1] for state in states]).numpy()
    dt = problem.world.clock.dt
    np.testing.assert_allclose(speed, np.maximum(20.0 - 4.0 * dt * np.arange(len(speed)), 0.0), atol=1e-4)
    # one step of Euler's method with the speed before or after it: half a step of speed in all
    assert place[-1] - place[0] == pytest.approx(50.0, abs=0.5 * dt * 20.0 + 1e-3)
    assert place[-1] == place[-2]


def test_ego_and_lead_start_at_one_speed_and_the_gap_is_between_their_bodies() -> None:
    problem = rare_envs.DrivingProblem("rare_envs/HardBrake-v0", horizon=1.0)
    start = next(iter(drive(problem.world, problem.driver, torch.tensor([[20.0, 30.0, 4.0]]))))
    assert start.state.speed[0].tolist() == [20.0, 20.0]
    assert float(start.lead.gap) == pytest.approx(30.0, abs=1e-4)


def test_harder_braking_is_never_safer() -> None:
    problem = rare_envs.DrivingProblem("rare_envs/HardBrake-v0")
    x = np.array([[25.0, 20.0, deceleration] for deceleration in (1.0, 3.0, 6.0, 10.0)])
    f = problem.evaluate(x)
    assert (np.diff(f) <= 1e-6).all()
    assert f[0] > f[-1]
