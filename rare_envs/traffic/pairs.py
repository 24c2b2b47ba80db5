"""Pairs of vehicles in the flat world: relative pose and relative velocity of their bodies."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.traffic.oriented_boxes import Axes, axes_of, project_on_axes
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State


class Encounter(NamedTuple):
    """P pairs of vehicles in B scenarios; shapes (B, P), of axes (B, P, 4)."""

    axes: Axes
    """Of the first and the other."""
    rate: Tensor
    """Velocity of the other less that of the first along the axes [m/s]."""
    turn: Tensor
    """Heading of the other less that of the first [rad]."""


@lru_cache(maxsize=32)
def pairs(vehicles: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return every pair of vehicles once, the lower index first; those of the ego come first."""
    both = [(i, j) for i in range(vehicles) for j in range(i + 1, vehicles)]
    return tuple(i for i, _ in both), tuple(j for _, j in both)


def velocities(state: State, heading: Tensor) -> tuple[Tensor, Tensor]:
    """Return velocities along the axes that headings (B, N) are measured from [m/s], shape (B, N) each."""
    return state.speed * torch.cos(heading), state.speed * torch.sin(heading)


def least(values: Tensor, nobody: float) -> Tensor:
    """Return the least over pairs (B, P), shape (B,), and at most the value for nobody."""
    return torch.nn.functional.pad(values, (0, 1), value=nobody).amin(1)


def encounter(state: State, road: Road) -> Encounter:
    """Return the ego with each of the N - 1 other vehicles.

    They are compared in the world: where the road turns, ways along it are not distances.
    """
    x, y, heading = road.to_world(state.x, state.y, state.heading)
    along, across = velocities(state, heading)
    ego, other = heading[:, :1].expand_as(heading[:, 1:]), heading[:, 1:]
    axes = axes_of(x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1], ego, other)
    return Encounter(
        axes, project_on_axes(along[:, 1:] - along[:, :1], across[:, 1:] - across[:, :1], ego, other), other - ego
    )
