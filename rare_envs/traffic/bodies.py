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
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import can_look, constant, indices, may_hold, scalars
from rare_envs.traffic.road import Road, WorldPose
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

DIAGONAL = (VEHICLE_LENGTH**2 + VEHICLE_WIDTH**2) ** 0.5
"""Bodies whose centres are further apart than this [m] do not touch."""
_SIZE = (VEHICLE_LENGTH, VEHICLE_WIDTH)


class Axes(NamedTuple):
    """Two bodies along four axes, (..., 4): along and across the first body, along and across the other."""

    offset: Tensor
    """Centre of the other less centre of the first [m]."""
    reach: Tensor
    """Offsets smaller than this overlap along the axis [m]."""

    @property
    def gap(self) -> Tensor:
        """Distance along each axis [m], negative where the bodies overlap; the largest, if negative, is the depth."""
        return self.offset.abs() - self.reach


def boxes_overlap(
    dx: Tensor,
    dy: Tensor,
    heading: Tensor,
    other_heading: Tensor,
    size: tuple[Tensor | float, Tensor | float] = _SIZE,
    other_size: tuple[Tensor | float, Tensor | float] = _SIZE,
) -> Tensor:
    """Return whether two bodies share more than their edges, by the separating axis theorem; any shape.

    Arguments are the way to the other's centre [m], headings [rad], and length and width [m] of both. It is true where
    all of `Axes.gap` are negative, to rounding.
    """
    turn = other_heading - heading
    along, across = rotate(dx, dy, torch.cos(heading), torch.sin(heading))
    cos, sin = torch.cos(turn), torch.sin(turn)
    other_along, other_across = rotate(along, across, cos, sin)
    cos, sin = cos.abs(), sin.abs()
    half, other_half = _halves(size, dx), _halves(other_size, dx)
    reach = _reach(half, other_half, cos, sin)
    other_reach = reach if other_size is size else _reach(other_half, half, cos, sin)
    overlap = (along.abs() < reach[0]) & (across.abs() < reach[1])
    return overlap & (other_along.abs() < other_reach[0]) & (other_across.abs() < other_reach[1])


def rotate(x: Tensor, y: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """Return vectors (x, y) along and across a direction (cos, sin), any shape."""
    return x * cos + y * sin, y * cos - x * sin


def _halves(size: tuple[Tensor | float, Tensor | float], like: Tensor) -> list[Tensor]:
    """Return half of length and width [m]."""
    return [0.5 * side if isinstance(side, Tensor) else scalars((0.5 * side,), like)[0] for side in size]


def _reach(half: Sequence[Tensor], other: Sequence[Tensor], cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far from the centre of a body that of one turned by an angle may be along and across it [m]."""
    (length, width), (other_length, other_width) = half, other
    return length + other_length * cos + other_width * sin, width + other_length * sin + other_width * cos


def project_on_axes(x: Tensor, y: Tensor, heading: Tensor, other_heading: Tensor) -> Tensor:
    """Return vectors (x, y) along the axes of two bodies by their headings [rad], any shape: (...) -> (..., 4)."""
    parts = (rotate(x, y, torch.cos(angle), torch.sin(angle)) for angle in (heading, other_heading))
    return torch.stack([part for both in parts for part in both], -1)


def axes_of(dx: Tensor, dy: Tensor, heading: Tensor, other_heading: Tensor) -> Axes:
    """Return two bodies along their four axes, from the way (dx, dy) [m] to the other's centre and headings [rad]."""
    turn = other_heading - heading
    half = _halves(_SIZE, dx)
    reach = _reach(half, half, torch.cos(turn).abs(), torch.sin(turn).abs())
    return Axes(project_on_axes(dx, dy, heading, other_heading), torch.stack(reach + reach, -1))


def box_distance(axes: Axes, turn: Tensor) -> Tensor:
    """Return the exact distance of two bodies [m], a corner from the other; the negative depth of an overlap, (...)."""
    along, across, other_along, other_across = axes.offset.unbind(-1)
    corners = _corner_distance(along, across, turn)
    own = _corner_distance(-other_along, -other_across, -turn)
    depth = axes.gap.amax(-1)
    return torch.where(depth < 0, depth, torch.minimum(corners, own))


def _corner_distance(along: Tensor, across: Tensor, turn: Tensor) -> Tensor:
    """Return the least distance [m] of a corner of a turned box at (along, across) from an unturned one at 0."""
    half_length, half_width = _SIZE[0] / 2, _SIZE[1] / 2
    cos, sin = torch.cos(turn)[..., None], torch.sin(turn)[..., None]
    u = cos.new_tensor([half_length, half_length, -half_length, -half_length])
    v = cos.new_tensor([half_width, -half_width, half_width, -half_width])
    out = (along[..., None] + u * cos - v * sin).abs() - half_length
    aside = (across[..., None] + u * sin + v * cos).abs() - half_width
    square = out.clamp(min=0.0).square() + aside.clamp(min=0.0).square()
    least = square.amin(-1)
    apart = least > 0
    return torch.where(apart, least, 1.0).sqrt() * apart  # the root has no slope at 0


def crossing(axes: Axes, rate: Tensor) -> tuple[Tensor, Tensor]:
    """Return from when to when [s] bodies overlap along each axis, (..., 4), at rates [m/s] of the offsets (..., 4)."""
    still = rate == 0
    speed = torch.where(still, 1.0, rate)
    middle, half = -axes.offset / speed, axes.reach / speed.abs()
    always = torch.where(axes.gap < 0, torch.inf, -torch.inf)
    return torch.where(still, -always, middle - half), torch.where(still, always, middle + half)


def time_to_contact(axes: Axes, rate: Tensor) -> Tensor:
    """Return the exact time until two bodies touch if velocities and headings stay [s], (...); 0 now, inf for never.

    They overlap while they do along every axis: from the last entry to the first exit, at rates [m/s] (..., 4).
    """
    enters, leaves = crossing(axes, rate)
    enter, leave = enters.amax(-1), leaves.amin(-1)
    return torch.where((enter < leave) & (leave > 0), enter.clamp(min=0.0), torch.inf)


@lru_cache(maxsize=32)
def pairs(vehicles: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return every pair of vehicles once, the lower index first; those of the ego come first."""
    both = [(i, j) for i in range(vehicles) for j in range(i + 1, vehicles)]
    return tuple(i for i, _ in both), tuple(j for _, j in both)


Which = Literal["ego", "others", "all"]
"""Pairs of vehicles: of the ego with each other (P = N - 1), those without the ego, or all in the order of `pairs`."""


def select_pairs(state: State, which: Which) -> tuple[Any, Any]:
    """Return the indices of the first and of the second vehicles of pairs; the ego's are slices, to broadcast."""
    if which == "ego":
        return slice(0, 1), slice(1, None)
    n = state.x.shape[1]
    first, second = (indices(index[n - 1 if which == "others" else 0 :], state.x) for index in pairs(n))
    return first, second


def least(values: Tensor, nobody: float) -> Tensor:
    """Return the least over pairs (B, P), shape (B,), and at most the value for nobody."""
    return torch.nn.functional.pad(values, (0, 1), value=nobody).amin(1)


class Encounter(NamedTuple):
    """P pairs of vehicles in B scenarios, in the flat world; shapes (B, P)."""

    dx: Tensor
    """Centre of the other less centre of the first [m]."""
    dy: Tensor
    heading: Tensor
    """Of the first [rad]."""
    other_heading: Tensor
    dvx: Tensor
    """Velocity of the other less that of the first [m/s]."""
    dvy: Tensor

    @property
    def axes(self) -> Axes:
        """The bodies along their axes, (B, P, 4)."""
        return axes_of(self.dx, self.dy, self.heading, self.other_heading)

    @property
    def rate(self) -> Tensor:
        """Change of the offsets along the axes [m/s], (B, P, 4)."""
        return project_on_axes(self.dvx, self.dvy, self.heading, self.other_heading)


def encounter(
    state: State, road: Road, which: Which = "ego", before: State | None = None, dt: float = 0.1
) -> Encounter:
    """Return pairs of vehicles in the world, with velocities by speeds and headings or over the tick since `before`."""
    x, y, heading = road.to_world(state.x, state.y, state.heading)
    if before is None:
        vx, vy = state.speed * torch.cos(heading), state.speed * torch.sin(heading)
    else:
        old_x, old_y, _ = road.to_world(before.x, before.y, before.heading)
        vx, vy = (x - old_x) / dt, (y - old_y) / dt
    first, second = select_pairs(state, which)
    other = heading[:, second]
    dx, dy, dvx, dvy = (each[:, second] - each[:, first] for each in (x, y, vx, vy))
    return Encounter(dx, dy, heading[:, first].expand_as(other), other, dvx, dvy)


def overlaps(state: State, road: Road, which: Which = "ego", pose: WorldPose | None = None) -> Tensor:
    """Return which pairs of vehicles overlap, boolean, (B, P); `pose` is where they are in the world, if known."""
    x, y, heading = road.to_world(state.x, state.y, state.heading) if pose is None else pose[:3]
    first, second = select_pairs(state, which)
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
    """The lead of a follower."""

    gap: Tensor
    """Bumper to bumper along the road [m], shape (B,); inf without a lead, negative side by side."""
    closing_speed: Tensor
    """Follower's speed less the lead's, along the follower's heading [m/s], shape (B,); 0 without a lead."""


def lead_of(state: State, road: Road) -> Lead:
    """Return the ego's lead: the nearest vehicle ahead whose body reaches into the ego's lane.

    "Ahead" compares centres. A body reaches into a lane when its centre is within half a lane and half a vehicle of
    the lane's centre, which for a 4 m lane is HighwayEnv's `on_lane` with its margin of 1 m. Gaps are measured along
    the road's reference line.
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
"""Lanes in the last axis of `find_neighbours`."""


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
        edges = constant(road.edges, state.y).expand(len(state.x), -1)
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


def find_neighbours(
    traffic: LaneTraffic, who: slice, target: Tensor, reach: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the nearest ahead (x is not less) and behind of the M vehicles `who` in V, and which lanes there are.

    Indices in the lane on the left, the own one and the one on the right, -1 for nobody, int64, (B, M, 3), and boolean.
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
    return nearest(ahead, inside & (ahead >= 0)), nearest(-ahead, inside & (ahead < 0)), exists


def nearest(distance: Tensor, among: Tensor) -> Tensor:
    """Return the index of the least distance among some vehicles, -1 for none: (..., V) -> (...)."""
    least, index = torch.where(among, distance, torch.inf).min(dim=-1)
    return torch.where(least < torch.inf, index, -1)


def find_touching(state: State, road: Road) -> Tensor:
    """Return which bodies overlap which, boolean, (B, N, N), symmetric, nobody with itself."""
    first, second = select_pairs(state, "all")
    touching = torch.zeros(*state.x.shape, state.x.shape[1], dtype=torch.bool, device=state.x.device)
    touching[:, first, second] = touching[:, second, first] = overlaps(state, road, "all")
    return touching


def find_struck(touching: Tensor, off: Tensor, active: Tensor) -> Tensor:
    """Return which vehicles crash, boolean, (B, N): those that touch the ego or an active one (B, N), which do too.

    So do these where they are `off` the road (B, N). Others pass through each other.
    """
    active = active | (torch.arange(active.shape[1], device=active.device) == 0)
    return (touching & (active[:, :, None] | active[:, None, :])).any(dim=2) | (off & active)
