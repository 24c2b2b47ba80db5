"""Planes near which f changes sign: from linear regression of f around one region of failure.

A plane is only ever the source of a proposal; whether f is linear there decides how good it is, not whether the
estimate is right.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from samplers.components import Bump, Component, Slice
from samplers.problem import LOG_TWO_PI, FloatArray

RIDGE = 1.0
LAD_STEPS = 12
LEAST_R2 = 0.3
"""A plane that explains less of f is no help."""
NEAREST = 0.03
"""Share of the failures that may lie before a plane's proposals start."""


def falling(u: FloatArray, f: FloatArray) -> tuple[FloatArray, float]:
    """Return the unit direction in which f falls, shape (d,), and the R^2 of the plane (leave-one-out).

    Args:
        u: Points, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones and the outer 2 % on both sides are left out.
    """
    dim = u.shape[1]
    finite = np.isfinite(f) & (np.abs(f) < 1e300)  # an f of -inf arrives as the lowest number
    if finite.sum() < 5:
        return np.zeros(dim), 0.0
    low, high = np.quantile(f[finite], [0.02, 0.98])
    usual = finite & (f >= low) & (f <= high)
    size = float(np.abs(f[usual]).max()) if usual.any() else 0.0
    if size == 0.0:
        return np.zeros(dim), 0.0
    slope, r2 = _robust_slope(u[usual], f[usual] / size)
    norm = float(np.linalg.norm(slope))
    return (-slope / norm, r2) if norm > 0 else (slope, 0.0)


def beyond(points: FloatArray, u: FloatArray, f: FloatArray) -> list[Component]:
    """Return proposals beyond the plane of f around some failures, or none if no plane explains f.

    Args:
        points: Failing points, shape (m, d).
        u: Points around them, failing or not, shape (n, d).
        f: Outcomes of these, shape (n,).
    """
    axis, r2 = falling(u, f)
    if r2 < LEAST_R2 or len(points) < 8:
        return []
    start = float(np.quantile(points @ axis, NEAREST))
    if start < 0.5:
        return []
    # Mean and variance of N(0, 1) beyond start: Mills' ratio.
    mean = math.exp(-0.5 * (start * start + LOG_TWO_PI) - float(log_ndtr(-start)))
    variance = max(1 + start * mean - mean * mean, 0.01)
    return [Bump(axis[:, None], np.array([mean]), np.array([1.3 * variance])), Slice(axis, start - 0.02)]


def _slope(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """Return the slope (d,) of the ridge regression of y (n,) on x (n, d), and its leave-one-out R^2."""
    n, dim = x.shape
    xc, yc = x - x.mean(axis=0), y - y.mean()
    total = float(yc @ yc)
    if total <= 0 or n < 5:
        return np.zeros(dim), 0.0
    if n >= dim:
        hat = xc @ np.linalg.inv(xc.T @ xc + RIDGE * np.eye(dim))
        slope, leverage = hat.T @ yc, np.einsum("ij,ij->i", hat, xc)
    else:
        inverse = np.linalg.inv(xc @ xc.T + RIDGE * np.eye(n))
        slope, leverage = xc.T @ (inverse @ yc), 1 - RIDGE * np.diag(inverse)
    left_out = (yc - xc @ slope) / np.maximum(1 - leverage - 1 / n, 1e-3)
    return slope, 1 - float(left_out @ left_out) / total


def _robust_slope(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """As `_slope`, unmoved by the few points that belong to another region.

    Least absolute deviations by reweighting, then `_slope` of the points that agree with it; the R^2 is multiplied
    by their share.
    """
    n, dim = x.shape
    slope, r2 = _slope(x, y)
    if r2 > 0.95 or n < 1.2 * dim + 5:
        return slope, r2
    near = _in_agreement(x, y)
    robust, robust_r2 = _slope(x[near], y[near])
    share = float(near.mean())
    return (robust, robust_r2 * share) if robust_r2 * share > r2 else (slope, r2)


def _in_agreement(x: FloatArray, y: FloatArray) -> NDArray[np.bool_]:
    """Return which points (n,) lie on the plane of least absolute (leave-one-out) deviations."""
    n, dim = x.shape
    design = np.column_stack([x, np.ones(n)])
    penalty = np.diag(np.append(np.full(dim, 1e-3), 0.0))
    w = np.ones(n)
    for _ in range(LAD_STEPS):
        weighted = design * w[:, None]
        inverse = np.linalg.inv(weighted.T @ design + penalty)
        leverage = np.einsum("ij,ij->i", weighted @ inverse, design)
        deviation = np.abs(y - design @ (inverse @ (weighted.T @ y))) / np.maximum(1 - leverage, 1e-2)
        typical = float(np.median(deviation))
        w = 1 / (deviation + 1e-3 * typical + 1e-12)
        w *= n / w.sum()
    return np.asarray(deviation <= 3 * 1.4826 * typical + 1e-9 * np.ptp(y))
