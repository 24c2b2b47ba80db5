"""Overlap of vehicles: of the ego, of the others, of all pairs, on straight and curved roads."""

import numpy as np
import torch

from rare_envs.traffic.bodies import ego_overlaps, others_overlap, pairwise_overlaps
from rare_envs.traffic.road import ReferenceLine, Road, i80, straight
from rare_envs.traffic.state import State
from tests.rare_envs.traffic.slow_boxes import corners, overlap
from tests.rare_envs.traffic_states import F64, traffic


def test_contacts_of_all_pairs_are_those_of_each_vehicle_as_ego() -> None:
    rng = np.random.default_rng(0)
    fields = [rng.uniform(low, high, (500, 6)) for low, high in ((0, 25), (0, 12), (-0.5, 0.5), (0, 20))]
    state = State(*map(torch.from_numpy, fields), theta=torch.zeros(500, 0))
    road = i80()
    both = pairwise_overlaps(state, road)
    assert torch.equal(both, both.mT)
    assert not both.diagonal(dim1=1, dim2=2).any()
    assert 0.05 < both.double().mean() < 0.5
    assert torch.equal(both[:, 0, 1:], ego_overlaps(state, road))
    for vehicle in range(1, 6):
        others = [j for j in range(6) if j != vehicle]
        expected = ego_overlaps(state.seen_by(vehicle), road)
        assert torch.equal(both[:, vehicle][:, others], expected)


def test_others_overlap_where_their_bodies_overlap() -> None:
    rng, batch = np.random.default_rng(4), 300
    x, y = rng.uniform(-8.0, 8.0, (batch, 4)), rng.uniform(10.0, 18.0, (batch, 4))
    heading = rng.uniform(-0.6, 0.6, (batch, 4))
    state = State(*(torch.from_numpy(each) for each in (x, y, heading, np.ones((batch, 4)), x[:, :0])))
    bodies = [[corners(*pose) for pose in zip(*row, strict=True)] for row in zip(x, y, heading, strict=True)]
    expected = [any(overlap(row[i], row[j]) for i, j in ((1, 2), (1, 3), (2, 3))) for row in bodies]
    assert others_overlap(state, straight(9)).tolist() == expected
    assert 60 < sum(expected) < 240


def test_bodies_overlap_in_the_world_not_along_the_road() -> None:
    """Where 5 m of the road's line are 5 (1 - k y) m at y."""
    road = Road((-30.0, 0.0, 30.0), ReferenceLine(50.0, (0.0, 0.004, 0.004, 0.0)))
    for y, other_x, touch in [(20.0, 5.3, True), (20.0, 5.5, False), (-20.0, 4.7, False), (-20.0, 4.55, True)]:
        assert ego_overlaps(traffic((75.0, y, 0.0, 0.0), (75.0 + other_x, y, 0.0, 0.0)), road).item() is touch
    state = traffic((75.0, 20.0, 0.0, 0.0), (75.0, 21.9, 0.0, 0.0))
    assert ego_overlaps(state, road).item() is True
    assert ego_overlaps(state._replace(y=torch.tensor([[20.0, 22.1]], dtype=F64)), road).item() is False


def test_where_vehicles_are_may_be_known_already() -> None:
    state, road = traffic((0.0, 0.0, 0.1, 20.0), (4.0, 1.0, 0.0, 20.0), (7.0, 1.0, 0.0, 20.0)), i80()
    pose = road.place(state.x, state.y, state.heading)
    for function in (ego_overlaps, others_overlap, pairwise_overlaps):
        assert torch.equal(function(state, road, pose), function(state, road))
    assert ego_overlaps(state, road).tolist() == [[True, False]]
    assert others_overlap(state, road).tolist() == [True]


def test_an_ego_alone_overlaps_nobody() -> None:
    alone = traffic((0.0, 0.0, 0.0, 20.0))
    assert ego_overlaps(alone, straight(1)).shape == (1, 0)
    assert others_overlap(alone, straight(1)).tolist() == [False]
    assert pairwise_overlaps(alone, straight(1)).tolist() == [[[False]]]
