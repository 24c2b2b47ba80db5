"""Lane keeping: towards the lane, within what the wheels can do."""

import math

import pytest
import torch

from rare_envs.control.idm import lane_keeping, steering_control
from rare_envs.traffic.road import straight
from rare_envs.traffic.vehicle_models import bicycle
from tests.rare_envs.traffic_states import F64, tensor


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_lane_keeping_never_steers_the_wrong_way(dtype: torch.dtype) -> None:
    """At low speed the wanted yaw rate is beyond what the wheels can do: as far as they turn, and to the lane."""
    y = torch.tensor([1.5, -1.5, 1.5, -1.5], dtype=dtype)
    speed = torch.tensor([0.5, 0.5, 0.0, 0.0], dtype=dtype)
    steering = lane_keeping(y, torch.zeros_like(y), speed, straight(1))
    limit = math.pi / 3
    assert steering.tolist() == pytest.approx([-limit, limit, -limit, limit], abs=1e-5)
    grid = torch.linspace(-1.9, 1.9, 39, dtype=dtype)
    y, heading, speed = torch.meshgrid(grid, 0.4 * grid, 10 * grid.abs(), indexing="ij")
    steering = lane_keeping(y, heading, speed, straight(1))
    exact = lane_keeping(y.double(), heading.double(), speed.double(), straight(1))
    torch.testing.assert_close(steering.double(), exact, rtol=0, atol=1e-4)


def test_lane_keeping_returns_to_the_lane() -> None:
    state = (tensor(0.0), tensor(1.0), tensor(0.05), tensor(20.0))
    for _ in range(100):
        state = bicycle(*state, tensor(0.0), lane_keeping(*state[1:], straight(1)), 0.1)
    assert state[1].item() == pytest.approx(0.0, abs=1e-4)
    assert state[2].item() == pytest.approx(0.0, abs=1e-4)


def test_steering_by_hand() -> None:
    """3 m to the right at 20 m/s: heading command -asin(3 / 12), yaw rate 5 times that, slip asin(2.5 rate / v)."""
    yaw_rate = -5.0 * math.asin(3.0 / (0.6 * 20.0))
    steering = math.atan(2.0 * math.tan(math.asin(2.5 * yaw_rate / 20.0)))
    assert steering_control(tensor(3.0), tensor(0.0), tensor(20.0)).item() == pytest.approx(steering, rel=1e-12)
    # the heading that the offset asks for needs no steering
    held = steering_control(tensor(3.0), tensor(-math.asin(0.25)), tensor(20.0))
    assert held.item() == pytest.approx(0.0, abs=1e-15)


def test_steering_on_the_line_is_the_same_beside_a_car_that_is_off_it_and_alone() -> None:
    y, speed = torch.tensor([0.0, 4.0, 1.0]), torch.tensor([20.0, 0.0, 20.0])
    with torch.no_grad():
        together = lane_keeping(y, 0 * y, speed, straight(2))
        alone = lane_keeping(y[:2], 0 * y[:2], speed[:2], straight(2))
    assert together.tolist()[:2] == alone.tolist() == [0.0, 0.0]
    assert together[2] < 0.0
