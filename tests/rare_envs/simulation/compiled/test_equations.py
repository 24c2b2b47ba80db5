"""Each compiled equation against its torch twin in single precision, at random arguments and at the edges."""

import math

import numpy as np
import pytest
import torch

from rare_envs.compilation import single
from rare_envs.control.idm import IDM, lane_keeping
from rare_envs.measures import Moment
from rare_envs.measures.longitudinal import ttc
from rare_envs.simulation.compiled import equations
from rare_envs.traffic import straight
from rare_envs.traffic.bodies import boxes_overlap
from rare_envs.traffic.neighbours import Lead, lead_of
from rare_envs.traffic.state import State
from rare_envs.traffic.vehicle_models import bicycle, steering_for

N = 300
ROUNDING = dict(rtol=2e-6, atol=2e-6)
"""Some units in the last place of single precision, which transcendental functions of two libraries differ by."""
ROADS = [straight(1), straight(2), straight(3, width=3.5)]


def draw(*ranges: tuple[float, float]) -> list[torch.Tensor]:
    rng = np.random.default_rng(5)
    return [torch.from_numpy(rng.uniform(low, high, N)).float() for low, high in ranges]


def each(function, *arguments):
    """Results of a compiled function, row by row, shape (results, N)."""
    rows = [function(*row) for row in zip(*(values.numpy() for values in arguments), strict=True)]
    return np.array(rows).T


def test_constants_are_single_precision():
    assert all(isinstance(value, np.float32) for value in single(1, 0.1))


def test_bicycle():
    args = draw((0, 100), (-4, 4), (-0.5, 0.5), (0, 40), (-8, 3), (-1.0, 1.0))
    dt = np.float32(0.1)
    compiled = each(lambda *row: equations.bicycle(*row, dt), *args)
    assert np.allclose(compiled, torch.stack(bicycle(*args, 0.1)).numpy(), **ROUNDING)


def test_bicycle_does_not_reverse():
    assert equations.bicycle(*single(0, 0, 0, 0.3, -8, 0, 0.1))[3] == 0.0


def test_steering():
    yaw_rate, speed = draw((-3, 3), (0, 40))
    assert np.allclose(
        each(equations.steering_for, yaw_rate, speed), steering_for(yaw_rate, speed).numpy(), rtol=1e-4, atol=1e-5
    )  # near the largest slip a unit in the last place of a sine is 1e-5 of the angle


@pytest.mark.parametrize("road", ROADS)
def test_lane_keeping(road):
    numbers = equations.RoadNumbers.of(road)
    y, heading, speed = draw((-3, 6), (-0.5, 0.5), (0, 40))
    compiled = each(lambda *row: equations.lane_keeping(*row, numbers), y, heading, speed)
    assert np.allclose(compiled, lane_keeping(y, heading, speed, road).numpy(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "idm", [IDM(), IDM(cut_off=True), IDM.highway_env(25.0), IDM(exponent=3.0, jam_distance_speed=0.0)]
)
def test_idm(idm):
    numbers = equations.IDMNumbers.of(idm)
    speed, gap, closing, desired = draw((0, 40), (-2, 120), (-10, 20), (1, 40))
    gap[0] = math.inf
    expected = idm.acceleration(speed, Lead(gap, closing), desired)
    compiled = each(lambda *row: equations.idm_acceleration(numbers, *row), speed, gap, closing, desired)
    assert np.allclose(compiled, expected.numpy(), rtol=1e-5, atol=1e-5)


def test_overlap_of_bodies():
    args = draw((-6, 6), (-3, 3), (-0.4, 0.4), (-0.4, 0.4))
    overlap = boxes_overlap(*args).numpy()
    assert 0.1 < overlap.mean() < 0.9
    assert np.array_equal(each(equations.boxes_overlap, *args), overlap)


def test_bodies_that_touch_do_not_overlap():
    assert not equations.boxes_overlap(*single(5.0, 0.0, 0.0, 0.0))
    assert equations.boxes_overlap(*single(4.999, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("road", ROADS)
def test_lead_and_time_to_collision(road):
    numbers = equations.RoadNumbers.of(road)
    x, y, heading, speed = (torch.stack(draw(*3 * [bounds]), 1) for bounds in [(0, 60), (-2, 6), (-0.2, 0.2), (0, 40)])
    for tensor in (x, y, heading, speed):  # three vehicles with draws of their own
        tensor[:] = tensor[torch.randperm(N, generator=torch.Generator().manual_seed(int(tensor.sum())))]
        tensor[:, 1], tensor[:, 2] = tensor[:, 1].flip(0), tensor[:, 2].roll(7)
    state = State(x, y, heading, speed, x[:, :0])
    lead = lead_of(state, road)
    gap, closing = each(lambda *row: equations.lead_of(*row, numbers), x, y, heading, speed)
    assert 0 < np.isinf(gap).sum() < N
    assert np.array_equal(gap, lead.gap.numpy())
    assert np.allclose(closing, lead.closing_speed.numpy(), rtol=1e-5, atol=1e-5)
    expected = ttc(Moment(state, lead, road, None))
    ego = (lead.gap, lead.closing_speed, y[:, 0], heading[:, 0], speed[:, 0])
    compiled = each(lambda *row: equations.ttc(*row, numbers), *ego)
    assert np.allclose(compiled, expected.numpy(), rtol=1e-4, atol=1e-5)
    off = each(lambda value: equations.off_road(value, numbers), y[:, 0])
    assert np.array_equal(off, road.off_road(y[:, 0]).numpy())
