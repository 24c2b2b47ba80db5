"""Perception by hand: every feature under its name, on straight and on curved roads."""

import math

import pytest
import torch
from torch import Tensor

from rare_envs.sensors.lidar import FEATURES, MAX_RANGE, Bodies, OnRoad, perceive, perceive_traffic
from rare_envs.traffic.road import Road, straight
from rare_envs.traffic.state import State
from tests.rare_envs.traffic_states import ARC, RADIUS, traffic

EGO = (0.0, 0.0, 0.0, 20.0)


def perceived(state: State, road: Road, vehicle: int = 0) -> dict[str, float]:
    """Features of one vehicle by their names."""
    return dict(zip(FEATURES, perceive_traffic(state, road)[0, vehicle].tolist(), strict=True))


def test_there_are_51_features_and_a_beam_every_18_degrees() -> None:
    angles = range(-162, 181, 18)
    assert len(set(FEATURES)) == len(FEATURES) == 51
    assert FEATURES[11:] == (*(f"range_{a}" for a in angles), *(f"rate_{a}" for a in angles))


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
def test_beams_are_named_by_their_angle(
    other: tuple[float, float, float, float], angle: int, distance: float, rate: float
) -> None:
    seen = perceived(traffic(EGO, other), straight(3))
    assert (seen[f"range_{angle}"], seen[f"rate_{angle}"]) == pytest.approx((distance, rate))
    opposite = angle + 180 if angle <= 0 else angle - 180
    assert (seen[f"range_{opposite}"], seen[f"rate_{opposite}"]) == (MAX_RANGE, 0.0)


def test_the_three_flags_are_always_0() -> None:
    """Even for a wreck off the road."""
    wreck = perceived(traffic((0.0, 30.0, 2.0, 0.0), (1.0, 30.0, 0.0, 10.0)), straight(2))
    assert wreck["left_marker"] == 28.0 and wreck["right_marker"] == -24.0
    assert [wreck[name] for name in ("colliding", "off_road", "reversing")] == [0.0, 0.0, 0.0]


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
    bodies = Bodies(
        columns(0.0, 40.0),
        columns(0.0, 0.0),
        columns(0.0, 0.0),
        columns(20.0, 15.0),
        columns(4.0, 16.0),
        columns(1.8, 2.5),
    )
    on_road = OnRoad(columns(0.1, 0.2), columns(0.01, 0.02), columns(1e-3, 2e-3), columns(1.9, 2.1), columns(1.7, 1.3))
    both, first = perceive(bodies, on_road), perceive(bodies, on_road, observers=1)
    assert both.shape == (1, 2, 51)
    assert torch.equal(first, both[:, :1])
    core = torch.tensor([[0.1, 0.01, 20.0, 4.0, 1.8, 1e-3, 1.9, 1.7], [0.2, 0.02, 15.0, 16.0, 2.5, 2e-3, 2.1, 1.3]])
    torch.testing.assert_close(both[0, :, :8], core)
    assert both[0, 0, FEATURES.index("range_0")].item() == pytest.approx(32.0)
    assert both[0, 1, FEATURES.index("range_180")].item() == pytest.approx(38.0)


def test_where_vehicles_are_may_be_known_already() -> None:
    state = traffic((60.0, 0.0, 0.02, 20.0), (75.0, 4.0, 0.0, 15.0))
    pose = ARC.place(state.x, state.y, state.heading)
    assert torch.equal(perceive_traffic(state, ARC, pose), perceive_traffic(state, ARC))
    parked = pose._replace(x=pose.x + columns(0.0, 1e4))
    assert (perceive_traffic(state, ARC, parked)[..., 11:31] == MAX_RANGE).all()  # the pose is what is seen
