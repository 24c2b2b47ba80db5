"""HighwayEnv's road and vehicles for a state of ours: for its graphics, and for code that reads them."""

from collections.abc import Collection
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.meta_actions import TARGET_SPEEDS
from rare_envs.simulation.episode import Episode
from rare_envs.traffic.overlap import pairwise_overlaps
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

_SEGMENT = 6 * 4.33
"""A curve is drawn as straight pieces this long [m]: six stripes of HighwayEnv's."""
_AHEAD, _BEHIND = 4, 2
"""Pieces drawn ahead of the ego's and behind it."""


def make_traffic(state: State, road: Road, row: int = 0) -> Any:
    """Return HighwayEnv's road around the ego, with the vehicles where they are.

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        row: Which one.

    Returns:
        A `highway_env.road.road.Road`; its `vehicles` are `highway_env.vehicle.kinematics.Vehicle`, the ego first.

    Example:
        >>> from rare_envs.traffic import straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> traffic = make_traffic(State(x, 0 * x, 0 * x, torch.tensor([[20.0, 15.0]]), theta=x[:, :0]), straight(2))
        >>> [vehicle.speed for vehicle in traffic.vehicles], traffic.vehicles[0].lane_index
        ([20.0, 15.0], ('0', '1', 0))
    """
    from highway_env.road.road import Road as Traffic
    from highway_env.vehicle.kinematics import Vehicle

    traffic = Traffic(make_network(road, float(state.x[row, 0])))
    for (x, y, heading), speed in zip(world_places(state, road, row), state.speed[row].tolist(), strict=True):
        traffic.vehicles.append(Vehicle(traffic, [x, y], heading, speed))
    return traffic


def make_scene(episode: Episode, crashed: Collection[int] | None = None) -> Any:
    """Return HighwayEnv's road of an episode as code of its users reads it: who has crashed, and the ego's targets.

    Args:
        episode: A batch of one.
        crashed: Indices of the vehicles that have crashed; None for the ego, if it has, and whom it touches.

    Returns:
        As `make_traffic`; with meta-actions the ego is a `highway_env.vehicle.controller.MDPVehicle`.
    """
    from highway_env.vehicle.controller import MDPVehicle

    traffic = make_traffic(episode.state, episode.road)
    if crashed is None:
        crashed = find_crashed(episode.state, episode.road) if bool(episode.collided) else ()
    if episode.aim is not None:
        seen = traffic.vehicles[0]
        target = (*seen.lane_index[:2], int(episode.aim.lane[0, 0]))
        aim = TARGET_SPEEDS[int(episode.aim.speed[0, 0])]
        speeds = np.array(TARGET_SPEEDS)
        traffic.vehicles[0] = MDPVehicle(traffic, seen.position, seen.heading, seen.speed, target, aim, speeds)
    for j, vehicle in enumerate(traffic.vehicles):
        vehicle.crashed = j in crashed
    return traffic


def find_crashed(state: State, road: Road) -> set[int]:
    """Return the ego and the vehicles that it touches, in a batch of one."""
    return {0, *pairwise_overlaps(state, road)[0, 0].nonzero().flatten().tolist()}


def world_places(state: State, road: Road, row: int = 0) -> list[list[float]]:
    """Return X, Y [m] and heading [rad] in the world of each vehicle of a row, shape (N, 3)."""
    places: list[list[float]] = torch.stack(
        road.to_world(state.x[row], state.y[row], state.heading[row]), dim=1
    ).tolist()
    return places


def make_network(road: Road, x: float) -> Any:
    """Return HighwayEnv's road network of the lanes around x [m]; a curve in straight pieces, each a road of its own.

    Example:
        >>> from rare_envs.traffic import straight
        >>> [lane.width for lane in make_network(straight(3), 0.0).lanes_list()]
        [4.0, 4.0, 4.0]
    """
    from highway_env.road.lane import LineType, StraightLane
    from highway_env.road.road import RoadNetwork

    here = x // _SEGMENT
    cuts = [-1e3, 9e3] if road.reference_line is None else [_SEGMENT * (here + k) for k in range(-_BEHIND, _AHEAD + 2)]
    network = RoadNetwork()
    for lane in range(road.lanes):
        y, width = road.centre(lane), road.edges[lane + 1] - road.edges[lane]
        left = LineType.CONTINUOUS_LINE if lane == 0 else LineType.STRIPED
        right = LineType.CONTINUOUS_LINE if lane == road.lanes - 1 else LineType.NONE
        for number, (start, end) in enumerate(pairwise(cuts)):
            piece = StraightLane(world_point(road, start, y), world_point(road, end, y), width, [left, right])
            network.add_lane(str(number), str(number + 1), piece)
    return network


def world_point(road: Road, x: float, y: float) -> NDArray[np.float64]:
    """Return world coordinates [m], shape (2,), of a point of the road."""
    zero = torch.zeros((), dtype=torch.float64)
    world_x, world_y, _ = road.to_world(zero + x, zero + y, zero)
    return np.array([float(world_x), float(world_y)])
