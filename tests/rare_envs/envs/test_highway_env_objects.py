"""HighwayEnv's road and vehicles made from our states."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rare_envs.envs.rendering import (
    find_crashed,
    make_network,
    make_scene,
    make_traffic,
    world_places,
    world_point,
)
from rare_envs.make import set_up
from rare_envs.traffic.road import i80, straight
from rare_envs.traffic.state import State


def test_vehicles_are_where_the_state_has_them() -> None:
    x = torch.tensor([[0.0, 30.0], [5.0, 50.0]])
    state = State(x, y=torch.tensor([[0.0, 4.0], [8.0, 0.0]]), heading=0.1 * x, speed=x + 1.0, theta=x[:, :0])
    traffic = make_traffic(state, straight(3), row=1)
    ego, other = traffic.vehicles
    np.testing.assert_allclose([ego.position, other.position], [[5.0, 8.0], [50.0, 0.0]])
    assert (ego.lane_index[2], other.lane_index[2]) == (2, 0)
    assert (ego.speed, other.heading) == (6.0, pytest.approx(5.0))
    assert traffic.neighbour_vehicles(ego, ("0", "1", 0))[0] is other  # HighwayEnv's own methods work on it


def test_a_curved_road_has_a_lane_for_each_lane_along_its_pieces() -> None:
    road = i80()
    network = make_network(road, 300.0)
    pieces = {index[:2] for index in network.lanes_dict()}
    assert len(pieces) == 7 and len(network.lanes_list()) == 7 * road.lanes
    for lane in range(road.lanes):
        point = world_point(road, 310.0, road.centre(lane))
        assert network.get_closest_lane_index(point)[2] == lane
    zero = torch.zeros(1, 1)
    state = State(zero + 310.0, zero + road.centre(2), zero, zero, zero[:, :0])
    np.testing.assert_allclose(world_places(state, road)[0][:2], world_point(road, 310.0, road.centre(2)), atol=1e-3)


def test_who_touches_the_ego_has_crashed_and_targets_are_those_of_its_controller() -> None:
    world, _ = set_up("rare_envs/CarFollowing-v0", action="meta")
    apart, touching = torch.tensor([[21.0, 15.0, 30.0]]), torch.tensor([[38.0, 2.0, 1.0]])
    scene = make_scene(world.start(apart))
    assert [vehicle.crashed for vehicle in scene.vehicles] == [False, False]
    assert (scene.vehicles[0].target_speed, scene.vehicles[0].target_lane_index) == (20.0, ("0", "1", 0))
    episode = world.start(touching)
    for _ in range(3):
        episode = world.step(episode, torch.zeros(1, 2))
    assert bool(episode.collided)
    assert [vehicle.crashed for vehicle in make_scene(episode).vehicles] == [True, True]
    assert [vehicle.crashed for vehicle in make_scene(episode, crashed=[1]).vehicles] == [False, True]


def test_the_crashed_are_the_ego_and_those_that_it_touches() -> None:
    x = torch.tensor([[0.0, 4.0, 40.0, 43.0, 3.0]])
    y = torch.tensor([[0.0, 0.0, 0.0, 0.0, 4.0]])
    state = State(x, y, heading=0.0 * x, speed=0.0 * x, theta=x[:, :0])
    assert find_crashed(state, straight(2)) == {0, 1}  # 2 and 3 touch each other; 4 is beside the ego in its own lane
    assert find_crashed(state._replace(x=x + torch.tensor([[20.0, 0.0, 0.0, 0.0, 0.0]])), straight(2)) == {0}
