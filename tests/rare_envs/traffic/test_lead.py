"""The lead: the nearest vehicle ahead that reaches into the lane."""

import math

import torch

from rare_envs.traffic.neighbours import lead_index, lead_of
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State
from tests.rare_envs.traffic_states import F64, traffic


def test_lead_is_the_nearest_ahead_that_reaches_into_the_lane() -> None:
    ego = (0.0, 0.0, 0.0, 20.0)
    far, near, beside, behind = (
        (60.0, 0.0, 0.0, 15.0),
        (30.0, 2.9, 0.0, 12.0),
        (20.0, 3.1, 0.0, 5.0),
        (-8.0, 0, 0, 30.0),
    )
    lead = lead_of(traffic(ego, far, near, beside, behind), straight(2))
    assert (lead.gap.item(), lead.closing_speed.item()) == (25.0, 8.0)
    nobody = lead_of(traffic(ego, beside, behind), straight(2))
    assert (nobody.gap.item(), nobody.closing_speed.item()) == (math.inf, 0.0)


def test_ego_in_the_other_lane_minds_that_lane() -> None:
    ego, here, there = (0.0, 3.5, 0.0, 20.0), (40.0, 4.0, 0.0, 15.0), (20.0, 0.0, 0.0, 10.0)
    assert lead_of(traffic(ego, here, there), straight(2)).gap.item() == 35.0


def test_the_index_of_the_lead_is_that_of_the_vehicle_whose_gap_is_given() -> None:
    generator, batch = torch.Generator().manual_seed(0), 500
    x = torch.round(40.0 * torch.rand(batch, 5, generator=generator, dtype=F64))  # whole metres: many are level
    y = 12.0 * torch.rand(batch, 5, generator=generator, dtype=F64) - 2.0
    heading, speed = torch.zeros_like(x), 20.0 * torch.rand(batch, 5, generator=generator, dtype=F64)
    state, road = State(x, y, heading, speed, x[:, :0]), straight(3)
    index, lead = lead_index(state, road), lead_of(state, road)
    nobody = index == 0
    assert torch.equal(nobody, torch.isinf(lead.gap))
    assert 50 < nobody.sum() < 450
    rows = torch.arange(batch)
    torch.testing.assert_close(lead.gap[~nobody], (x[rows, index] - x[:, 0] - VEHICLE_LENGTH)[~nobody])
    torch.testing.assert_close(lead.closing_speed[~nobody], (speed[:, 0] - speed[rows, index])[~nobody])


def test_an_ego_alone_has_a_gap_for_each_scenario() -> None:
    x = torch.zeros(3, 1)
    lead = lead_of(State(x, x, x, x + 20.0, x[:, :0]), straight(1))
    assert lead.gap.tolist() == [math.inf] * 3
    assert lead.closing_speed.tolist() == [0.0] * 3
