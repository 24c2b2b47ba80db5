"""Smoothing of recorded positions, the actions that reproduce the smooth track, and tracks of other frame rates.

Positions from video jitter by centimetres, which two differences at 0.1 s turn into metres per second squared. They are
smoothed before they are differentiated (Thiemann, Treiber, Kesting, "Estimating acceleration and lane-changing dynamics
from next generation simulation trajectory data", 2008), here by penalised least squares (Eilers, "A perfect smoother",
2003), which, unlike a moving average, needs no special treatment at the ends of a track.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

from samplers.problem import FloatArray
from training.data.table import DT

CUTOFF_ALONG = 0.40
"""Frequency [Hz] at which the gain along the road is one half."""
CUTOFF_ACROSS = 0.35
"""Frequency [Hz] at which the gain across the road is one half."""
MIN_HEADING_SPEED = 2.0
"""Speed [m/s] along the road below which the heading is computed as at this speed, because it would be noise."""
LARGEST_STEP = 1.5
"""Frames between two rows of a vehicle from which on its track is cut: between 1 (no hole) and 2 (one is missing)."""
ROUNDING = 1e-6
"""Tolerance [ticks] within which the end of a track counts as a multiple of `DT`: more than times are rounded by."""


def smooth_positions(positions: FloatArray, cutoff: float, dt: float) -> FloatArray:
    """Return smooth positions z near the recorded y: the minimiser of |y - z|^2 + lambda |third differences of z|^2.

    In the middle of a track this is a filter of gain 1 / (1 + lambda (2 - 2 cos(2 pi f dt))^3) without delay; lambda
    makes the gain one half (-6 dB) at the cut-off [Hz]. Parabolas pass unchanged, at the ends too. Positions (T,) [m]
    are of one coordinate of one track without holes, dt apart [s]; tracks of fewer than four steps stay as they are.
    """
    positions = np.asarray(positions, dtype=np.float64)
    if positions.ndim != 1 or not np.isfinite(positions).all():
        raise ValueError("Expected one finite coordinate per time step; cut the track where positions are missing.")
    if not 0.0 < cutoff <= 0.5 / dt:
        raise ValueError(f"Expected a cut-off in (0, {0.5 / dt:g}] Hz at steps of {dt:g} s, got {cutoff:g} Hz.")
    if len(positions) < 4:
        return positions.copy()
    smoothed: FloatArray = cho_solve_banded((_penalty_factor(len(positions), cutoff, dt), True), positions)
    return smoothed


@lru_cache(maxsize=1024)
def _penalty_factor(n: int, cutoff: float, dt: float) -> FloatArray:
    """Return the Cholesky factor of I + lambda D'D in lower banded form, D the (n - 3, n) third differences."""
    weight = (2.0 - 2.0 * np.cos(2.0 * np.pi * cutoff * dt)) ** -3
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, n))
    bands[0] = 1.0
    for i in range(4):
        for j in range(i + 1):
            bands[i - j, j : n - 3 + j] += weight * stencil[i] * stencil[j]
    factor: FloatArray = cholesky_banded(bands, lower=True)
    return factor


def infer_motion(x: FloatArray, y: FloatArray, dt: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return headings, speeds, accelerations and yaw rates that move a point mass through positions (T,) [m].

    This inverts the simulator's step (explicit Euler, old values): x += v cos(h) dt, y += v sin(h) dt, h += w dt,
    v += a dt. It is exact while the vehicle moves along the road at `MIN_HEADING_SPEED` or more. Below, the heading is
    atan2(vy, MIN_HEADING_SPEED) and the speed the part of (vx, vy) along it, so that a creeping vehicle does not spin.
    Headings are relative to the road, positive towards +y; values that the end of the track does not determine are NaN:
    of the states the last one, of the actions the last two.
    """
    vx, vy = np.diff(x) / dt, np.diff(y) / dt
    heading = np.arctan2(vy, np.maximum(vx, MIN_HEADING_SPEED))
    speed = np.maximum(vx * np.cos(heading) + vy * np.sin(heading), 0.0)

    def pad(values: FloatArray) -> FloatArray:
        return np.concatenate([values, np.full(len(x) - len(values), np.nan)])

    return pad(heading), pad(speed), pad(np.diff(speed) / dt), pad(np.diff(heading) / dt)


def resample_tracks(
    vehicle: FloatArray,
    time: FloatArray,
    dt: float,
    splined: Mapping[str, FloatArray],
    linear: Mapping[str, FloatArray],
) -> tuple[dict[str, FloatArray], NDArray[np.intp]]:
    """Return columns (rows,) of tracks at multiples of `DT`, cut at holes, and the rows nearest in time (rows,).

    Vehicle, time [s] and the columns, which are interpolated by cubic splines or linearly, have shape (n,); rows of a
    vehicle are dt apart [s]. The columns have `vehicle` and `frame`, the time in units of `DT`, beside them.
    """
    order = np.lexsort([time, vehicle])
    cuts = 1 + np.flatnonzero((np.diff(vehicle[order]) != 0) | (np.diff(time[order]) > LARGEST_STEP * dt))
    curved, parts = np.column_stack(list(splined.values())), []
    for piece in np.split(order, cuts):
        t = time[piece]
        frame = np.arange(np.ceil(t[0] / DT - ROUNDING), np.floor(t[-1] / DT + ROUNDING) + 1.0)
        at = np.clip(frame * DT, t[0], t[-1])
        smooth = CubicSpline(t, curved[piece])(at) if len(t) > 3 else curved[piece][np.searchsorted(t, at)]
        straight = [np.interp(at, t, column[piece]) for column in linear.values()]
        nearest = piece[np.minimum(np.rint((at - t[0]) / dt).astype(np.int64), len(t) - 1)]
        parts.append((np.full(len(frame), vehicle[piece[0]]), frame, *smooth.T, *straight, nearest))
    *columns, nearest = (np.concatenate(column) for column in zip(*parts, strict=True))
    return dict(zip(("vehicle", "frame", *splined, *linear), columns, strict=True)), nearest
