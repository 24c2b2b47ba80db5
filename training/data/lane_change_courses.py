"""Courses of lane changes: durations of the cubic courses that move across for as long as recorded ones.

A recording shows for how long a vehicle moves across faster than some speed; when it begins and ends to move cannot be
seen. The course of a cut-in has the duration that gives the same time.
"""

from __future__ import annotations

import numpy as np

from samplers.problem import FloatArray

LATERAL_SPEED = 0.2
"""Speed across above which a lane change has begun and is not over [m/s]."""
LATERAL_SPAN = 5
"""Number of frames over which the speed across is measured: 0.5 s."""


def course_durations(above: FloatArray, displacement: FloatArray) -> FloatArray:
    """Return the durations T of cubic courses that move across faster than `LATERAL_SPEED` for as long as recorded.

    The course y = D (3 t^2 - 2 t^3), t from 0 to 1 in T, has the speed across 6 D t (1 - t) / T, which is above v for
    T sqrt(1 - 2 v T / (3 D)). The shorter of the two T is taken; where a course never moves that long, the one that
    does so longest, T = D / v.

    Args:
        above: Time above `LATERAL_SPEED` [s], shape (n,).
        displacement: D [m], shape (n,).

    Returns:
        T [s], shape (n,); NaN where the time is not known or the vehicle did not move to its new side.

    Example:
        >>> course_durations(np.array([3.64, 3.0, np.nan]), np.array([3.1, -0.4, 3.1])).round(2).tolist()
        [4.0, nan, nan]
    """
    known = np.isfinite(above) & (displacement > 0.0)
    time, side = np.where(known, above, 0.0), np.where(known, displacement, 1.0)
    low, high = np.zeros_like(time), side / LATERAL_SPEED
    for _ in range(60):
        middle = 0.5 * (low + high)
        short = middle * np.sqrt(np.maximum(1.0 - 2.0 * LATERAL_SPEED * middle / (3.0 * side), 0.0)) < time
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.where(known, low, np.nan)


def time_around_peak(speed: FloatArray, time: FloatArray) -> float:
    """Return how long the speed is above `LATERAL_SPEED` around its largest value [s].

    Example:
        >>> time_around_peak(np.array([0.3, 0.1, 0.5, 0.9, 0.4, 0.1]), 0.1 * np.arange(6.0)).__round__(2)
        0.3
    """
    slow = np.flatnonzero(speed <= LATERAL_SPEED)
    peak = int(np.argmax(speed))
    first = slow[slow < peak].max(initial=-1) + 1
    behind = slow[slow > peak].min(initial=len(speed))
    return float((behind - first) * np.median(np.diff(time)))


def time_between_spans(start: FloatArray, end: FloatArray, dt: float) -> FloatArray:
    """Return the time above `LATERAL_SPEED` of changes that are found by their mean speed over `LATERAL_SPAN` frames.

    The last slow span before a change ends at its start, the first slow one after it begins at its end. The speed falls
    to that of a span in its middle, half a frame nearer to the change in the mean.

    Args:
        start: Frames of the starts, shape (n,).
        end: Frames of the ends, shape (n,).
        dt: Time between frames [s].
    """
    return (end - start + LATERAL_SPAN - 1) * dt
