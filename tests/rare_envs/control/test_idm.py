"""IDM, lane keeping and steering."""

import math

import pytest
import torch

from rare_envs.control.idm import IDM, improved_acceleration, lane_keeping
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.road import straight
from tests.rare_envs.traffic_states import F64, tensor


def test_idm_by_hand() -> None:
    # v = 20, dv = 5, gap = 40: s* = 1 + 2 sqrt(20/21.72) + 24 + 100 / (2 sqrt(5.328))
    wanted = 1 + 2 * math.sqrt(20 / 21.72) + 24 + 100 / (2 * math.sqrt(2.22 * 2.4))
    expected = 2.22 * (1 - (20 / 21.72) ** 4 - (wanted / 40) ** 2)
    assert -5.0 < expected < 0.0
    acceleration = IDM().acceleration(tensor(20.0), Lead(tensor(40.0), tensor(5.0)))
    assert acceleration.item() == pytest.approx(expected, rel=1e-14)


def test_idm_limits() -> None:
    idm = IDM()
    emergency = idm.acceleration(tensor(20.0), Lead(tensor(2.0), tensor(10.0)))
    start = idm.acceleration(tensor(0.0), Lead(tensor(math.inf), tensor(0.0)))
    side_by_side = idm.acceleration(tensor(20.0), Lead(tensor(-3.0), tensor(0.0)))
    assert (emergency.item(), side_by_side.item()) == (-5.0, -5.0)
    assert start.item() == pytest.approx(2.22)


def test_idm_has_a_finite_slope_wherever_a_follower_may_be() -> None:
    """At standstill, at the desired speed, touching and without a lead."""
    speed, gap = tensor(0.0, 21.72, 5.0, 5.0), tensor(10.0, 10.0, 0.0, math.inf)
    inputs = [speed.requires_grad_(), gap.clamp(max=1e6).requires_grad_(), torch.zeros(4, dtype=F64).requires_grad_()]
    acceleration = IDM().acceleration(inputs[0], Lead(*inputs[1:]))
    gradients = torch.autograd.grad(acceleration.sum(), inputs)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_each_follower_may_have_a_desired_speed_of_its_own() -> None:
    lead = Lead(tensor(math.inf, math.inf), tensor(0.0, 0.0))
    acceleration = IDM().acceleration(tensor(10.0, 10.0), lead, tensor(10.0, 20.0))
    assert acceleration.tolist() == pytest.approx([0.0, 2.22 * (1 - 0.5**4)])


@pytest.mark.parametrize(
    ("name", "value"), [("max_acceleration", 0.0), ("jam_distance", -0.1), ("time_headway", math.inf)]
)
def test_parameters_without_meaning_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^Expected {name} of the IDM to be a number .*, got {value!r}\\.$"):
        IDM(**{name: value})  # type: ignore[arg-type]


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


def test_steering_by_hand() -> None:
    """3 m to the right at 20 m/s: heading command -asin(3 / 12), yaw rate 5 times that, slip asin(2.5 rate / v)."""
    yaw_rate = -5.0 * math.asin(3.0 / (0.6 * 20.0))
    steering = math.atan(2.0 * math.tan(math.asin(2.5 * yaw_rate / 20.0)))
    assert lane_keeping(tensor(3.0), tensor(0.0), tensor(20.0), straight(1)).item() == pytest.approx(
        steering, rel=1e-12
    )
    # the heading that the offset asks for needs no steering
    held = lane_keeping(tensor(3.0), tensor(-math.asin(0.25)), tensor(20.0), straight(1))
    assert held.item() == pytest.approx(0.0, abs=1e-15)


def test_steering_on_the_line_is_the_same_beside_a_car_that_is_off_it_and_alone() -> None:
    y, speed = torch.tensor([0.0, 4.0, 1.0]), torch.tensor([20.0, 0.0, 20.0])
    with torch.no_grad():
        together = lane_keeping(y, 0 * y, speed, straight(2))
        alone = lane_keeping(y[:2], 0 * y[:2], speed[:2], straight(2))
    assert together.tolist()[:2] == alone.tolist() == [0.0, 0.0]
    assert together[2] < 0.0


def test_the_heuristic_by_hand() -> None:
    """v = 20 m/s, 10 m behind a lead of 18 m/s: s* = 2 + 20 + 20 x 2 / (2 sqrt(1.5)) = 38.3 m, so the improved IDM has
    1 - 3.83^2 = -13.7; the heuristic -2^2 / 20 = -0.2; together .01 x -13.7 + .99 (-0.2 + 1.5 tanh(-9)) = -1.82."""
    idm = IDM(1000.0, 1.0, 1.0, 1.5, jam_distance=2.0, jam_distance_speed=0.0, cut_off=True)
    lead = Lead(torch.tensor([10.0], dtype=torch.float64), torch.tensor([2.0], dtype=torch.float64))
    speed = torch.tensor([20.0], dtype=torch.float64)
    z = (2 + 20 + 20 * 2 / (2 * math.sqrt(1.5))) / 10
    whole = 0.01 * (1 - z**2) + 0.99 * (-0.2 + 1.5 * math.tanh((1 - z**2 + 0.2) / 1.5))
    assert improved_acceleration(idm, speed, lead).item() == pytest.approx(whole)
    # a lead that brakes by 3 m/s^2 to a standstill: v^2 a / (v_lead^2 - 2 s a) = -1200 / 384
    heuristic = -3 * 400 / (18**2 + 2 * 10 * 3)
    braking = improved_acceleration(idm, speed, lead, lead_acceleration=-3.0, coolness=1.0)
    assert braking.item() == pytest.approx(heuristic + 1.5 * math.tanh((1 - z**2 - heuristic) / 1.5))
    # nobody ahead, at the desired speed and above it: 0, and towards it by no more than b
    alone = Lead(torch.tensor([math.inf], dtype=torch.float64), torch.tensor([0.0], dtype=torch.float64))
    desired = [torch.tensor([20.0], dtype=torch.float64), torch.tensor([10.0], dtype=torch.float64)]
    free = [improved_acceleration(idm, speed, alone, desired_speed=each).item() for each in desired]
    assert free == pytest.approx([0.0, -1.5 * (1 - 0.5 ** (4 / 1.5))])
