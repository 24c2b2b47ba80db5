"""Axis and lanes of a road, found from the paths of vehicles: distances along and across it, lanes and boundaries."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from samplers.problem import FloatArray

BIN = 10.0
"""Length of road [m] over which the positions of a lane are averaged."""
KNOT_DISTANCE = 100.0
"""Distance [m] between the knots of the axis: shorter than curves of motorways, longer than a lane change."""
ROUGHNESS = 1e-4
"""Weight of the squared third differences of the coefficients, relative to the mean number of bins in a knot span: it
settles the axis if nobody was recorded, and hardly moves it elsewhere."""
FOOT_STEPS = 4
"""Steps towards the foot of the perpendicular; each leaves the square of the error."""
SLOPE_STEPS = 4
"""Fits of the axis, each with the slopes of the one before."""
TABLE_STEP = 1.0
"""Distance [m] between the points at which the length of the axis is tabulated."""
LANE_SPACINGS = (2.5, 5.0)
"""Least and greatest distance [m] between the centres of neighbouring lanes: US freeways have lanes of 3.0 to 3.7 m."""


Projection = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From x and y (n,) to distances along a curve in the plane and across it, positive to the right [m], (n,) each."""


def fit_road_axis(x: FloatArray, y: FloatArray, lane: NDArray[np.int64], heading: FloatArray) -> Projection:
    """Return the projection on a road's axis, by positions [m] and lanes (n,) and a rough direction of travel (2,).

    The axis is w = curve(u) in a frame turned so that u follows the road. The frame is right-handed to (x, y): with y
    downwards, as in pictures, w is to the right of u. A cubic spline (penalised as in Eilers and Marx, "Flexible
    smoothing with B-splines and penalties", 1996) is fitted to the mean positions in each lane every `BIN`, together
    with one distance for each lane. The road may turn by less than a right angle; ramps, which do not keep their
    distance, pull at the axis by their share of the traffic.
    """
    origin = x.mean(), y.mean()
    axis = np.linalg.eigh(np.cov(np.stack([x, y])))[1][:, -1]
    cos, sin = axis * (1.0 if axis @ heading >= 0.0 else -1.0)

    def turn(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        dx, dy = x - origin[0], y - origin[1]
        return dx * cos + dy * sin, dy * cos - dx * sin

    u, w = turn(x, y)
    lanes, index = np.unique(lane, return_inverse=True)  # mean u and w, and the number of rows, of each lane and `BIN`
    place = np.floor((u - u.min()) / BIN).astype(np.int64)
    cells, cell, count = np.unique(index.ravel() + len(lanes) * place, return_inverse=True, return_counts=True)
    mean_u, mean_w = (np.bincount(cell.ravel(), values) / count for values in (u, w))
    curve = _fit_spline(mean_u, mean_w, cells % len(lanes), count.astype(np.float64))
    slope, points = curve.derivative(), np.append(np.arange(u.min(), u.max(), TABLE_STEP), u.max())
    station = np.append(0.0, np.cumsum(np.hypot(np.diff(points), np.diff(curve(points)))))  # length up to the points

    def project(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        u, w = turn(x, y)
        foot = u
        for _ in range(FOOT_STEPS):
            rise = slope(foot)
            foot = foot + ((u - foot) + rise * (w - curve(foot))) / (1.0 + rise**2)
        rise = slope(foot)
        across = ((w - curve(foot)) - rise * (u - foot)) / np.sqrt(1.0 + rise**2)
        ends = (foot - np.clip(foot, points[0], points[-1])) * np.sqrt(1.0 + rise**2)
        return np.interp(foot, points, station) + ends, across

    return project


def _fit_spline(u: FloatArray, w: FloatArray, lane: NDArray[np.int64], weight: FloatArray) -> BSpline:
    """Return the cubic spline that w follows at a constant distance for each lane."""
    spans = max(int(np.ceil(np.ptp(u) / KNOT_DISTANCE)), 1)
    width = max(np.ptp(u) / spans, BIN)
    knots = u.min() + width * np.arange(-3, spans + 4)
    inside = np.clip(u, knots[3], knots[-4] - 1e-9 * width)
    basis = BSpline.design_matrix(inside, knots, 3).toarray()
    lanes = np.eye(int(lane.max()) + 1)[lane]
    weight = weight / weight.mean()
    bends = np.diff(np.eye(basis.shape[1]), n=3, axis=0)
    penalty = ROUGHNESS * len(u) / spans * bends.T @ bends
    share = weight @ lanes / weight.sum()
    centred = len(u) * np.outer(share, share)  # the mean distance is 0: it would be as free as the curve's level
    curve = BSpline(knots, np.zeros(basis.shape[1]), 3, extrapolate=True)
    for _ in range(SLOPE_STEPS):
        # a lane at the distance d of the axis has w = curve + d sqrt(1 + slope^2)
        matrix = np.hstack([basis, lanes * np.sqrt(1.0 + curve.derivative()(inside) ** 2)[:, None]])
        normal = matrix.T @ (weight[:, None] * matrix)
        normal[: basis.shape[1], : basis.shape[1]] += penalty
        normal[basis.shape[1] :, basis.shape[1] :] += centred
        solution = np.linalg.lstsq(normal, matrix.T @ (weight * w), rcond=None)[0]
        curve = BSpline(knots, solution[: basis.shape[1]], 3, extrapolate=True)
    return curve


def lanes_of(y: FloatArray, edges: tuple[float, ...]) -> NDArray[np.int64]:
    """Return the lane of each position across (n,) [m] by boundaries left to right: 1 the leftmost, 0 outside."""
    lane = np.searchsorted(np.array(edges), y, side="right")
    return np.where(lane < len(edges), lane, 0)


def estimate_lane_edges(y: FloatArray, lane: NDArray[np.int64]) -> tuple[float, ...]:
    """Return lane boundaries [m], left to right, halfway between the median positions of neighbouring lanes (rows,).

    Lanes count from 1 as long as each lies in `LANE_SPACINGS` to the right of the one before it; ramps do not. The
    outer ones get the width of the space to their neighbours; of fewer than two there are none.
    """
    centres: list[float] = []
    for number in range(1, int(lane.max()) + 1):
        centre = float(np.median(y[lane == number])) if (lane == number).any() else np.nan
        if not np.isfinite(centre) or (centres and not LANE_SPACINGS[0] <= centre - centres[-1] <= LANE_SPACINGS[1]):
            break
        centres.append(centre)
    if len(centres) < 2:
        return ()
    middle = [0.5 * (left + right) for left, right in pairwise(centres)]
    first = centres[0] - 0.5 * (centres[1] - centres[0])
    last = centres[-1] + 0.5 * (centres[-1] - centres[-2])
    return (first, *middle, last)


def number_lanes(y: FloatArray, lane: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return lanes (rows,) counted from the left by their median positions [m]; 0 if of the rarer sign, or 0."""
    inside = lane * (1 if (lane > 0).sum() >= (lane < 0).sum() else -1) > 0
    result = np.zeros(len(lane), dtype=np.int64)
    numbers = np.unique(lane[inside])
    medians = [np.median(y[lane == number]) for number in numbers]
    for place, number in enumerate(numbers[np.argsort(medians)], start=1):
        result[lane == number] = place
    return result
