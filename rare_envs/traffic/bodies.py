"""Bodies of vehicles, oriented boxes: overlap, distance, depth of an overlap and time to contact of two of them.

Two convex bodies are apart exactly if they are apart along one of the axes of their sides (the separating axis
theorem); of two boxes there are four. Bodies are compared in the flat world: where the road turns, differences along it
are not distances.

References:
    Gottschalk, Lin and Manocha, "OBBTree: a hierarchical structure for rapid interference detection", 1996; Ericson,
    "Real-time collision detection", 2005, sections 4.4 and 5.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import can_look, indices, may_hold, scalars
from rare_envs.traffic.road import Road, WorldPose
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

DIAGONAL = (VEHICLE_LENGTH**2 + VEHICLE_WIDTH**2) ** 0.5
"""Bodies whose centres are further apart than this [m] do not touch."""
_SIZE = (VEHICLE_LENGTH, VEHICLE_WIDTH)
_LENGTHS = (VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2)


class Axes(NamedTuple):
    """The other body as seen from the first along four axes, the last axis of each tensor.

    They are: along and across the first body, along and across the other.
    """

    offset: Tensor
    """Centre of the other less centre of the first [m], shape (..., 4)."""
    reach: Tensor
    """Offsets smaller than this overlap along the axis [m], shape (..., 4)."""

    @property
    def gap(self) -> Tensor:
        """Distance between the bodies along each axis [m], negative where they overlap, shape (..., 4)."""
        return self.offset.abs() - self.reach


class Crossing(NamedTuple):
    """Times at which two bodies overlap along each axis, shape (..., 4), if velocities and headings stay."""

    enter: Tensor
    """From this time [s] on, ..."""
    leave: Tensor
    """... until this one."""


def boxes_overlap(
    dx: Tensor,
    dy: Tensor,
    heading: Tensor,
    other_heading: Tensor,
    size: tuple[Tensor | float, Tensor | float] = _SIZE,
    other_size: tuple[Tensor | float, Tensor | float] = _SIZE,
) -> Tensor:
    """Return whether two vehicles' bodies overlap, by the separating axis theorem.

    It is true where `separation` is negative, to rounding.

    Args:
        dx: Centre of the other less centre of the first [m], any shape; the other tensors have the same.
        dy: Likewise across the road [m].
        heading: Headings of the first [rad].
        other_heading: Headings of the other [rad].
        size: Length and width of the first [m].
        other_size: Of the other [m].

    Returns:
        True where the boxes share more than their edges.

    Example:
        >>> dx, dy, straight = torch.tensor([4.9, 5.1]), torch.zeros(2), torch.zeros(2)
        >>> boxes_overlap(dx, dy, straight, straight).tolist()
        [True, False]
    """
    cos, sin = torch.cos(heading), torch.sin(heading)
    turn = other_heading - heading
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    cos, sin = torch.cos(turn), torch.sin(turn)
    other_along, other_across = along * cos + across * sin, across * cos - along * sin
    cos, sin = cos.abs(), sin.abs()
    half, other_half = _halves(size, dx), _halves(other_size, dx)
    reach = _reach(half, other_half, cos, sin)
    other_reach = reach if other_size is size else _reach(other_half, half, cos, sin)
    overlap = (along.abs() < reach[0]) & (across.abs() < reach[1])
    return overlap & (other_along.abs() < other_reach[0]) & (other_across.abs() < other_reach[1])


def _halves(size: tuple[Tensor | float, Tensor | float], like: Tensor) -> list[Tensor]:
    """Return half of length and width [m]."""
    return [0.5 * side if isinstance(side, Tensor) else scalars((0.5 * side,), like)[0] for side in size]


def _reach(half: Sequence[Tensor], other: Sequence[Tensor], cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far from the centre of a body that of one turned by an angle may be along and across it [m]."""
    (length, width), (other_length, other_width) = half, other
    return length + other_length * cos + other_width * sin, width + other_length * sin + other_width * cos


def project_on_axes(x: Tensor, y: Tensor, heading: Tensor, other_heading: Tensor) -> Tensor:
    """Return vectors (x, y) along the axes of two bodies by their headings [rad], any shape: (...) -> (..., 4)."""
    cos, sin = torch.cos(heading), torch.sin(heading)
    other_cos, other_sin = torch.cos(other_heading), torch.sin(other_heading)
    return torch.stack(
        (x * cos + y * sin, y * cos - x * sin, x * other_cos + y * other_sin, y * other_cos - x * other_sin), -1
    )


def axes_of(dx: Tensor, dy: Tensor, heading: Tensor, other_heading: Tensor) -> Axes:
    """Return two bodies along their four axes, from the way (dx, dy) [m] to the other's centre and headings [rad]."""
    turn = other_heading - heading
    cos, sin = torch.cos(turn).abs(), torch.sin(turn).abs()
    half = _halves(_SIZE, dx)
    along, across = _reach(half, half, cos, sin)
    return Axes(project_on_axes(dx, dy, heading, other_heading), torch.stack((along, across, along, across), -1))


def separation(axes: Axes) -> Tensor:
    """Return the largest gap along an axis [m], (...): the negative depth of an overlap, else at most the distance."""
    return axes.gap.amax(-1)


def box_distance(axes: Axes, turn: Tensor) -> Tensor:
    """Return the exact distance of two bodies [m], (...), the negative depth of an overlap; turn is between headings.

    The distance of two convex polygons that are apart is that of a corner of one from the other.
    """
    along, across, other_along, other_across = axes.offset.unbind(-1)
    corners = _corner_distance(along, across, turn)
    own = _corner_distance(-other_along, -other_across, -turn)
    depth = separation(axes)
    return torch.where(depth < 0, depth, torch.minimum(corners, own))


def _corner_distance(along: Tensor, across: Tensor, turn: Tensor) -> Tensor:
    """Return the least distance [m] of a corner of a turned box at (along, across) from an unturned one at 0."""
    half_length, half_width = _LENGTHS
    cos, sin = torch.cos(turn)[..., None], torch.sin(turn)[..., None]
    u = cos.new_tensor([half_length, half_length, -half_length, -half_length])
    v = cos.new_tensor([half_width, -half_width, half_width, -half_width])
    out = (along[..., None] + u * cos - v * sin).abs() - half_length
    aside = (across[..., None] + u * sin + v * cos).abs() - half_width
    square = out.clamp(min=0.0).square() + aside.clamp(min=0.0).square()
    least = square.amin(-1)
    apart = least > 0
    return torch.where(apart, least, 1.0).sqrt() * apart  # the root has no slope at 0


def crossing(axes: Axes, rate: Tensor) -> Crossing:
    """Return when bodies overlap along each axis, (..., 4), at rates [m/s] of the offsets (..., 4)."""
    still = rate == 0
    speed = torch.where(still, 1.0, rate)
    middle, half = -axes.offset / speed, axes.reach / speed.abs()
    always = torch.where(axes.gap < 0, torch.inf, -torch.inf)
    return Crossing(torch.where(still, -always, middle - half), torch.where(still, always, middle + half))


def time_to_contact(axes: Axes, rate: Tensor) -> Tensor:
    """Return the exact time until two bodies touch if velocities and headings stay [s], (...); 0 now, inf for never.

    They overlap while they do along every axis: from the last entry to the first exit. Rates [m/s] are (..., 4).
    """
    times = crossing(axes, rate)
    enter, leave = times.enter.amax(-1), times.leave.amin(-1)
    return torch.where((enter < leave) & (leave > 0), enter.clamp(min=0.0), torch.inf)


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


def ego_overlaps(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return which vehicles' bodies overlap the ego's, boolean, (B, N - 1); `pose` is where they are, if known."""
    return _overlap_of(_in_world(state, road, pose), slice(0, 1), slice(1, None))


def others_overlap(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return whether two vehicles other than the ego overlap, boolean, shape (B,); arguments as of `ego_overlaps`."""
    n = state.x.shape[1] - 1
    first, second = (indices(index[n:], state.x) for index in pairs(n + 1))
    overlapping: Tensor = _overlap_of(_in_world(state, road, pose), first, second).any(1)
    return overlapping


def pairwise_overlaps(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return which bodies overlap which, boolean, (B, N, N), symmetric, nobody with itself; row 0 is `ego_overlaps`."""
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
