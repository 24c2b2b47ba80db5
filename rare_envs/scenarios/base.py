"""What a scenario is: parameters, an initial state, and the motion of the vehicles around the ego."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.dynamics import point_mass
from rare_envs.road import Road
from rare_envs.state import State


class Others(NamedTuple):
    """Vehicles 1 to N - 1 after a tick; shapes (B, N - 1), units as in `State`."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor


@dataclass(frozen=True)
class Scenario:
    """A named scenario; x of shape (B, size) has the parameters of `rare_envs.space.PARAMETERS[name]`, in order."""

    name: str
    road: Road
    vehicles: int
    """N, the ego included."""
    horizon: float
    """Default length of an episode [s]."""
    initial: Callable[[Tensor], State]
    """x (B, d) to the state at time 0."""
    others: Callable[[State, float], Others]
    """The script: state and dt [s] to the other vehicles after the tick."""
    driven: Callable[[State, Tensor, float], Others]
    """State, the other vehicles' accelerations and yaw rates (B, N - 1, 2) and dt [s] to the same, for vehicles that
    have drivers."""
    size: int
    """Number of columns of x that `initial` takes."""
    drivers: str | None = None
    """Drivers of the other vehicles unless told otherwise; None for the script."""


def columns(*values: Tensor) -> Tensor:
    """Columns (B,) side by side as (B, N), each contiguous in memory: ticks work on one vehicle's column at a time."""
    return torch.stack(values).T


def roaming(state: State, action: Tensor, dt: float, road: Road) -> Others:
    """Vehicles 1 to N - 1 as points that turn at will, wherever they are on the road.

    Args:
        state: Traffic of B scenarios.
        action: Their accelerations [m/s^2] and yaw rates relative to the road [rad/s], shape (B, N - 1, 2).
        dt: Tick [s].
        road: The road.
    """
    x, y, heading, speed = (field[:, 1:] for field in (state.x, state.y, state.heading, state.speed))
    curvature = road.curvature(x)
    ahead = torch.cos(heading) * speed / (1.0 - curvature * y)
    return Others(*point_mass(x, y, heading, speed, action[..., 0], action[..., 1] + curvature * ahead, dt, curvature))
