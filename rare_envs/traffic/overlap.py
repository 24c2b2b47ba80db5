"""Overlap of vehicles: which bodies touch, of the ego and of all pairs."""

from __future__ import annotations

import torch
from torch import Tensor

from rare_envs.traffic.road import Road, WorldPose
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

_DIAGONAL = (VEHICLE_LENGTH**2 + VEHICLE_WIDTH**2) ** 0.5


def boxes_overlap(
    dx: Tensor,
    dy: Tensor,
    heading: Tensor,
    other_heading: Tensor,
    size: tuple[Tensor | float, Tensor | float] = (VEHICLE_LENGTH, VEHICLE_WIDTH),
    other_size: tuple[Tensor | float, Tensor | float] = (VEHICLE_LENGTH, VEHICLE_WIDTH),
) -> Tensor:
    """Whether two vehicles' bodies overlap, by the separating axis theorem on the boxes' four axes.

    Args:
        dx: Centre of the other less centre of the first [m], any shape; the other tensors have the same.
        dy: Likewise across the road [m].
        heading: Headings of the first [rad].
        other_heading: Headings of the other [rad].
        size: Length and width of the first [m].
        other_size: Of the other [m].

    Returns:
        True where the boxes share more than their edges.
    """
    cos, sin = torch.cos(heading), torch.sin(heading)
    turn = other_heading - heading
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    cos, sin = torch.cos(turn), torch.sin(turn)
    other_along, other_across = along * cos + across * sin, across * cos - along * sin
    cos, sin = cos.abs(), sin.abs()
    (length, width), (other_length, other_width) = ((0.5 * long, 0.5 * wide) for long, wide in (size, other_size))
    overlap = along.abs() < length + other_length * cos + other_width * sin
    overlap = overlap & (across.abs() < width + other_length * sin + other_width * cos)
    overlap = overlap & (other_along.abs() < other_length + length * cos + width * sin)
    return overlap & (other_across.abs() < other_width + length * sin + width * cos)


def ego_overlaps(state: State, road: Road, placed: WorldPose | None = None) -> Tensor:
    """Which vehicles' bodies overlap the ego's.

    They are compared in the world: where the road turns, distances along it are not those between bodies. Boxes are
    only compared where centres are closer than a diagonal, so the usual tick costs a comparison.

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        placed: Where they are in the world, if that is known already.

    Returns:
        Boolean, shape (B, N - 1).
    """
    x, y, heading = road.to_world(state.x, state.y, state.heading) if placed is None else placed[:3]
    dx, dy = x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1]
    near: Tensor = (dx.abs() < _DIAGONAL) & (dy.abs() < _DIAGONAL)
    if not bool(near.any()):
        return near
    row, column = near.nonzero(as_tuple=True)
    near[row, column] = boxes_overlap(dx[row, column], dy[row, column], heading[row, 0], heading[row, column + 1])
    return near


def pairwise_overlaps(state: State, road: Road, placed: WorldPose | None = None) -> Tensor:
    """Which vehicles' bodies overlap which.

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        placed: Where they are in the world, if that is known already.

    Returns:
        Boolean, shape (B, N, N), symmetric, nobody with itself; row 0 is `ego_overlaps`.
    """
    x, y, heading = road.to_world(state.x, state.y, state.heading) if placed is None else placed[:3]
    n = x.shape[1]
    i, j = torch.triu_indices(n, n, 1, device=x.device)
    dx, dy = x[:, j] - x[:, i], y[:, j] - y[:, i]
    near = (dx.abs() < _DIAGONAL) & (dy.abs() < _DIAGONAL)
    both = torch.zeros(len(x), n, n, dtype=torch.bool, device=x.device)
    row, pair = near.nonzero(as_tuple=True)
    if len(row):
        i, j = i[pair], j[pair]
        hit = boxes_overlap(dx[row, pair], dy[row, pair], heading[row, i], heading[row, j])
        both[row, i, j] = hit
        both[row, j, i] = hit
    return both
