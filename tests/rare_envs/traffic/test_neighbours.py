"""The lead and neighbours of vehicles."""

import math

import torch

from rare_envs.traffic.bodies import LaneTraffic, find_neighbours, lead_index, lead_of
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State
from tests.rare_envs.traffic_states import F64, traffic


def test_lead_is_the_nearest_ahead_that_reaches_into_the_lane() -> None:
    ego = (0.0, 0.0, 0.0, 20.0)
    far, near = (60.0, 0.0, 0.0, 15.0), (30.0, 2.9, 0.0, 12.0)
    beside, behind = (20.0, 3.1, 0.0, 5.0), (-8.0, 0.0, 0.0, 30.0)
    lead = lead_of(traffic(ego, far, near, beside, behind), straight(2))
    assert (lead.gap.item(), lead.closing_speed.item()) == (25.0, 8.0)
    nobody = lead_of(traffic(ego, beside, behind), straight(2))
    assert (nobody.gap.item(), nobody.closing_speed.item()) == (math.inf, 0.0)


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


EGO = (0.0, 4.0, 0.0, 20.0)


def around(*others, lanes=3, target=None, reach=0.0):
    scene = LaneTraffic.of(traffic(EGO, *others), straight(lanes))
    found = find_neighbours(scene, slice(0, 1), scene.lane if target is None else torch.tensor([target]), reach)
    return [part[0, 0].tolist() for part in found]


def test_the_nearest_ahead_and_behind_in_each_lane():
    others = [(50.0, 0.0), (20.0, 0.0), (-9.0, 0.0), (30.0, 4.0), (-40.0, 4.0), (-20.0, 4.0), (5.0, 8.0)]
    lead, follower, exists = around(*((x, y, 0.0, 20.0) for x, y in others))
    assert (lead, follower, exists) == ([2, 4, 7], [3, 6, -1], [True, True, True])


def test_beyond_the_road_there_is_no_lane():
    assert around(lanes=2) == [[-1, -1, -1], [-1, -1, -1], [True, True, False]]
    padded = LaneTraffic.of(traffic(EGO), straight(2))
    padded = padded._replace(edges=torch.cat((padded.edges, padded.edges[:, -1:]), dim=1))  # another scene has 3 lanes
    assert find_neighbours(padded, slice(0, 1), padded.lane)[2][0, 0].tolist() == [True, True, False]
    assert padded.lane.tolist() == [[1]]


def test_who_moves_to_a_lane_counts_in_both():
    lead, _, _ = around((20.0, 0.0, 0.0, 20.0), target=[1, 1])
    assert lead == [1, 1, -1]


def test_a_centre_near_the_edge_counts_within_the_reach():
    assert around((20.0, 1.5, 0.0, 20.0))[0] == [1, -1, -1]
    assert around((20.0, 1.5, 0.0, 20.0), reach=1.0)[0] == [1, 1, -1]
    assert around((20.0, 0.5, 0.0, 20.0), reach=1.0)[0] == [1, -1, -1]
