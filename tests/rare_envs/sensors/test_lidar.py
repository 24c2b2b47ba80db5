"""Lidar and perception."""

import math

import pytest
import torch
from torch import Tensor

from rare_envs.sensors.lidar import BEAMS, FEATURES, MAX_RANGE, Bodies, OnRoad, perceive, perceive_traffic, sense
from rare_envs.traffic.road import Road, straight
from rare_envs.traffic.state import State
from tests.rare_envs.traffic_states import ARC, RADIUS, traffic


def bodies(*rows, dtype=torch.float64):
    """One scene from rows of x, y, heading, speed, length, width."""
    return Bodies(*torch.tensor([rows], dtype=dtype).unbind(dim=2))


def drawn(scenes, vehicles, seed, dtype=torch.float64):
    """Vehicles on six lanes, none so near another that its middle is inside."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high):
        return low + (high - low) * torch.rand(scenes, vehicles, generator=generator, dtype=torch.float64)

    x = torch.sort(uniform(0.0, 60.0), dim=1)[0] + 6.0 * torch.arange(vehicles)
    y = torch.floor(uniform(0.0, 6.0)) * 3.7
    fields = x, y, uniform(-0.3, 0.3), uniform(5.0, 25.0), uniform(3.5, 5.0), uniform(1.6, 2.4)
    return Bodies(*(field.to(dtype) for field in fields))


def slowly(scene, i, k):
    """Range and rate of beam k of vehicle i of the first scene, by the sides of every box."""
    x, y, heading, speed, length, width = (field[0].tolist() for field in scene)
    angle = heading[i] + math.radians(-162 + 18 * k)
    way = math.cos(angle), math.sin(angle)
    best, who = MAX_RANGE, None
    for j in range(len(x)):
        if j == i:
            continue
        cos, sin = math.cos(heading[j]), math.sin(heading[j])
        half = [(length[j] / 2 * a, width[j] / 2 * b) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        corners = [(x[j] + a * cos - b * sin, y[j] + a * sin + b * cos) for a, b in half]
        for (x1, y1), (x2, y2) in zip(corners, corners[1:] + corners[:1], strict=True):
            side = x2 - x1, y2 - y1
            denominator = way[0] * side[1] - way[1] * side[0]
            if abs(denominator) < 1e-12:
                continue
            along = ((x1 - x[i]) * side[1] - (y1 - y[i]) * side[0]) / denominator
            share = ((x1 - x[i]) * way[1] - (y1 - y[i]) * way[0]) / denominator
            if along >= 0 and 0 <= share <= 1 and along < best:
                best, who = along, j
    if who is None:
        return best, 0.0
    own = speed[i] * math.cos(heading[i]), speed[i] * math.sin(heading[i])
    other = speed[who] * math.cos(heading[who]), speed[who] * math.sin(heading[who])
    return best, (other[0] - own[0]) * way[0] + (other[1] - own[1]) * way[1]


@pytest.mark.parametrize("seed", range(2))
def test_equal_to_a_slow_implementation(seed):
    scene = drawn(1, 9, seed)
    ranges, rates = sense(scene)
    for i in range(9):
        for k in range(BEAMS):
            distance, rate = slowly(scene, i, k)
            assert ranges[0, i, k] == pytest.approx(distance, abs=1e-9)
            assert rates[0, i, k] == pytest.approx(rate, abs=1e-9)


def test_without_gradients_single_precision_reads_the_same():
    scene = drawn(50, 6, seed=1, dtype=torch.float32)
    with torch.inference_mode():
        fast = sense(scene, 3)
    torch.testing.assert_close(fast, sense(scene, 3))
    exact = sense(Bodies(*(field.double() for field in scene)))
    # a beam that passes a corner may or may not meet it in single precision
    assert ((fast[0] - exact[0][:, :3]).abs() < 1e-3).double().mean() > 0.999


def test_the_gradient_is_that_of_finite_differences():
    scene = drawn(1, 4, seed=3)
    inputs = [field.clone().requires_grad_(True) for field in scene]

    assert torch.autograd.gradcheck(lambda *fields: sense(Bodies(*fields)), inputs, eps=1e-7, atol=1e-5)


EGO = (0.0, 0.0, 0.0, 20.0)


def perceived(state: State, road: Road, vehicle: int = 0) -> dict[str, float]:
    """Features of one vehicle by their names."""
    return dict(zip(FEATURES, perceive_traffic(state, road)[0, vehicle].tolist(), strict=True))


def test_a_vehicles_own_state_and_place_in_its_lane() -> None:
    """Lanes from -2 to 2 and from 2 to 6 m: 4.5 m is half a metre to the right of the middle of the second."""
    own = perceived(traffic(EGO, (70.0, 4.5, -0.1, 25.0)), straight(2), vehicle=1)
    expected = {"lane_offset": 0.5, "heading": -0.1, "speed": 25.0, "length": 5.0, "width": 2.0, "curvature": 0.0}
    expected |= {"left_marker": 2.5, "right_marker": 1.5}
    assert {name: own[name] for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("other", "angle", "distance", "rate"),
    [
        ((30.0, 0.0, 0.0, 15.0), 0, 27.5, -5.0),
        ((-30.0, 0.0, 0.0, 15.0), 180, 27.5, 5.0),  # falls back
        ((0.0, 4.0, 0.0, 15.0), 90, 3.0, 0.0),  # positive is to the right
        ((0.0, -4.0, -0.0, 15.0), -90, 3.0, 0.0),
        ((0.0, -8.0, math.pi / 2, 5.0), -90, 5.5, -5.0),  # comes from the left
    ],
)
def test_beams_are_named_by_their_angle(other, angle: int, distance: float, rate: float) -> None:
    seen = perceived(traffic(EGO, other), straight(3))
    assert (seen[f"range_{angle}"], seen[f"rate_{angle}"]) == pytest.approx((distance, rate))
    opposite = angle + 180 if angle <= 0 else angle - 180
    assert (seen[f"range_{opposite}"], seen[f"rate_{opposite}"]) == (MAX_RANGE, 0.0)


def test_on_a_bend_the_lane_is_along_the_road_and_bodies_are_in_the_world() -> None:
    """On a circle of 250 m the rear of a lead 15 m ahead is nearer than 12.5 m along the beam, and turned by 0.06."""
    angle = 15.0 / RADIUS
    seen = perceived(traffic((60.0, 0.0, 0.0, 20.0), (75.0, 0.0, 0.0, 15.0)), ARC)
    straight_on = perceived(traffic((60.0, 0.0, 0.0, 20.0), (75.0, 0.0, 0.0, 15.0)), straight(2))
    for name in ("lane_offset", "heading", "left_marker", "right_marker"):
        assert seen[name] == pytest.approx(straight_on[name], abs=1e-9)
    assert seen["curvature"] == pytest.approx(1 / RADIUS)
    assert seen["range_0"] == pytest.approx((RADIUS * math.sin(angle) - 2.5) / math.cos(angle), abs=5e-4)
    assert seen["rate_0"] == pytest.approx(15.0 * math.cos(angle) - 20.0, abs=1e-6)


def columns(*values: float) -> Tensor:
    return torch.tensor([values])


def test_bodies_have_sizes_of_their_own_and_some_may_be_seen_without_looking() -> None:
    """A car behind a lorry of 16 m: one looks, the other is only seen."""
    pairs = ((0.0, 40.0), (0.0, 0.0), (0.0, 0.0), (20.0, 15.0), (4.0, 16.0), (1.8, 2.5))
    bodies = Bodies(*(columns(*pair) for pair in pairs))
    on_road = OnRoad(columns(0.1, 0.2), columns(0.01, 0.02), columns(1e-3, 2e-3), columns(1.9, 2.1), columns(1.7, 1.3))
    both, first = perceive(bodies, on_road), perceive(bodies, on_road, observers=1)
    assert both.shape == (1, 2, 51)
    assert torch.equal(first, both[:, :1])
    core = torch.tensor([[0.1, 0.01, 20.0, 4.0, 1.8, 1e-3, 1.9, 1.7], [0.2, 0.02, 15.0, 16.0, 2.5, 2e-3, 2.1, 1.3]])
    torch.testing.assert_close(both[0, :, :8], core)
    assert both[0, 0, FEATURES.index("range_0")].item() == pytest.approx(32.0)
    assert both[0, 1, FEATURES.index("range_180")].item() == pytest.approx(38.0)
