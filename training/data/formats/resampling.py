"""Tracks of other frame rates, brought to the ticks of a trajectory table."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from samplers.problem import FloatArray
from training.data.trajectories import DT

LARGEST_STEP = 1.5
"""Frames between two rows of a vehicle from which on its track is cut: between 1 (no hole) and 2 (one is missing)."""
ROUNDING = 1e-6
"""Tolerance [ticks] within which the end of a track counts as a multiple of `DT`: more than times are rounded by."""


class ResampledTracks(NamedTuple):
    """Rows at multiples of `DT`."""

    vehicle: FloatArray
    """Number of the vehicle, shape (rows,)."""
    frame: FloatArray
    """Time in units of `DT`, shape (rows,)."""
    splined: FloatArray
    """Columns interpolated by cubic splines, shape (rows, a)."""
    linear: FloatArray
    """Columns interpolated linearly, shape (rows, b)."""
    nearest: NDArray[np.intp]
    """Row of the original that is nearest in time, shape (rows,)."""


def resample_tracks(
    vehicle: FloatArray, time: FloatArray, dt: float, splined: FloatArray, linear: FloatArray
) -> ResampledTracks:
    """Return tracks at multiples of `DT`, cut at their holes.

    Args:
        vehicle: Number of the vehicle, shape (n,).
        time: Time of each row [s], shape (n,).
        dt: Time between the frames of the file [s].
        splined: Columns to interpolate by cubic splines, such as positions, shape (n, a).
        linear: Columns to interpolate linearly, shape (n, b).
    """
    order = np.lexsort([time, vehicle])
    cuts = 1 + np.flatnonzero((np.diff(vehicle[order]) != 0) | (np.diff(time[order]) > LARGEST_STEP * dt))
    parts: list[ResampledTracks] = []
    for piece in np.split(order, cuts):
        t = time[piece]
        frame = np.arange(np.ceil(t[0] / DT - ROUNDING), np.floor(t[-1] / DT + ROUNDING) + 1.0)
        at = np.clip(frame * DT, t[0], t[-1])
        smooth = CubicSpline(t, splined[piece])(at) if len(t) > 3 else splined[piece][np.searchsorted(t, at)]
        straight = np.column_stack([np.interp(at, t, column) for column in linear[piece].T])
        nearest = piece[np.minimum(np.rint((at - t[0]) / dt).astype(np.int64), len(t) - 1)]
        parts.append(ResampledTracks(np.full(len(frame), vehicle[piece[0]]), frame, smooth, straight, nearest))
    return ResampledTracks(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
