"""The lead: the vehicle ahead that a follower has to keep a distance from."""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import scalars
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
