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

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.devices import can_look, constant, scalars

MAX_CURVATURE = 0.005
"""Largest curvature [1/m], a radius of 200 m: below it the series in `ReferenceLine` are good to 1e-4 m a metre."""
MAX_TURN = 0.5
"""Most that a curve may turn away from its start [rad], so that `ReferenceLine.nearest` finds its way."""
_CELL = 10.0
"""Longest cell of the table [m]."""
_NEWTON_STEPS = 4
"""They converge quadratically: within a fifth of the least radius the fourth is below rounding."""


class WorldPose(NamedTuple):
    """Places in the flat world, of vehicles or of a reference line; all of one shape."""

    x: Tensor
    """Along the tangent at the start of the road [m]."""
    y: Tensor
    """To the right of it [m]."""
    heading: Tensor
    """Relative to it [rad], positive to the right."""
    curvature: Tensor
    """Of the road there [1/m], positive where it turns to the right."""


@dataclass(frozen=True)
class ReferenceLine:
    """A line whose curvature is linear between equally spaced knots, and which is straight before and after them.

    So heading and curvature are continuous. The line is tabulated in cells of at most 10 m, in which positions are
    cubic and headings quadratic in the way s along the line, which is its arc length.

    Raises:
        ValueError: If spacing or curvatures are not as below, or the line turns by more than `MAX_TURN`.

    Example:
        >>> bend = ReferenceLine(spacing=50.0, curvature=(0.0, 0.002, 0.0))
        >>> point = bend.at(torch.tensor([200.0], dtype=torch.float64))
        >>> round(point.heading.item(), 3)  # the area under the curvature, 50 m x 0.002 / m
        0.1
        >>> round(bend.nearest(point.x, point.y).item(), 6)
        200.0
    """

    spacing: float
    """Between knots [m]; the first is at s = 0."""
    curvature: tuple[float, ...]
    """At the knots [1/m], positive to the right; 0 at both ends."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.spacing) and self.spacing > 0.0):
            raise ValueError(f"Expected a positive spacing of knots in m, got {self.spacing!r}.")
        if len(self.curvature) < 2 or self.curvature[0] != 0.0 or self.curvature[-1] != 0.0:
            raise ValueError(f"Expected two or more curvatures, the first and last 0, got {self.curvature!r}.")
        if not all(abs(k) <= MAX_CURVATURE for k in self.curvature):
            raise ValueError(f"Expected curvatures of at most {MAX_CURVATURE} 1/m, got {self.curvature!r}.")
        turn = float(np.abs(_nodes(self)[2]).max())
        if turn > MAX_TURN:
            raise ValueError(f"Expected a curve that turns by at most {MAX_TURN} rad from its start, got {turn:.3g}.")

    def at(self, s: Tensor) -> WorldPose:
        """Return the points at ways s along the line [m], any shape, negative before its start; differentiable in s."""
        (x0, x1, x2, x3, y0, y1, y2, y3, heading, curvature, slope), ds = self._cell(s)
        return WorldPose(
            torch.addcmul(x0, ds, torch.addcmul(x1, ds, torch.addcmul(x2, ds, x3))),
            torch.addcmul(y0, ds, torch.addcmul(y1, ds, torch.addcmul(y2, ds, y3))),
            torch.addcmul(heading, ds, torch.addcmul(curvature, ds, slope, value=0.5)),
            torch.addcmul(curvature, ds, slope),
        )

    def nearest(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the way s [m] along the line of the point nearest to (x, y), any shape, by Newton's method.

        (x, y) is within a fifth of the least radius of the curve; s is differentiable once.
        """
        with torch.no_grad():
            s = x.clone()
            for _ in range(_NEWTON_STEPS - 1):
                s = self._newton(s, x, y)
        return self._newton(s, x, y)  # from the root, one step more has the derivatives of the root

    def _newton(self, s: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return s after one step of Newton's method towards the foot of the perpendicular."""
        point = self.at(s)
        cos, sin = torch.cos(point.heading), torch.sin(point.heading)
        dx, dy = x - point.x, y - point.y
        return s + (dx * cos + dy * sin) / (1.0 - point.curvature * (dy * cos - dx * sin))

    def _cell(self, s: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Return the coefficients of the cells that s is in, and the way since their starts."""
        table, step = _table(self, s.dtype, s.device)
        number = torch.floor(s.detach() / step).clamp(-1, len(table) - 2)
        if not can_look(number):  # an index beyond a table, which NaN would be, ends all work of a process on a GPU
            number = number.nan_to_num()
        rows = torch.nn.functional.embedding(number.long() + 1, table)  # eight times as fast as an index
        return rows.unbind(-1), s - number * step


def list_cells(line: ReferenceLine) -> list[tuple[float, ...]]:
    """Return the cells of a line between its first and its last knot, in order, as numbers.

    Length [m], place x, y [m] and heading [rad] of the start, and a, b and c: from there the line goes s + a s^3 along
    its heading, and b s^2 + c s^3 to the right of it.
    """
    table, step = _table(line, torch.float64, torch.device("cpu"))
    rows = table[1:-1].tolist()  # without the straights before and after the curve
    return [(step, x, y, h, -(k**2) / 6, k / 2, c / 6) for x, _, _, _, y, _, _, _, h, k, c in rows]


def _nodes(curve: ReferenceLine) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return the length of a cell [m], curvatures and headings at the ends of the cells."""
    parts = math.ceil(curve.spacing / _CELL)
    knots = np.arange(len(curve.curvature))
    fine = np.arange(parts * (len(curve.curvature) - 1) + 1) / parts
    curvature = np.interp(fine, knots, curve.curvature)
    step = curve.spacing / parts
    heading = np.concatenate(([0.0], np.cumsum((curvature[1:] + curvature[:-1]) * (step / 2))))
    return step, curvature, heading


@cache  # never forgotten: recorded rollouts read it where it is
def _table(curve: ReferenceLine, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, float]:
    """Return coefficients of the cells, straights before and after included, (cells, 11), and the length of a cell [m].

    With heading h, curvature k and its slope c at the start of a cell, the curve goes u = s - k^2 s^3 / 6 along h and
    w = k s^2 / 2 + c s^3 / 6 to the right of it. Columns: four coefficients of x, of y, then h, k and c.
    """
    step, k, h = _nodes(curve)
    c = np.diff(k) / step
    zero = np.zeros(1)
    h, k, c = np.concatenate((zero, h)), np.concatenate((zero, k)), np.concatenate((zero, c, zero))
    cos, sin = np.cos(h), np.sin(h)
    cubic_u, cubic_w = -(k**2) / 6, c / 6
    x = [cos, -sin * k / 2, cos * cubic_u - sin * cubic_w]
    y = [sin, cos * k / 2, sin * cubic_u + cos * cubic_w]
    x0, y0 = (np.concatenate((zero, np.cumsum(((a3 * step + a2) * step + a1) * step)[:-1])) for a1, a2, a3 in (x, y))
    table = np.column_stack((x0 - step, *x, y0, *y, h, k, c))
    with torch.inference_mode(False):  # a table made under it could not be used for gradients later
        return torch.from_numpy(table).to(device=device, dtype=dtype), step


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

    @cached_property
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
        inner = constant(self.edges, y)[1:-1]
        return (y >= inner.view(-1, *[1] * y.ndim)).sum(0)  # three times as fast as a search

    def centre_of(self, y: Tensor) -> Tensor:
        """Return the centre of the lane that y is in, its y [m]."""
        if not self.equal:
            edges, lane = constant(self.edges, y), self.lane_of(y)
            return (edges[lane] + edges[lane + 1]) / 2
        first = self.centre(0)
        start, width = scalars((first, self.width), y)
        if self.lanes == 1:
            return torch.full_like(y, first)
        lane = torch.round((y - start if first else y) / width).clamp(0, self.lanes - 1)
        return lane * width + start if first else lane * width

    def markers(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances to the left and right marker of the own lane [m], negative beyond it: off the road."""
        edges, lane = constant(self.edges, y), self.lane_of(y)
        return y - edges[lane], edges[lane + 1] - y

    def off_road(self, y: Tensor) -> Tensor:
        """Return whether y is beyond an outer edge of the road."""
        middle, half = scalars((self.middle, (self.edges[-1] - self.edges[0]) / 2), y)
        return (y - middle).abs() > half

    def curvature(self, x: Tensor) -> Tensor:
        """Return the curvature of the reference line [1/m], positive where the road turns to the right."""
        return torch.zeros_like(x) if self.reference_line is None else self.reference_line.at(x).curvature

    def to_world(self, x: Tensor, y: Tensor, heading: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Transform x, y [m] and heading [rad] in the road to the flat world, any shape.

        Its X axis is the reference line's tangent at x = 0, its Y axis points to the right of it.
        """
        if self.reference_line is None:
            return x, y, heading
        return self.place(x, y, heading)[:3]

    def place(self, x: Tensor, y: Tensor, heading: Tensor) -> WorldPose:
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
        """Transform world to road coordinates: the inverse of `to_world`, up to a fifth of the road's least radius."""
        if self.reference_line is None:
            return x, y, heading
        s = self.reference_line.nearest(x, y)
        point = self.reference_line.at(s)
        across = (y - point.y) * torch.cos(point.heading) - (x - point.x) * torch.sin(point.heading)
        return s, across, heading - point.heading


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
