"""Overlap of vehicles: which bodies touch, of the ego and of all pairs.

Bodies are compared in the flat world: where the road turns, differences along it are not distances between bodies.
Boxes are only compared where centres are closer than a diagonal, so that the usual tick costs a comparison.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rare_envs.devices import can_look, indices, may_hold, scalars
from rare_envs.traffic.oriented_boxes import DIAGONAL, boxes_overlap
from rare_envs.traffic.pairs import pairs
from rare_envs.traffic.road import Road, WorldPose
from rare_envs.traffic.state import State


def ego_overlaps(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return which vehicles' bodies overlap the ego's.

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        pose: Where they are in the world, if that is known already.

    Returns:
        Boolean, shape (B, N - 1).
    """
    return _overlap_of(_in_world(state, road, pose), slice(0, 1), slice(1, None))


def others_overlap(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return whether two vehicles other than the ego overlap, boolean, shape (B,); arguments as of `ego_overlaps`."""
    n = state.x.shape[1] - 1
    first, second = (indices(index[n:], state.x) for index in pairs(n + 1))
    overlapping: Tensor = _overlap_of(_in_world(state, road, pose), first, second).any(1)
    return overlapping


def pairwise_overlaps(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return which vehicles' bodies overlap which.

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        pose: Where they are in the world, if that is known already.

    Returns:
        Boolean, shape (B, N, N), symmetric, nobody with itself; row 0 is `ego_overlaps`.
    """
    batch, n = state.x.shape
    first, second = (indices(index, state.x) for index in pairs(n))
    overlapping = _overlap_of(_in_world(state, road, pose), first, second)
    both = torch.zeros(batch, n, n, dtype=torch.bool, device=state.x.device)
    both[:, first, second] = overlapping
    both[:, second, first] = overlapping
    return both


def _in_world(state: State, road: Road, pose: WorldPose | None) -> tuple[Tensor, Tensor, Tensor]:
    return road.to_world(state.x, state.y, state.heading) if pose is None else pose[:3]


def _overlap_of(place: tuple[Tensor, Tensor, Tensor], first: Tensor | slice, second: Tensor | slice) -> Tensor:
    """Return which of P pairs of vehicles overlap, boolean, shape (B, P); one may be compared with several."""
    x, y, heading = place
    dx, (diagonal,) = x[:, second] - x[:, first], scalars((DIAGONAL,), x)
    near: Tensor = dx.abs() < diagonal
    if not may_hold(near):  # of a few rows mostly
        return near
    dy = y[:, second] - y[:, first]
    near = near & (dy.abs() < diagonal)
    other = heading[:, second]
    one = heading[:, first].expand_as(other)
    if not can_look(near):
        return near & boxes_overlap(dx, dy, one, other)
    if bool(near.any()):
        at = near.nonzero(as_tuple=True)
        near[at] = boxes_overlap(dx[at], dy[at], one[at], other[at])
    return near
