"""Oriented boxes, the bodies of vehicles: overlap, distance, depth of an overlap and time to contact of two of them.

Two convex bodies are apart exactly if they are apart along one of the axes of their sides (the separating axis
theorem); of two boxes there are four.

References:
    Gottschalk, Lin and Manocha, "OBBTree: a hierarchical structure for rapid interference detection", 1996; Ericson,
    "Real-time collision detection", 2005, sections 4.4 and 5.5.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import scalars
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

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
    """Return a vector along the four axes.

    Args:
        x: Component along the world's X axis, any shape; the other tensors have the same.
        y: Component along its Y axis.
        heading: Headings of the first bodies [rad].
        other_heading: Headings of the other bodies [rad].

    Returns:
        Shape (..., 4).
    """
    cos, sin = torch.cos(heading), torch.sin(heading)
    other_cos, other_sin = torch.cos(other_heading), torch.sin(other_heading)
    return torch.stack(
        (x * cos + y * sin, y * cos - x * sin, x * other_cos + y * other_sin, y * other_cos - x * other_sin), -1
    )


def axes_of(dx: Tensor, dy: Tensor, heading: Tensor, other_heading: Tensor) -> Axes:
    """Return two bodies along their four axes.

    Args:
        dx: Centre of the other less centre of the first [m], any shape; the other tensors have the same.
        dy: Likewise across.
        heading: Headings of the first [rad].
        other_heading: Headings of the other [rad].
    """
    turn = other_heading - heading
    cos, sin = torch.cos(turn).abs(), torch.sin(turn).abs()
    half = _halves(_SIZE, dx)
    along, across = _reach(half, half, cos, sin)
    return Axes(project_on_axes(dx, dy, heading, other_heading), torch.stack((along, across, along, across), -1))


def separation(axes: Axes) -> Tensor:
    """Return the largest gap along an axis [m], shape (...).

    Positive if and only if the bodies are apart, then at most their distance; else the negative depth of their overlap:
    the least way that one has to be moved to be clear of the other.
    """
    return axes.gap.amax(-1)


def box_distance(axes: Axes, turn: Tensor) -> Tensor:
    """Return the exact distance between two bodies [m], the negative depth of their overlap if they do.

    The distance of two convex polygons that are apart is that of a corner of one from the other.

    Args:
        axes: Of the two.
        turn: Heading of the other less heading of the first [rad], shape (...).

    Returns:
        Shape (...).
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
    """Return when the bodies overlap along each axis.

    Args:
        axes: Of the two bodies now.
        rate: Velocity of the other less that of the first along the axes [m/s], shape (..., 4).
    """
    still = rate == 0
    speed = torch.where(still, 1.0, rate)
    middle, half = -axes.offset / speed, axes.reach / speed.abs()
    always = torch.where(axes.gap < 0, torch.inf, -torch.inf)
    return Crossing(torch.where(still, -always, middle - half), torch.where(still, always, middle + half))


def time_to_contact(axes: Axes, rate: Tensor) -> Tensor:
    """Return the exact time until two bodies touch if velocities and headings stay [s]: a swept test on the four axes.

    They overlap while they do along every axis: from the last entry to the first exit.

    Args:
        axes: Of the two bodies now.
        rate: Velocity of the other less that of the first along the axes [m/s], shape (..., 4).

    Returns:
        0 where they overlap now, inf where they never will, shape (...).
    """
    times = crossing(axes, rate)
    enter, leave = times.enter.amax(-1), times.leave.amin(-1)
    return torch.where((enter < leave) & (leave > 0), enter.clamp(min=0.0), torch.inf)
