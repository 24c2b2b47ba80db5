"""Neighbours by hand: who is ahead and behind in which lane."""

import torch

from rare_envs.traffic import straight
from rare_envs.traffic.neighbours import LaneTraffic, find_neighbours, nearest
from tests.rare_envs.traffic_states import traffic

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
    assert find_neighbours(padded, slice(0, 1), padded.lane).exists[0, 0].tolist() == [True, True, False]
    assert padded.lane.tolist() == [[1]]


def test_who_moves_to_a_lane_counts_in_both():
    lead, _, _ = around((20.0, 0.0, 0.0, 20.0), target=[1, 1])
    assert lead == [1, 1, -1]


def test_a_centre_near_the_edge_counts_within_the_reach():
    assert around((20.0, 1.5, 0.0, 20.0))[0] == [1, -1, -1]
    assert around((20.0, 1.5, 0.0, 20.0), reach=1.0)[0] == [1, 1, -1]
    assert around((20.0, 0.5, 0.0, 20.0), reach=1.0)[0] == [1, -1, -1]


def test_nearest_of_none_is_none():
    assert nearest(torch.tensor([3.0, 1.0]), torch.tensor([False, False])).item() == -1
