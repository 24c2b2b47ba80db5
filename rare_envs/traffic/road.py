"""Roads: their lanes, and the transformation from road coordinates to a flat world and back.

Road coordinates are x along the road's reference line [m], y across it and positive to the right, headings relative to
it. In a straight road they are world coordinates too.
"""

import json
import math
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import scalars
from rare_envs.traffic.reference_line import ReferenceLine


class WorldPose(NamedTuple):
    """Vehicles in the flat world; all of one shape.

    Example:
        >>> zero = torch.zeros(1)
        >>> i80().place(zero + 300.0, zero, zero).heading.sign().tolist()  # the road has turned to the left
        [-1.0]
    """

    x: Tensor
    """[m]."""
    y: Tensor
    """[m]."""
    heading: Tensor
    """Relative to the X axis [rad]."""
    curvature: Tensor
    """Of the road where they are [1/m]."""


@dataclass(frozen=True)
class Road:
    """Lanes beside each other along a line. Lane 0 is the leftmost; all tensors may have any shape.

    Example:
        >>> road = Road(edges=(-2.0, 2.0, 5.5))
        >>> road.lanes, road.width, road.centre(1)
        (2, 3.75, 3.75)
        >>> road.lane_of(torch.tensor([0.0, 3.0])).tolist(), road.off_road(torch.tensor([6.0])).tolist()
        ([0, 1], [True])
    """

    edges: tuple[float, ...]
    """y of the lines that bound the lanes [m], from left to right: one more than there are lanes."""
    reference_line: ReferenceLine | None = None
    """The reference line, y = 0; None for a straight one."""

    def __post_init__(self) -> None:
        increasing = all(left < right for left, right in pairwise(self.edges))
        if len(self.edges) < 2 or not increasing or not all(map(math.isfinite, self.edges)):
            raise ValueError(f"Expected two or more increasing edges in m, got {self.edges!r}.")

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return len(self.edges) - 1

    @cached_property
    def width(self) -> float:
        """Mean width of a lane [m]."""
        return (self.edges[-1] - self.edges[0]) / self.lanes

    @cached_property
    def middle(self) -> float:
        """Middle of the road, its y [m]."""
        return (self.edges[0] + self.edges[-1]) / 2

    @cached_property
    def equal(self) -> bool:
        """Whether all lanes have the same width."""
        return all(abs(right - left - self.width) < 1e-9 for left, right in pairwise(self.edges))

    def centre(self, lane: int) -> float:
        """Return the centre of a lane, its y [m]."""
        return (self.edges[lane] + self.edges[lane + 1]) / 2

    def lane_of(self, y: Tensor) -> Tensor:
        """Return the index of the lane that y is in, int64; beyond the road's edge it is the outermost lane."""
        inner, _, _ = _lane_table(self, y.dtype, y.device)
        return (y >= inner.view(-1, *[1] * y.ndim)).sum(0)  # three times as fast as a search

    def centre_of(self, y: Tensor) -> Tensor:
        """Return the centre of the lane that y is in, its y [m]."""
        if not self.equal:
            _, left, right = _lane_table(self, y.dtype, y.device)
            lane = self.lane_of(y)
            return (left[lane] + right[lane]) / 2
        first = self.centre(0)
        start, width = scalars((first, self.width), y)
        if self.lanes == 1:
            return torch.full_like(y, first)
        lane = torch.round((y - start if first else y) / width).clamp(0, self.lanes - 1)
        return lane * width + start if first else lane * width

    def markers(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances to the left and right marker of the own lane [m], negative beyond it: off the road."""
        _, left, right = _lane_table(self, y.dtype, y.device)
        lane = self.lane_of(y)
        return y - left[lane], right[lane] - y

    def off_road(self, y: Tensor) -> Tensor:
        """Return whether y is beyond an outer edge of the road."""
        middle, half = scalars((self.middle, (self.edges[-1] - self.edges[0]) / 2), y)
        return (y - middle).abs() > half

    def curvature(self, x: Tensor) -> Tensor:
        """Return the curvature of the reference line [1/m], positive where the road turns to the right."""
        return torch.zeros_like(x) if self.reference_line is None else self.reference_line.curvature_at(x)

    def to_world(self, x: Tensor, y: Tensor, heading: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Transform road to world coordinates.

        The world is flat. Its X axis is the reference line's tangent at x = 0, its Y axis points to the right of it.

        Args:
            x: Along the road [m].
            y: Across the road [m].
            heading: Relative to the road [rad].

        Returns:
            X [m], Y [m] and the heading relative to the X axis [rad].
        """
        if self.reference_line is None:
            return x, y, heading
        return self.place(x, y, heading)[:3]

    def place(self, x: Tensor, y: Tensor, heading: Tensor) -> "WorldPose":
        """Return world coordinates as `to_world` does, and with them the curvature of the reference line at x."""
        if self.reference_line is None:
            return WorldPose(x, y, heading, torch.zeros_like(x))
        point = self.reference_line.at(x)
        return WorldPose(
            torch.addcmul(point.x, y, torch.sin(point.heading), value=-1.0),
            torch.addcmul(point.y, y, torch.cos(point.heading)),
            point.heading + heading,
            point.curvature,
        )

    def from_world(self, x: Tensor, y: Tensor, heading: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Transform world to road coordinates, the inverse of `to_world`.

        Args:
            x: X [m].
            y: Y [m]; within a fifth of the road's least radius of the reference line.
            heading: Relative to the X axis [rad].

        Returns:
            x and y in the road [m], and the heading relative to the road [rad].
        """
        if self.reference_line is None:
            return x, y, heading
        s = self.reference_line.nearest(x, y)
        point = self.reference_line.at(s)
        across = (y - point.y) * torch.cos(point.heading) - (x - point.x) * torch.sin(point.heading)
        return s, across, heading - point.heading


@cache  # never forgotten: recorded rollouts read it where it is
def _lane_table(road: Road, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return the lines between lanes, and the left and the right line of each lane."""
    with torch.inference_mode(False):  # tables made under it could not be used for gradients later
        edges = torch.tensor(road.edges, dtype=dtype, device=device)
        return edges[1:-1].contiguous(), edges[:-1].contiguous(), edges[1:].contiguous()


def straight(lanes: int, width: float = 4.0) -> Road:
    """Return a straight road of equal lanes; lane 0 is centred on y = 0.

    Args:
        lanes: Number of lanes.
        width: Of each [m].

    Example:
        >>> straight(2).edges
        (-2.0, 2.0, 6.0)
    """
    return Road(tuple((k - 0.5) * width for k in range(lanes + 1)))


@cache
def i80() -> Road:
    """Return Interstate 80 at Emeryville, California: six curved lanes, 700 m, then straight on.

    The reference line is the middle of the leftmost lane; `training.recipes.i80_road` fitted it to the survey.

    Example:
        >>> i80().lanes, round(i80().width, 2)
        (6, 3.66)
    """
    text = (resources.files("rare_envs") / "data" / "i80.json").read_text(encoding="utf-8")
    table = json.loads(text)
    return Road(tuple(table["edges"]), ReferenceLine(table["spacing"], tuple(table["curvature"])))
