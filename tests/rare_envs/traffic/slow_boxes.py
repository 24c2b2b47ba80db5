"""Boxes the slow way, one pair at a time in NumPy: what the batched geometry is checked against."""

import itertools

import numpy as np
from highway_env.utils import are_polygons_intersecting
from numpy.typing import NDArray

from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

Array = NDArray[np.float64]


def corners(x: float, y: float, heading: float) -> Array:
    """Corners in order, shape (4, 2)."""
    half = np.array([VEHICLE_LENGTH, VEHICLE_WIDTH]) / 2
    local = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    return local @ turn.T + (x, y)


def overlap(one: Array, other: Array) -> bool:
    """By HighwayEnv's test of polygons."""
    still = np.zeros(2)
    closed = [np.vstack((each, each[:1])) for each in (one, other)]
    return bool(are_polygons_intersecting(*closed, still, still)[0])


def nearest(one: Array, other: Array) -> tuple[float, Array]:
    """Distance of two polygons that are apart, and the way from one to the other: over all corners and all sides."""
    best, way = np.inf, np.zeros(2)
    for (points, sides), sign in (((one, other), 1.0), ((other, one), -1.0)):
        for point, (a, b) in itertools.product(points, zip(sides, np.roll(sides, -1, axis=0), strict=True)):
            along = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
            step = a + along * (b - a) - point
            if np.hypot(*step) < best:
                best, way = float(np.hypot(*step)), sign * step
    return best, way
