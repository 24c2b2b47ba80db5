"""Bodies of vehicles, oriented boxes: overlap, distance, time to contact; and which are ahead, behind and beside.

Two convex bodies are apart exactly if they are apart along one of the axes of their sides (the separating axis
theorem); of two boxes there are four. Bodies are compared in the flat world: where the road turns, differences along it
are not distances.

References:
    Gottschalk, Lin and Manocha, "OBBTree: a hierarchical structure for rapid interference detection", 1996; Ericson,
    "Real-time collision detection", 2005, sections 4.4 and 5.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import can_look, constant, indices, may_hold, scalars
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
