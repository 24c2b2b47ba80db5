"""Neighbours: the nearest vehicles ahead and behind in the own lane and in the lanes beside it, for many at once."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import constant
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

LEFT, OWN, RIGHT = range(3)
"""Lanes in the last axis of `Neighbours`."""


class LaneTraffic(NamedTuple):
    """V vehicles in B scenes, each scene with its lanes.

    Example:
        >>> from rare_envs.traffic import straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, y=0 * x + 4.2, heading=0 * x, speed=0 * x + 20.0, theta=x[:, :0])
        >>> traffic = LaneTraffic.of(state, straight(3))
        >>> traffic.lane.tolist(), traffic.centre(traffic.lane).tolist()
        ([[1, 1]], [[4.0, 4.0]])
    """

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
    """Return the neighbours of some vehicles, by the places of centres: ahead where x is not less.

    Args:
        traffic: B scenes of V vehicles.
        who: The M vehicles whose neighbours are wanted, of the V.
        target: Lane that each vehicle moves to, its own if it keeps it, int64, shape (B, V). A vehicle counts as one in
            its target lane, as one does that has signalled.
        reach: A vehicle also counts as one in a lane while its centre is at most this far beyond the lane's edge [m].

    Example:
        >>> from rare_envs.traffic import straight
        >>> x, y = torch.tensor([[0.0, 30.0, -20.0]]), torch.tensor([[0.0, 0.0, 4.0]])
        >>> traffic = LaneTraffic.of(State(x, y, 0 * x, 0 * x + 20.0, theta=x[:, :0]), straight(2))
        >>> found = find_neighbours(traffic, slice(0, 1), traffic.lane)
        >>> found.lead.tolist(), found.follower.tolist(), found.exists.tolist()
        ([[[-1, 1, -1]]], [[[-1, -1, 2]]], [[[False, True, True]]])
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
