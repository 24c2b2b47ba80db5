"""The scripted scenarios, by pencil and paper."""

from itertools import pairwise

import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN, CUT_IN_DURATION, TIMED_CUT_IN, bezier
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


def drive_straight(duration: float, offset: float = 3.0, speed: float = 30.0, dt: float = 0.05) -> torch.Tensor:
    """Return y of a cutter that keeps its speed, at each tick from the start on."""
    state = TIMED_CUT_IN.initial(tensor(20.0, speed, 25.0, 40.0, 60.0, offset, duration)[None])
    found = [state.y[0, 1]]
    for _ in range(round(1.5 * duration / dt)):
        after = TIMED_CUT_IN.driven(state, torch.zeros(1, 2, 2, dtype=F64), dt)
        moved = {name: torch.cat([getattr(state, name)[:, :1], getattr(after, name)], 1) for name in after._fields}
        state = state._replace(**moved)
        found.append(state.y[0, 1])
    return torch.stack(found)


@pytest.mark.parametrize("duration", [2.0, 4.0, 7.5])
def test_a_change_takes_its_duration_and_crosses_the_marking_in_its_middle(duration: float) -> None:
    """y = offset (1 - 3 s^2 + 2 s^3) with s = t / duration: half way across at s = 1/2, by a fifth at s = 0.287.

    Along the road the cutter is slower by the cosine of its heading: by 0.0014 in the mean at 2 s (a slope of
    1.5 x 3 m / 60 m at most), less in longer changes.
    """
    dt = 0.05
    y = drive_straight(duration, dt=dt)
    t = dt * torch.arange(len(y), dtype=F64)
    s = (t / duration).clamp(max=1.0)
    assert (y - 3.0 * (1.0 - 3.0 * s**2 + 2.0 * s**3)).abs().max() < 3.0 * 1.5 * 0.0015
    crossing = t[y <= 1.5][0].item()
    assert duration / 2 <= crossing <= duration / 2 * 1.0015 + dt
    assert t[y <= 0.8 * 3.0][0].item() == pytest.approx(0.287 * duration, abs=dt + 0.001 * duration)
    assert y[-1].item() == 0.0


def test_four_seconds_are_the_first_version_to_the_bit() -> None:
    first, second = (rare_envs.DrivingProblem(f"rare_envs/CutIn-v{version}", base="us101") for version in (0, 1))
    assert first.space.names == second.space.names[:6]
    x = rare_envs.DrivingProblem("rare_envs/CutIn-v0", base="i80").base.sample(400, np.random.default_rng(2))
    f = first.evaluate(x)
    assert (second.evaluate(np.column_stack([x, np.full(400, CUT_IN_DURATION)])) == f).all()
    slow, fast = (second.evaluate(np.column_stack([x, np.full(400, seconds)])) for seconds in (8.0, 2.0))
    assert (slow <= 0.0).sum() > (f <= 0.0).sum() > (fast <= 0.0).sum() > 0
