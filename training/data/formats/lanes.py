"""Lanes across the road: the lane of a position, and boundaries where none were recorded."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray

LANE_SPACINGS = (2.5, 5.0)
"""Least and greatest distance [m] between the centres of neighbouring lanes: US freeways have lanes of 3.0 to 3.7 m."""


def lanes_of(y: FloatArray, edges: tuple[float, ...]) -> NDArray[np.int64]:
    """Return the lane of each position, 1 the leftmost, 0 outside.

    Args:
        y: Position across the road [m], shape (n,).
        edges: Lane boundaries from left to right [m].
    """
    lane = np.searchsorted(np.array(edges), y, side="right")
    return np.where(lane < len(edges), lane, 0)


def estimate_lane_edges(y: FloatArray, lane: NDArray[np.int64]) -> tuple[float, ...]:
    """Return lane boundaries halfway between the median positions of neighbouring lanes.

    The outer lanes get the width of the space to their neighbours. Lanes are counted from 1 as long as each lies 2.5 to
    5 m to the right of the one before it; ramps, which lie beside each other, do not.

    Args:
        y: Position across the road [m], shape (rows,).
        lane: Number of the lane, 1 the leftmost, shape (rows,).

    Returns:
        Boundaries [m], left to right; none if fewer than two lanes are found.
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
