"""The scripted scenarios, by pencil and paper."""

from itertools import pairwise

import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN, bezier
from rare_envs.simulation import drive
from rare_envs.simulation.world import World
from tests.rare_envs.traffic_states import F64, tensor


def test_car_following_without_brakes_collides_when_the_gap_is_used_up() -> None:
    # 20 m/s behind 10 m/s with a gap of 12.05 m: bumpers meet between 1.2 and 1.3 s
    world = World(CAR_FOLLOWING)
    episode, still = world.start(tensor(20.0, 10.0, 12.05)[None]), torch.zeros(1, 2, dtype=F64)
    assert episode.f.item() == pytest.approx(1.205)
    for _ in range(12):
        episode = world.step(episode, still)
    assert not episode.collided
    assert episode.f.item() == pytest.approx(0.005)
    episode = world.step(episode, still)
    assert episode.collided
    assert episode.f.item() == -1.0


@pytest.mark.parametrize(("peak", "loss", "lost"), [(4.0, 20.0, 20.0), (4.0, 45.0, 20.0), (3.0, 8.0, 8.0)])
def test_the_lead_brakes_in_a_parabola(peak: float, loss: float, lost: float) -> None:
    """From 20 m/s: T = 1.5 loss / peak, mean deceleration 2/3 of the peak, way in T of (20 - loss / 2) T."""
    problem = rare_envs.DrivingProblem("rare_envs/HardBrake-v0", horizon=8.0)
    states = [each.state for each in drive(problem.world, problem.driver, tensor(20.0, 100.0, peak, loss)[None])]
    speed, place = (
        torch.stack([each[0, 1] for each in field]).numpy()
        for field in zip(*((s.speed, s.x) for s in states), strict=True)
    )
    dt, lasting = problem.world.clock.dt, 1.5 * lost / peak
    u = np.minimum(dt * np.arange(len(speed)) / lasting, 1.0)
    np.testing.assert_allclose(speed, 20.0 - lost * (3.0 * u**2 - 2.0 * u**3), atol=1e-9)
    assert -np.diff(speed).min() / dt == pytest.approx(peak, rel=2e-3)
    assert speed[-1] == 20.0 - lost  # exactly: it stands where it loses all
    # one step of Euler's method with the speed before or after it: half a step of the loss in all
    way = (20.0 - lost / 2) * lasting + (20.0 - lost) * (8.0 - lasting)
    assert place[-1] - place[0] == pytest.approx(way + dt * lost / 2, abs=1e-3)


def test_bezier_is_de_casteljau_and_level_at_both_ends() -> None:
    length, offset = 60.0, 3.5
    control = [(0.0, offset), (length / 3, offset), (2 * length / 3, 0.0), (length, 0.0)]
    for t in (0.0, 0.2, 0.5, 0.9, 1.0):
        points = control
        while len(points) > 1:
            points = [((1 - t) * a[0] + t * b[0], (1 - t) * a[1] + t * b[1]) for a, b in pairwise(points)]
        y, slope = bezier(tensor(t * length), tensor(length), tensor(offset))
        assert y.item() == pytest.approx(points[0][1], abs=1e-14)
        eps = 1e-6
        if 0.0 < t < 1.0:
            ahead, behind = (bezier(tensor(t * length + e), tensor(length), tensor(offset))[0] for e in (eps, -eps))
            assert slope.item() == pytest.approx((ahead - behind).item() / (2 * eps), abs=1e-8)
        else:
            assert slope.item() == 0.0


def test_cutter_arrives_in_the_lane_and_minds_its_lead() -> None:
    world = World(CUT_IN)
    episode = world.start(tensor(10.0, 20.0, 12.0, 40.0, 25.0, 3.5)[None])
    for _ in range(world.clock.ticks):
        episode = world.step(episode, torch.zeros(1, 2, dtype=F64))
    state = episode.state
    assert state.y[0, 1].item() == 0.0
    assert state.heading[0, 1].item() == 0.0
    assert state.x[0, 2] - state.x[0, 1] > 5.0  # 8 m/s faster than the lead at first, and still behind it
    assert state.speed[0, 2].item() == 12.0
