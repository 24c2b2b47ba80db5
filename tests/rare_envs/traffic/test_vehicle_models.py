"""Vehicle models by pencil and paper: straight lines, circles, standstill."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from rare_envs.traffic.state import STEERING_LIMIT, bicycle, point_mass, steering_for
from tests.rare_envs.traffic_states import tensor


def test_bicycle_straight_line_is_uniform_acceleration() -> None:
    x, y, heading, speed = tensor(0.0), tensor(0.0), tensor(0.0), tensor(20.0)
    for _ in range(10):
        x, y, heading, speed = bicycle(x, y, heading, speed, tensor(1.0), tensor(0.0), 0.1)
    # explicit Euler: sum of (20 + 0.1 k) 0.1 for k = 0..9
    assert x.item() == pytest.approx(20.0 + 0.45)
    assert (y.item(), heading.item(), speed.item()) == (0.0, 0.0, pytest.approx(21.0))


def test_bicycle_turns_on_the_kinematic_circle() -> None:
    # yaw rate = v sin(beta) / (L/2): a full circle takes 2 pi / rate
    steering, v, dt = 0.2, 10.0, 2e-3
    beta = math.atan(math.tan(steering) / 2)
    rate = v * math.sin(beta) / 2.5
    state = (tensor(0.0), tensor(0.0), tensor(0.0), tensor(v))
    for _ in range(round(2 * math.pi / rate / dt)):
        state = bicycle(*state, tensor(0.0), tensor(steering), dt)
    assert (state[0].item(), state[1].item()) == pytest.approx((0.0, 0.0), abs=0.1)


def test_vehicles_stop_and_do_not_reverse() -> None:
    *_, speed = bicycle(tensor(0.0), tensor(0.0), tensor(0.0), tensor(0.3), tensor(-5.0), tensor(0.0), 0.1)
    assert speed.item() == 0.0


def test_straight_on_is_the_same_bits_beside_vehicles_that_turn_and_alone() -> None:
    generator = torch.Generator().manual_seed(0)
    x, y, speed, acceleration = torch.randn(4, 100, generator=generator) * 10
    zero, turning = torch.zeros(100), torch.zeros(100)
    turning[-1] = 0.1
    with torch.no_grad():
        alone = bicycle(x, y, zero, speed.abs(), acceleration, zero, 0.1)
        beside = bicycle(x, y, zero, speed.abs(), acceleration, turning, 0.1)
    for one, other in zip(alone, beside, strict=True):
        assert torch.equal(one[:-1], other[:-1])
    assert alone[2][-1] != beside[2][-1]


def test_steering_for_a_yaw_rate_is_how_the_bicycle_turns_at_it() -> None:
    speed, rate = tensor(0.02, 3.0, 20.0, 20.0), tensor(0.004, -0.5, 0.3, 0.0)
    zero = torch.zeros_like(speed)
    *_, heading, _ = bicycle(zero, zero, zero, speed, zero, steering_for(rate, speed), 0.1)
    torch.testing.assert_close(heading, 0.1 * rate)
    # whoever is too slow for it, a vehicle at rest for one, steers as far as it goes
    largest = steering_for(tensor(0.5, -0.5, 0.5), tensor(1.0, 0.0, 0.0))
    torch.testing.assert_close(largest, STEERING_LIMIT * tensor(1.0, -1.0, 1.0))


def test_a_point_mass_turns_at_its_yaw_rate() -> None:
    # v = 10 m/s at 0.5 rad/s is a circle of radius 20 m; in explicit Euler steps of 1 ms, a polygon within 2 cm of it
    state, dt = (tensor(0.0), tensor(0.0), tensor(0.0), tensor(10.0)), 1e-3
    for _ in range(round(math.pi / 0.5 / dt)):
        state = point_mass(*state, tensor(0.0), tensor(0.5), dt)
    x, y, heading, speed = (value.item() for value in state)
    assert (x, y) == (pytest.approx(0.0, abs=0.02), pytest.approx(40.0, abs=0.02))
    assert (heading, speed) == (pytest.approx(math.pi, abs=1e-3), 10.0)


@pytest.mark.parametrize("model", [bicycle, point_mass])
def test_on_a_curve_a_way_is_longer_on_the_outside(model: Callable[..., tuple[Tensor, ...]]) -> None:
    """Straight ahead for 2 m at y: 2 / (1 - k y) m of the reference line, which turns by k times that."""
    curvature, y = tensor(0.005, 0.005, -0.005), tensor(10.0, -10.0, 10.0)
    zero = torch.zeros_like(y)
    along, across, heading, _ = model(zero, y, zero, zero + 20.0, zero, zero, 0.1, curvature)
    torch.testing.assert_close(along, tensor(2.0 / 0.95, 2.0 / 1.05, 2.0 / 1.05))
    torch.testing.assert_close(across, y)
    torch.testing.assert_close(heading, -curvature * along)
