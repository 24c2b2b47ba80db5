"""Overlap of vehicles: which bodies touch, of the ego and of all pairs.

Bodies are compared in the flat world: where the road turns, differences along it are not distances between bodies.
Boxes are only compared where centres are closer than a diagonal, so that the usual tick costs a comparison.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rare_envs.devices import can_look, indices
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
    x, y, heading = _in_world(state, road, pose)
    dx, dy = x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1]
    return _overlap_where_near(dx, dy, heading[:, :1].expand_as(dx), heading[:, 1:])


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


def _overlap_of(place: tuple[Tensor, Tensor, Tensor], first: Tensor, second: Tensor) -> Tensor:
    """Return which of P pairs of vehicles overlap, boolean, shape (B, P)."""
    x, y, heading = place
    dx, dy = x[:, second] - x[:, first], y[:, second] - y[:, first]
    return _overlap_where_near(dx, dy, heading[:, first], heading[:, second])


def _overlap_where_near(dx: Tensor, dy: Tensor, heading: Tensor, other_heading: Tensor) -> Tensor:
    """Return `boxes_overlap` of pairs (B, P), compared only where centres are near."""
    near: Tensor = (dx.abs() < DIAGONAL) & (dy.abs() < DIAGONAL)
    if not can_look(near):
        return near & boxes_overlap(dx, dy, heading, other_heading)
    if bool(near.any()):
        at = near.nonzero(as_tuple=True)
        near[at] = boxes_overlap(dx[at], dy[at], heading[at], other_heading[at])
    return near
