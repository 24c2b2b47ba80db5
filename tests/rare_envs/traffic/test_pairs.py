"""Pairs of vehicles by hand: who meets whom, how fast, and on a bend along chords."""

import math

import pytest
import torch

from rare_envs.traffic.bodies import encounter, least, pairs, velocities
from rare_envs.traffic.road import straight
from tests.rare_envs.traffic_states import ARC, F64, RADIUS, tensor, traffic


def test_every_pair_once_and_the_egos_first() -> None:
    assert pairs(4) == ((0, 0, 0, 1, 1, 2), (1, 2, 3, 2, 3, 3))
    assert pairs(1) == ((), ())


def test_velocity_is_speed_along_the_heading() -> None:
    """5 m/s at the angle of a triangle with sides 3, 4 and 5, to the right and to the left; backwards at pi."""
    angle = math.atan2(3.0, 4.0)
    state = traffic((0.0, 0.0, angle, 5.0), (0.0, 0.0, -angle, 5.0), (0.0, 0.0, math.pi, 2.0))
    along, across = velocities(state, state.heading)
    torch.testing.assert_close(along, tensor(4.0, 4.0, -2.0)[None])
    torch.testing.assert_close(across, tensor(3.0, -3.0, 0.0)[None])
    along, across = velocities(state, state.heading - angle)  # of axes turned with the first
    torch.testing.assert_close((along[0, 0], across[0, 0]), (tensor(5.0)[0], tensor(0.0)[0]))


def test_the_least_over_pairs_is_that_of_nobody_at_most() -> None:
    values = torch.tensor([[3.0, 1.0], [-2.0, 7.0], [20.0, 30.0]], requires_grad=True)
    found = least(values, 10.0)
    assert found.tolist() == [1.0, -2.0, 10.0]
    found.sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]]
    assert least(torch.zeros(2, 0), 10.0).tolist() == [10.0, 10.0]  # an ego that is alone


def test_a_vehicle_that_crosses_in_front_of_the_ego() -> None:
    """20 m ahead and 3 m to the right, going to the right at 5 m/s: its axes are the ego's, turned by 90 degrees."""
    far_behind = (-50.0, 0.0, 0.0, 20.0)
    met = encounter(traffic((0.0, 0.0, 0.0, 20.0), (20.0, 3.0, math.pi / 2, 5.0), far_behind), straight(2))
    torch.testing.assert_close(met.axes.offset[0], torch.stack((tensor(20, 3, 3, -20), tensor(-50, 0, -50, 0))))
    torch.testing.assert_close(met.axes.reach[0], torch.stack((tensor(3.5, 3.5, 3.5, 3.5), tensor(5, 2, 5, 2))))
    torch.testing.assert_close(met.rate[0], torch.stack((tensor(-20, 5, 5, 20), tensor(0, 0, 0, 0))))
    torch.testing.assert_close(met.turn[0], tensor(math.pi / 2, 0.0))


def test_vehicles_on_a_bend_meet_along_the_chord() -> None:
    """Both on a circle of radius R - y, their headings an angle of ds / R apart, however long the way between them."""
    y, ahead, speed, lead_speed = 4.0, 40.0, 20.0, 15.0
    met = encounter(traffic((55.0, y, 0.0, speed), (55.0 + ahead, y, 0.0, lead_speed)), ARC)
    angle, radius = ahead / RADIUS, RADIUS - y
    along, across = radius * math.sin(angle), radius * (1.0 - math.cos(angle))
    other = along, -across  # as seen from the lead, which has turned by the angle
    assert met.axes.offset[0, 0].tolist() == pytest.approx([along, across, *other], abs=5e-4)
    assert math.hypot(along, across) == pytest.approx(2.0 * radius * math.sin(angle / 2))
    rates = [lead_speed * math.cos(angle) - speed, lead_speed * math.sin(angle)]
    rates += [lead_speed - speed * math.cos(angle), speed * math.sin(angle)]
    assert met.rate[0, 0].tolist() == pytest.approx(rates, abs=1e-6)
    assert met.turn.item() == pytest.approx(angle, abs=1e-12)


def test_an_ego_alone_meets_nobody() -> None:
    met = encounter(traffic((0.0, 0.0, 0.0, 20.0)), straight(1))
    assert met.turn.shape == (1, 0)
    assert met.rate.shape == met.axes.offset.shape == (1, 0, 4)
    assert met.rate.dtype == F64
