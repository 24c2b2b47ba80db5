"""Points in a box as densities and maps of mixtures take them: their coordinates, and the ranges of these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import ClosingSpeed, Coordinates


class BoxPoints(NamedTuple):
    """What the density of n points depends on: m of them are in the box, moved off its faces by a float."""

    inside: NDArray[np.bool_]
    """Which they are, (n,)."""
    y: FloatArray
    """Coordinates in their order, (d, m)."""
    ranges: FloatArray
    """Lower and upper ends of the coordinates, (2, d, m), or (2, d, 1) if they are the same for all points."""
    log_jacobian: FloatArray
    """log |det dy/dx|, (m,)."""

    def take(self, some: slice | NDArray[np.bool_]) -> BoxPoints:
        """Return some of the points in the box."""
        ranges = self.ranges if self.ranges.shape[2] == 1 else self.ranges[:, :, some]
        return BoxPoints(self.inside[self.inside][some], self.y[:, some], ranges, self.log_jacobian[some])


class CoordinateRun(NamedTuple):
    """Coordinates that follow each other in the order, of which none depends on another."""

    first: int
    """How many come before."""
    columns: list[int]
    """Their columns of x."""
    signs: FloatArray
    """1 where the coordinate rises with its column, -1 where it falls, (m,)."""
    ranges: FloatArray | None
    """Their ranges, (2, m, 1); None where they depend on earlier columns."""


def describe_points(coordinates: Coordinates, x: FloatArray) -> BoxPoints:
    """Return what the density of points x (n, d), in the box or not, depends on.

    Example:
        >>> box = Coordinates([0.0, 1.0], [45.0, 100.0], ("plain", "log"))
        >>> points = describe_points(box, np.array([[20.0, 1.0], [50.0, 1.0], [30.0, 10.0]]))
        >>> points.inside.tolist(), points.y.round(3).tolist()
        ([True, False, True], [[20.0, 30.0], [0.0, 2.303]])
    """
    columns = np.ascontiguousarray(x.T)  # comparisons by rows take five times as long
    low, high = coordinates.low[:, None], coordinates.high[:, None]
    inside = np.asarray(((columns >= low) & (columns <= high)).all(axis=0))
    inner = coordinates.interior((columns if inside.all() else columns[:, inside]).T)
    y = np.array([coordinates.coordinate(j, inner) for j in coordinates.columns])
    return BoxPoints(inside, y, find_ranges(coordinates, coordinates.columns, inner), coordinates.log_jacobian(inner))


def find_ranges(coordinates: Coordinates, columns: Sequence[int], x: FloatArray) -> FloatArray:
    """Return the ranges of the coordinates of m columns, of rows x (n, d) whose earlier columns are set.

    Returns:
        Lower and upper ends, shape (2, m, n); (2, m, 1) if they are the same in all rows.

    Example:
        >>> find_ranges(Coordinates([0.0, 1.0], [45.0, 100.0], ("plain", "log")), [0, 1], np.zeros((9, 2))).shape
        (2, 2, 1)
    """
    ends = [coordinates.bounds(j, x) for j in columns]
    rows = np.broadcast_shapes(*(np.shape(low) for low, _ in ends)) or (1,)
    out = np.empty((2, len(columns), *rows))
    for place, (low, high) in enumerate(ends):
        out[0, place], out[1, place] = low, high
    return out


def split_runs(coordinates: Coordinates) -> tuple[CoordinateRun, ...]:
    """Return the coordinates in their order, in as few runs as possible.

    Example:
        >>> kinds = ("plain", ClosingSpeed("speed", "gap"), "log")
        >>> names, order = ("speed", "lead_speed", "gap"), ("speed", "gap", "lead_speed")
        >>> box = Coordinates([0.0, 0.0, 1.0], [45.0, 45.0, 150.0], kinds, names, order)
        >>> [run.columns for run in split_runs(box)]
        [[0, 2], [1]]
    """
    runs: list[list[int]] = [[]]
    for j in coordinates.columns:
        kind = coordinates.kinds[j]
        sources = (kind.behind, kind.gap) if isinstance(kind, ClosingSpeed) else ()
        if not set(runs[-1]).isdisjoint(map(coordinates.names.index, sources)):
            runs.append([])
        runs[-1].append(j)
    firsts = np.cumsum([0, *map(len, runs)]).tolist()
    return tuple(_describe_run(coordinates, first, run) for first, run in zip(firsts, runs, strict=False))


def _describe_run(coordinates: Coordinates, first: int, columns: list[int]) -> CoordinateRun:
    signs = np.array([coordinates.sign(j) for j in columns])
    fixed = not any(isinstance(coordinates.kinds[j], ClosingSpeed) for j in columns)
    nothing = np.empty((0, coordinates.dim))
    return CoordinateRun(first, columns, signs, find_ranges(coordinates, columns, nothing) if fixed else None)
