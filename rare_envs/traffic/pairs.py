"""Pairs of vehicles in the flat world: relative pose and relative velocity of their bodies."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import indices
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
    return _compare(state, road, slice(0, 1), slice(1, None))


def encounters_of_all(state: State, road: Road) -> Encounter:
    """Return every pair of vehicles, P = N (N - 1) / 2, in the order of `pairs`."""
    first, second = (indices(index, state.x) for index in pairs(state.x.shape[1]))
    return _compare(state, road, first, second)


def _compare(state: State, road: Road, first: Tensor | slice, second: Tensor | slice) -> Encounter:
    """Return vehicles with others, by their indices; one may be compared with several."""
    x, y, heading = road.to_world(state.x, state.y, state.heading)
    along, across = velocities(state, heading)
    other = heading[:, second]
    one = heading[:, first].expand_as(other)
    axes = axes_of(x[:, second] - x[:, first], y[:, second] - y[:, first], one, other)
    rate = project_on_axes(along[:, second] - along[:, first], across[:, second] - across[:, first], one, other)
    return Encounter(axes, rate, other - one)
