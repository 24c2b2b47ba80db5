"""Reference lines: gently curved lines that roads follow, as functions of the way along them."""

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.devices import can_look

MAX_CURVATURE = 0.005
"""Largest curvature [1/m], a radius of 200 m: below it the series in `ReferenceLine` are good to 1e-4 m a metre."""
MAX_TURN = 0.5
"""Most that a curve may turn away from its start [rad], so that `ReferenceLine.nearest` finds its way."""
_CELL = 10.0
"""Longest cell of the table [m]."""
_NEWTON_STEPS = 4
"""They converge quadratically: within a fifth of the least radius the fourth is below rounding."""


class LinePoint(NamedTuple):
    """Points of a reference line, all of one shape."""

    x: Tensor
    """Along the tangent at the start of the curve [m]."""
    y: Tensor
    """To the right of it [m]."""
    heading: Tensor
    """Relative to it [rad], positive to the right."""
    curvature: Tensor
    """Change of the heading per metre [1/m], positive where the curve turns to the right."""


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

    def at(self, s: Tensor) -> LinePoint:
        """Return the points of the line.

        Args:
            s: Way along the curve [m], any shape; negative before its start.

        Returns:
            The points, of the same shape, differentiable in s.
        """
        (x0, x1, x2, x3, y0, y1, y2, y3, heading, curvature, slope), ds = self._cell(s)
        return LinePoint(
            torch.addcmul(x0, ds, torch.addcmul(x1, ds, torch.addcmul(x2, ds, x3))),
            torch.addcmul(y0, ds, torch.addcmul(y1, ds, torch.addcmul(y2, ds, y3))),
            torch.addcmul(heading, ds, torch.addcmul(curvature, ds, slope, value=0.5)),
            torch.addcmul(curvature, ds, slope),
        )

    def curvature_at(self, s: Tensor) -> Tensor:
        """Return the curvature alone [1/m]."""
        (*_, curvature, slope), ds = self._cell(s)
        return torch.addcmul(curvature, ds, slope)

    def tabulate(self, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, float]:
        """Return coefficients of the cells, the straights before and after the curve included, (cells, 11).

        A point is x0 + x1 s + x2 s^2 + x3 s^3 along the tangent at the start and likewise across it (four columns
        each), its heading h + k s + c s^2 / 2 and its curvature k + c s (the last three columns), with s the way since
        the start of the cell; and the length of a cell [m].
        """
        return _table(self, dtype, device)

    def nearest(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the way s along the line of the point nearest to (x, y), by Newton's method.

        Args:
            x: Along the tangent at the start [m], any shape; the other tensor has the same.
            y: To the right of it [m], within a fifth of the least radius of the curve.

        Returns:
            s [m], of the same shape, differentiable once.
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


class LineCell(NamedTuple):
    """A cell of a reference line.

    From its start it goes s + `cubic_u` s^3 along its heading, and `square_w` s^2 + `cubic_w` s^3 to the right of it.
    """

    length: float
    """[m]."""
    x: float
    """Start, along the tangent at the start of the curve [m]."""
    y: float
    """Start, to the right of it [m]."""
    heading: float
    """At the start, relative to it [rad], positive to the right."""
    cubic_u: float
    square_w: float
    cubic_w: float


def list_cells(curve: ReferenceLine) -> list[LineCell]:
    """Return the cells of a line between its first and its last knot, in order.

    Example:
        >>> cells = list_cells(ReferenceLine(spacing=50.0, curvature=(0.0, 0.002, 0.0)))
        >>> len(cells), cells[1].length, round(cells[1].heading, 4)
        (10, 10.0, 0.002)
    """
    table, step = _table(curve, torch.float64, torch.device("cpu"))
    rows = table[1:-1].tolist()  # without the straights before and after the curve
    return [
        LineCell(step, x, y, h, cubic_u=-(k**2) / 6, square_w=k / 2, cubic_w=c / 6)
        for x, _, _, _, y, _, _, _, h, k, c in rows
    ]


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
    """Return coefficients, shape (cells, 11), and the length of a cell [m].

    With heading h, curvature k and its slope c at the start of a cell, the curve goes u = s - k^2 s^3 / 6 along h and
    w = k s^2 / 2 + c s^3 / 6 to the right of it. Columns: coefficients of x, of y, then h, k and c. The first cell is
    the straight before the curve, the last the one after it.
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
