"""Vehicles ahead and behind: the ego's lead, and the nearest in the own lane and beside it, for many at once."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import constant, scalars
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State


class Lead(NamedTuple):
    """The lead of a follower.

    Example:
        >>> Lead(gap=torch.tensor([25.0]), closing_speed=torch.tensor([5.0])).gap.item()
        25.0
    """

    gap: Tensor
    """Bumper to bumper along the road [m], shape (B,); inf without a lead, negative side by side."""
    closing_speed: Tensor
    """Follower's speed less the lead's, along the follower's heading [m/s], shape (B,); 0 without a lead."""


def lead_of(state: State, road: Road) -> Lead:
    """Return the ego's lead: the nearest vehicle ahead whose body reaches into the ego's lane.

    "Ahead" compares centres. A body reaches into a lane when its centre is within half a lane and half a vehicle of
    the lane's centre, which for a 4 m lane is HighwayEnv's `on_lane` with its margin of 1 m. Gaps are measured along
    the road's reference line.

    Args:
        state: Traffic of B scenarios.
        road: Their road.

    Returns:
        Gap and closing speed, shape (B,) each.

    Example:
        >>> from rare_envs.traffic import straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.tensor([[20.0, 15.0]]), theta=x[:, :0])
        >>> lead = lead_of(state, straight(1))
        >>> lead.gap.item(), lead.closing_speed.item()  # vehicles are 5 m long
        (25.0, 5.0)
    """
    own, *others = state.vehicles
    numbers = (0.0, (road.width + VEHICLE_WIDTH) / 2, torch.inf, VEHICLE_LENGTH)
    zero, reach, nowhere, length = scalars(numbers, own.x)
    lane_y = road.centre_of(own.y)
    nearest, heading, speed = nowhere, own.heading, own.speed
    for other in others:
        ahead = other.x - own.x
        nearer = (ahead >= zero) & ((other.y - lane_y).abs() <= reach)
        if nearest is not nowhere:
            nearer = nearer & (ahead <= nearest)
        nearest = torch.where(nearer, ahead, nearest)
        heading, speed = torch.where(nearer, other.heading, heading), torch.where(nearer, other.speed, speed)
    if nearest is nowhere:
        nearest = torch.full_like(own.x, torch.inf)
    return Lead(nearest - length, own.speed - speed * torch.cos(heading - own.heading))


def lead_index(state: State, road: Road) -> Tensor:
    """Return the index of the ego's lead, see `lead_of`, int64, shape (B,); 0, the ego, if there is none."""
    x, y = state.x[:, :1], state.y[:, :1]
    ahead, reach = state.x - x, (road.width + VEHICLE_WIDTH) / 2
    relevant = (ahead >= 0) & ((state.y - road.centre_of(y)).abs() <= reach)
    way = torch.where(relevant, ahead, torch.inf)[:, 1:]
    least, from_last = way.flip(1).min(1)  # of vehicles level with each other the last one, as in `lead_of`
    return torch.where(least < torch.inf, way.shape[1] - from_last, 0)


LEFT, OWN, RIGHT = range(3)
"""Lanes in the last axis of `Neighbours`."""


class LaneTraffic(NamedTuple):
    """V vehicles in B scenes, each scene with its lanes."""

    x: Tensor
    """Centres along the road [m], shape (B, V), as the next five."""
    y: Tensor
    """Centres across the road, positive to the right [m]."""
    heading: Tensor
    """Relative to the road [rad]."""
    speed: Tensor
    """[m/s]."""
    length: Tensor
    """Of the bodies [m]."""
    width: Tensor
    """[m]."""
    edges: Tensor
    """Lane boundaries from left to right [m], shape (B, L + 1); beyond the last lane the last edge may be repeated."""

    @classmethod
    def of(cls, state: State, road: Road) -> LaneTraffic:
        """Return the traffic of a world, whose vehicles are all of one size."""
        long, wide = constant((VEHICLE_LENGTH, VEHICLE_WIDTH), state.x).unbind()
        edges = _edges(road, state.y.dtype, state.y.device).expand(len(state.x), -1)
        sizes = long.expand_as(state.x), wide.expand_as(state.x)
        return cls(state.x, state.y, state.heading, state.speed, *sizes, edges)

    @property
    def lane(self) -> Tensor:
        """Lane of each vehicle by its centre, 0 the leftmost and the nearest off the road, int64, shape (B, V)."""
        inner = torch.where(self.edges[:, 1:-1] < self.edges[:, -1:], self.edges[:, 1:-1], torch.inf)
        return (self.y[:, :, None] >= inner[:, None, :]).sum(dim=2)

    def centre(self, lane: Tensor) -> Tensor:
        """Return the y of the middle of lanes [m], for indices of shape (B, M)."""
        return 0.5 * (self.edges.gather(1, lane) + self.edges.gather(1, lane + 1))


class Neighbours(NamedTuple):
    """Neighbours of M vehicles in three lanes: the one on the left, the own one, the one on the right."""

    lead: Tensor
    """Index of the nearest vehicle ahead, -1 for none, int64, shape (B, M, 3)."""
    follower: Tensor
    """Index of the nearest vehicle behind, likewise."""
    exists: Tensor
    """Whether there is such a lane, boolean, shape (B, M, 3)."""


def find_neighbours(traffic: LaneTraffic, who: slice, target: Tensor, reach: float = 0.0) -> Neighbours:
    """Return the neighbours of the M vehicles `who` in V, by the places of centres: ahead where x is not less.

    A vehicle counts in its own lane, in the lane `target` (B, V) that it moves to, as one does that has signalled, and
    in those whose edges are within `reach` [m] of its centre.
    """
    lane = traffic.lane
    wanted = lane[:, who, None] + torch.arange(-1, 2, device=lane.device)  # (B, M, 3)
    lanes = traffic.edges.shape[1] - 1
    clamped = wanted.clamp(0, lanes - 1)
    edges = traffic.edges[:, None, :].expand(-1, wanted.shape[1], -1)
    left, right = edges.gather(2, clamped), edges.gather(2, clamped + 1)
    exists = (wanted >= 0) & (wanted < lanes) & (left < right)
    inside = (lane[:, None, None, :] == wanted[..., None]) | (target[:, None, None, :] == wanted[..., None])
    if reach:
        y = traffic.y[:, None, None, :]
        inside = inside | ((y >= left[..., None] - reach) & (y <= right[..., None] + reach))
    others = ~torch.eye(lane.shape[1], dtype=torch.bool, device=lane.device)[who]
    inside = inside & exists[..., None] & others[:, None, :]
    ahead = (traffic.x[:, None, :] - traffic.x[:, who, None])[:, :, None, :].expand_as(inside)
    return Neighbours(nearest(ahead, inside & (ahead >= 0)), nearest(-ahead, inside & (ahead < 0)), exists)


def nearest(distance: Tensor, among: Tensor) -> Tensor:
    """Return the index of the least distance among some vehicles, -1 for none: (..., V) -> (...)."""
    least, index = torch.where(among, distance, torch.inf).min(dim=-1)
    return torch.where(least < torch.inf, index, -1)


@cache  # never forgotten: recorded rollouts read it where it is
def _edges(road: Road, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # a tensor made under it could not be used for gradients later
        return torch.tensor([road.edges], dtype=dtype, device=device)
