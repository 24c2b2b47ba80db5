"""Compiled motion on the curved road against its torch twins."""

import numpy as np
import torch

from rare_envs.scenarios.base import State, drive_points
from rare_envs.simulation.compiled.highway import curved_road
from rare_envs.traffic.road import i80
from rare_envs.traffic.vehicle_models import bicycle

N, DT = 300, np.float32(0.1)
ROAD, NUMBERS = i80(), curved_road.CurvedRoadNumbers.of(i80())
ROUNDING = dict(rtol=2e-6, atol=2e-6)


def draw(*ranges: tuple[float, float]) -> list[torch.Tensor]:
    rng = np.random.default_rng(6)
    return [torch.from_numpy(rng.uniform(low, high, N)).float() for low, high in ranges]


def each(function, *arguments):
    """Results of a compiled function, row by row, shape (results, N)."""
    rows = [function(*row) for row in zip(*(values.numpy() for values in arguments), strict=True)]
    return np.array(rows).T


def test_lanes_and_their_middles_off_the_road_too():
    (y,) = draw((-6, 25))
    y = torch.cat((y, torch.tensor(ROAD.edges)))
    assert np.array_equal(each(lambda y: curved_road.lane_at(y, NUMBERS), y), ROAD.lane_of(y).numpy())
    assert np.allclose(each(lambda y: curved_road.lane_middle(y, NUMBERS), y), ROAD.centre_of(y).numpy(), **ROUNDING)


def test_places_in_the_world_before_in_and_after_the_curve():
    x, y, heading = draw((-50, 900), (-2, 20), (-0.3, 0.3))
    found = each(lambda *row: curved_road.place_on_curve(*row, NUMBERS), x, y, heading)
    place = ROAD.place(x, y, heading)
    expected = torch.stack((place.x, place.y, place.heading, place.heading.cos(), place.heading.sin(), place.curvature))
    assert np.allclose(found, expected.numpy(), rtol=1e-6, atol=5e-6)


def test_bicycle():
    args = draw((0, 700), (-2, 20), (-0.3, 0.3), (0, 30), (-8, 3), (-0.5, 0.5))
    curvature = ROAD.curvature(args[0])
    expected = torch.stack(bicycle(*args, 0.1, curvature)).numpy()
    assert np.allclose(
        each(lambda *row: curved_road.bicycle_on_curve(*row[:6], DT, row[6]), *args, curvature), expected, **ROUNDING
    )


def test_points_that_turn_at_will():
    x, y, heading, speed, *action = draw((0, 700), (-2, 20), (-0.3, 0.3), (0, 30), (-8, 3), (-0.5, 0.5))
    state = State(
        *(torch.stack((value, value), 1) for value in (x, y, heading, speed)), theta=x[:, None, None][:, :0, 0]
    )
    expected = torch.cat(drive_points(state, torch.stack(action, 1)[:, None], 0.1, ROAD), 1).T.numpy()
    found = each(
        lambda *row: curved_road.point_on_curve(*row[:6], DT, row[6]), x, y, heading, speed, *action, ROAD.curvature(x)
    )
    assert np.allclose(found, expected, **ROUNDING)
