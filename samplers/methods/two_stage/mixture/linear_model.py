"""Planes near which f changes sign: from linear regression of f around one region of failure.

A plane is only ever the source of a proposal; whether f is linear there decides how good it is, not whether the
estimate is right.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from samplers.problem import LOG_TWO_PI, FloatArray
from samplers.proposals.components import HalfSpaceNormal, MixtureComponent, SubspaceGaussian

RIDGES = (1.0, 1e-3)
LAD_ITERATIONS = 12
EXACT = 0.999
"""Where a plane explains as much of f as this, f is linear."""
LINEAR = 0.95
"""Where it explains as much as this, it also tells of points nearby."""
LEAST_R2 = 0.3
"""A plane that explains less of f is no help."""
AGREEING = 0.6
"""Share of the points that must lie on a plane for it to be more than chance."""
NEAREST = 0.03
"""Share of the failures that may lie before a plane's proposals start."""


class Plane(NamedTuple):
    """A plane fitted to f: f = level - steepness (axis . u - at)."""

    axis: FloatArray
    """Unit direction in which f falls, shape (d,); zeros if there is none."""
    steepness: float
    at: float
    level: float
    r2: float
    """Leave-one-out R^2 among the points that agree with it."""
    share: float
    """How many of the points do."""
    spread: float
    """Standard deviation of f among them."""

    @property
    def explained(self) -> float:
        """R^2 times the share of the points that agree."""
        return self.r2 * self.share

    @property
    def clear(self) -> bool:
        """Whether it also tells where failure begins."""
        return self.r2 > LINEAR and self.share > AGREEING

    def crossing(self, gamma: float) -> float:
        """Return where along the axis f falls to gamma, less two standard errors of a prediction of that.

        A plane that is turned by some degrees has failures before it all along its edge.
        """
        error = math.sqrt(max(1 - self.r2, 0.0)) * self.spread
        return self.at + (self.level - gamma - 2 * error) / self.steepness


def fit_plane(u: FloatArray, f: FloatArray) -> Plane:
    """Return the plane that f follows at points u (n, d), f (n,); infinite f and the outer 2 % are left out."""
    dim = u.shape[1]
    none = Plane(np.zeros(dim), 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    finite = np.isfinite(f) & (np.abs(f) < 1e300)  # an f of -inf arrives as the lowest number
    if finite.sum() < 5:
        return none
    low, high = np.quantile(f[finite], [0.02, 0.98])
    usual = finite & (f >= low) & (f <= high)
    size = float(np.abs(f[usual]).max()) if usual.any() else 0.0
    if size == 0.0:
        return none
    x, y = u[usual], f[usual] / size
    slope, r2, near = _fit_robust(x, y)
    norm = float(np.linalg.norm(slope))
    if norm == 0:
        return none
    axis, x, y = -slope / norm, x[near], y[near]
    at, level, spread = float((x @ axis).mean()), size * float(y.mean()), size * float(y.std())
    return Plane(axis, size * norm, at, level, r2, float(near.mean()), spread)


def descent_direction(u: FloatArray, f: FloatArray) -> tuple[FloatArray, float]:
    """Return the unit direction in which f falls, shape (d,), and the R^2 of the plane (leave-one-out).

    Args:
        u: Points, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones and the outer 2 % on both sides are left out.
    """
    plane = fit_plane(u, f)
    return plane.axis, plane.explained


def half_space_proposals(
    points: FloatArray, u: FloatArray, f: FloatArray, gamma: float = 0.0
) -> list[MixtureComponent]:
    """Return proposals beyond the plane of f around some failures, or none if no plane explains f.

    Args:
        points: Failing points, shape (m, d).
        u: Points around them, failing or not, shape (n, d).
        f: Outcomes of these, shape (n,).
        gamma: Threshold of failure.
    """
    plane = fit_plane(u, f)
    if plane.explained < EXACT:  # outside the region, f may be that of another one
        inside = f <= gamma
        alone = fit_plane(u[inside], f[inside])
        plane = alone if alone.clear and alone.explained > plane.explained else plane
    if plane.explained < LEAST_R2 or len(points) < 8:
        return []
    axis = plane.axis
    along = points @ axis
    middle = float(np.median(along))
    if middle < 0.5:
        return []
    along = along[along > 0.5 * middle]  # the others are another region's
    if plane.clear:
        start = plane.crossing(gamma)
    else:
        start = failure_edge(along, np.ones(len(along)), len(np.unique(along)), NEAREST)
    if start < 0.5:
        return []
    # Mean and variance of N(0, 1) beyond start: Mills' ratio.
    mean = math.exp(-0.5 * (start * start + LOG_TWO_PI) - float(log_ndtr(-start)))
    variance = max(1 + start * mean - mean * mean, 0.01)
    return [
        SubspaceGaussian(axis[:, None], np.array([mean]), np.array([1.3 * variance])),
        HalfSpaceNormal(axis, start - 0.02),
    ]


def failure_edge(along: FloatArray, weights: FloatArray, ess: float, share: float) -> float:
    """Return where weighted failures begin, given how far along a direction they lie, shape (n,).

    Their quantile at `share`, less what the least of a few lies beyond the edge of many: twice the mean excess over
    it divided by how many they are worth. Failures before the start of a proposal with an edge are the heavy draws
    that no estimate of its error knows of.
    """
    first = weighted_quantile(along, weights, share)
    return first - 2 * max(float(np.average(along, weights=weights)) - first, 0.0) / max(ess, 2.0)


def weighted_quantile(x: FloatArray, weights: FloatArray, share: float) -> float:
    """Return the smallest x (n,) up to which at least this share of the weights (n,) lies."""
    order = np.argsort(x)
    total = np.cumsum(weights[order])
    return float(x[order][min(int(np.searchsorted(total, share * total[-1])), len(x) - 1)])


def _fit_ridge(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """Return the slope (d,) of the ridge regression of y (n,) on x (n, d), and its leave-one-out R^2.

    Of the ridges, where points are enough for both, the one that leaves the larger R^2: a high one turns and lifts a
    plane that fits exactly.
    """
    n, dim = x.shape
    xc, yc = x - x.mean(axis=0), y - y.mean()
    total = float(yc @ yc)
    if total <= 0 or n < 5:
        return np.zeros(dim), 0.0
    found = [_solve_ridge(xc, yc, total, ridge) for ridge in (RIDGES if n >= 1.2 * dim + 5 else RIDGES[:1])]
    return max(found, key=lambda one: one[1])


def _solve_ridge(xc: FloatArray, yc: FloatArray, total: float, ridge: float) -> tuple[FloatArray, float]:
    n, dim = xc.shape
    if n >= dim:
        hat = xc @ np.linalg.inv(xc.T @ xc + ridge * np.eye(dim))
        slope, leverage = hat.T @ yc, np.einsum("ij,ij->i", hat, xc)
    else:
        inverse = np.linalg.inv(xc @ xc.T + ridge * np.eye(n))
        slope, leverage = xc.T @ (inverse @ yc), 1 - ridge * np.diag(inverse)
    left_out = (yc - xc @ slope) / np.maximum(1 - leverage - 1 / n, 1e-3)
    return slope, 1 - float(left_out @ left_out) / total


def _fit_robust(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float, NDArray[np.bool_]]:
    """As `_fit_ridge`, unmoved by the few points that belong to another region, and which points (n,) are not these.

    Least absolute deviations by reweighting, then `_fit_ridge` of the points that agree with it.
    """
    n, dim = x.shape
    slope, r2 = _fit_ridge(x, y)
    everything = np.ones(n, dtype=bool)
    if r2 > EXACT or n < 1.2 * dim + 5:
        return slope, r2, everything
    near = _find_inliers(x, y)
    robust, robust_r2 = _fit_ridge(x[near], y[near])
    share = float(near.mean())
    better = robust_r2 * share > r2 or (robust_r2 > EXACT and share > AGREEING)
    return (robust, robust_r2, near) if better else (slope, r2, everything)


def _find_inliers(x: FloatArray, y: FloatArray) -> NDArray[np.bool_]:
    """Return which points (n,) lie on the plane of least absolute (leave-one-out) deviations."""
    n, dim = x.shape
    design = np.column_stack([x, np.ones(n)])
    penalty = np.diag(np.append(np.full(dim, 1e-3), 0.0))
    w = np.ones(n)
    for _ in range(LAD_ITERATIONS):
        weighted = design * w[:, None]
        inverse = np.linalg.inv(weighted.T @ design + penalty)
        leverage = np.einsum("ij,ij->i", weighted @ inverse, design)
        deviation = np.abs(y - design @ (inverse @ (weighted.T @ y))) / np.maximum(1 - leverage, 1e-2)
        typical = float(np.median(deviation))
        w = 1 / (deviation + 1e-3 * typical + 1e-12)
        w *= n / w.sum()
    return np.asarray(deviation <= 3 * 1.4826 * typical + 1e-9 * np.ptp(y))
