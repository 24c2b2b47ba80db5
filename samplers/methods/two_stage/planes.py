"""Linear model of f: the hyperplane near which f changes sign, from robust regression around one failure region.

The hyperplane is only the source of a proposal. Whether f is linear there decides how good the proposal is, not
whether the estimate is right.

References:
    Allen, "The relationship between variable selection and data augmentation and a method for prediction",
    Technometrics 16, 1974 (leave-one-out residuals from one fit).
    Rousseeuw and Leroy, "Robust regression and outlier detection", 1987 (inliers within a multiple of the MAD).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from samplers.components import HalfSpaceNormal, MixtureComponent, SubspaceGaussian
from samplers.methods.two_stage.settings import EDGES, LINEAR_MODEL
from samplers.problem import LOG_TWO_PI, FloatArray

LAD_MIN_DEVIATION = 1e-12
"""Added to each deviation before it divides: all of them are 0 where f is linear."""
INLIER_ROUNDING = 1e-9
"""Share of the range of f up to which a deviation is rounding."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
LARGEST_OUTCOME = 1e300
"""An f of -inf arrives as the lowest number, about -1.8e308."""
MIN_GAUSSIAN_VARIANCE = 0.01
"""Rounding may leave next to nothing of 1 + beta m - m^2 far out, where it is about 1 / beta^2."""


class Hyperplane(NamedTuple):
    """A hyperplane fitted to f: f = level - steepness (axis . u - at)."""

    axis: FloatArray
    """Unit direction in which f falls, shape (d,); zeros if there is none."""
    steepness: float
    """By how much f falls along the axis, per standard deviation."""
    at: float
    """Mean of the points along the axis."""
    level: float
    """Mean of f."""
    r2: float
    """Leave-one-out R^2 among the points that agree with it."""
    share: float
    """Share of the points that agree."""
    spread: float
    """Standard deviation of f among them."""

    @property
    def explained(self) -> float:
        """R^2 times the share of the points that agree."""
        return self.r2 * self.share

    def locates_boundary(self) -> bool:
        """Return whether it also locates the failure boundary."""
        return self.r2 > LINEAR_MODEL.boundary_r2 and self.share > LINEAR_MODEL.agreeing_share

    def crossing(self, gamma: float, errors: float) -> float:
        """Return where along the axis f falls to gamma, less some standard errors of a prediction of that.

        A hyperplane that is turned by some degrees has failures before it all along its edge.
        """
        error = math.sqrt(max(1 - self.r2, 0.0)) * self.spread
        return self.at + (self.level - gamma - errors * error) / self.steepness


def fit_hyperplane(u: FloatArray, f: FloatArray) -> Hyperplane:
    """Return the hyperplane that f follows at points u (n, d), f (n,); axis 0 and R^2 0 where there is none.

    Infinite outcomes and the share `trimmed_share` at either end are left out.
    """
    dim = u.shape[1]
    none = Hyperplane(np.zeros(dim), 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    if finite.sum() < LINEAR_MODEL.min_points:
        return none
    low, high = np.quantile(f[finite], [LINEAR_MODEL.trimmed_share, 1 - LINEAR_MODEL.trimmed_share])
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
    return Hyperplane(axis, size * norm, at, level, r2, float(near.mean()), spread)


def descent_direction(u: FloatArray, f: FloatArray) -> tuple[FloatArray, float]:
    """Return the unit direction in which f falls, shape (d,), and how much of f it explains.

    That is R^2 (leave-one-out) times the share of the points that agree; direction 0 where there is none.

    Args:
        u: Points, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones and the share `trimmed_share` at either end are left out.
    """
    hyperplane = fit_hyperplane(u, f)
    return hyperplane.axis, hyperplane.explained


def half_space_proposals(
    failures: FloatArray, u: FloatArray, f: FloatArray, gamma: float = 0.0
) -> list[MixtureComponent]:
    """Return proposals for a failure region that a hyperplane bounds, or [] if f is not nearly linear there.

    Fits f(u) = a + b.u around the failures. With R^2 (leave-one-out, times the share of the points that agree) of at
    least `min_r2` the region is taken for {u : n.u >= beta}, n = -b / |b|: a Gaussian with the moments of N(0, 1)
    beyond beta along n (Mills' ratio m: mean m, variance 1 + beta m - m^2, times `widening`), and N(0, I) given
    n.u >= beta - `slack`.

    Args:
        failures: Failing points, shape (m, d).
        u: Points around them, failing or not, shape (n, d).
        f: Outcomes of these, shape (n,).
        gamma: Threshold of failure.
    """
    hyperplane = fit_hyperplane(u, f)
    if hyperplane.explained < LINEAR_MODEL.exact_r2:  # outside the region, f may be that of another one
        inside = f <= gamma
        alone = fit_hyperplane(u[inside], f[inside])
        better = alone.locates_boundary() and alone.explained > hyperplane.explained
        hyperplane = alone if better else hyperplane
    if hyperplane.explained < LINEAR_MODEL.min_r2 or len(failures) < LINEAR_MODEL.min_failures:
        return []
    beta = _find_boundary(hyperplane, failures @ hyperplane.axis, gamma)
    if beta < EDGES.min_distance:
        return []
    mean = math.exp(-0.5 * (beta * beta + LOG_TWO_PI) - float(log_ndtr(-beta)))
    variance = max(1 + beta * mean - mean * mean, MIN_GAUSSIAN_VARIANCE)
    gaussian = SubspaceGaussian(
        hyperplane.axis[:, None], np.array([mean]), np.array([LINEAR_MODEL.widening * variance])
    )
    return [gaussian, HalfSpaceNormal(hyperplane.axis, beta - EDGES.slack)]


def _find_boundary(hyperplane: Hyperplane, along: FloatArray, gamma: float) -> float:
    """Return where along its axis a half-space of failures begins, given how far the failures are along it, (m,).

    0 where the failures are around the origin.
    """
    middle = float(np.median(along))
    if middle < EDGES.min_distance:
        return 0.0
    if hyperplane.locates_boundary():
        return hyperplane.crossing(gamma, LINEAR_MODEL.crossing_errors)
    along = along[along > LINEAR_MODEL.same_region_share * middle]
    return failure_edge(along, np.ones(len(along)), len(np.unique(along)), LINEAR_MODEL.nearest_share)


def failure_edge(along: FloatArray, weights: FloatArray, ess: float, share: float) -> float:
    """Return where weighted failures begin, given how far along a direction they lie, shape (n,).

    Their quantile at `share`, less `mean_excesses` times the mean excess over it, divided by how many they are worth:
    the least of a few lies beyond the edge of many. (Failures before the start of a proposal with an edge are the
    heavy draws that no estimate of its error knows of.)

    Args:
        along: Distances along the direction, shape (n,).
        weights: Importance weights, of any scale, shape (n,).
        ess: How many independent failures they are worth.
        share: Share of the weights that may lie before the quantile.
    """
    first = weighted_quantile(along, weights, share)
    excess = max(float(np.average(along, weights=weights)) - first, 0.0)
    return first - EDGES.mean_excesses * excess / max(ess, EDGES.min_ess)


def weighted_quantile(x: FloatArray, weights: FloatArray, share: float) -> float:
    """Return the smallest x (n,) up to which at least this share of the weights (n,) lies."""
    order = np.argsort(x)
    total = np.cumsum(weights[order])
    return float(x[order][min(int(np.searchsorted(total, share * total[-1])), len(x) - 1)])


def median(x: FloatArray) -> float:
    """Return the median of x (n,), n > 0 and without NaN: for short arrays several times as fast as `np.median`."""
    middle = len(x) // 2
    ordered = np.partition(x, (middle - 1, middle) if len(x) % 2 == 0 else middle)
    return float(ordered[middle] if len(x) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle]))


def _fit_ridge(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """Return the slope (d,) of the ridge regression of y (n,) on x (n, d), and its leave-one-out R^2.

    Of the `ridges`, where points are enough for both, the one with the larger R^2: a large ridge turns and lifts a
    hyperplane that fits exactly.
    """
    n, dim = x.shape
    xc, yc = x - x.mean(axis=0), y - y.mean()
    total = float(yc @ yc)
    if total <= 0 or n < LINEAR_MODEL.min_points:
        return np.zeros(dim), 0.0
    ridges = LINEAR_MODEL.ridges if _has_many_points(n, dim) else LINEAR_MODEL.ridges[:1]
    return max(
        (_solve_ridge(xc, yc, total, ridge, LINEAR_MODEL.min_left_out) for ridge in ridges), key=lambda fit: fit[1]
    )


def _has_many_points(n: int, dim: int) -> bool:
    """Return whether n points in d dimensions are enough to judge the small ridge and outliers."""
    return n >= LINEAR_MODEL.min_points_per_dim * dim + LINEAR_MODEL.min_points


def _solve_ridge(
    xc: FloatArray, yc: FloatArray, total: float, ridge: float, min_left_out: float
) -> tuple[FloatArray, float]:
    """Return slope and leave-one-out R^2 for centred x (n, d), y (n,) with sum of squares `total` (Allen 1974)."""
    n, dim = xc.shape
    if n >= dim:
        hat = xc @ np.linalg.inv(xc.T @ xc + ridge * np.eye(dim))
        slope, leverage = hat.T @ yc, np.einsum("ij,ij->i", hat, xc)
    else:
        inverse = np.linalg.inv(xc @ xc.T + ridge * np.eye(n))
        slope, leverage = xc.T @ (inverse @ yc), 1 - ridge * np.diag(inverse)
    left_out = (yc - xc @ slope) / np.maximum(1 - leverage - 1 / n, min_left_out)
    return slope, 1 - float(left_out @ left_out) / total


def _fit_robust(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float, NDArray[np.bool_]]:
    """Return slope and R^2 as `_fit_ridge` does, without the few points of another region, and the points used (n,).

    Least absolute deviations by reweighting find the points that agree; `_fit_ridge` is fitted to these.
    """
    n, dim = x.shape
    slope, r2 = _fit_ridge(x, y)
    everything = np.ones(n, dtype=bool)
    if r2 > LINEAR_MODEL.exact_r2 or not _has_many_points(n, dim):
        return slope, r2, everything
    near = _find_inliers(x, y)
    robust, robust_r2 = _fit_ridge(x[near], y[near])
    share = float(near.mean())
    better = robust_r2 * share > r2 or (robust_r2 > LINEAR_MODEL.exact_r2 and share > LINEAR_MODEL.agreeing_share)
    return (robust, robust_r2, near) if better else (slope, r2, everything)


def _find_inliers(x: FloatArray, y: FloatArray) -> NDArray[np.bool_]:
    """Return which points (n,) lie on the hyperplane of least absolute (leave-one-out) deviations."""
    n, dim = x.shape
    design = np.column_stack([x, np.ones(n)])
    penalty = np.diag(np.append(np.full(dim, LINEAR_MODEL.lad_ridge), 0.0))
    w, weighted = np.ones(n), np.empty_like(design)
    for _ in range(LINEAR_MODEL.lad_iterations):
        np.multiply(design, w[:, None], out=weighted)
        inverse = np.linalg.inv(weighted.T @ design + penalty)
        leverage = np.einsum("ij,ij->i", weighted @ inverse, design)
        residual = np.abs(y - design @ (inverse @ (weighted.T @ y)))
        deviation = residual / np.maximum(1 - leverage, LINEAR_MODEL.min_left_out_lad)
        typical = median(deviation)
        w = 1 / (deviation + LINEAR_MODEL.lad_smoothing * typical + LAD_MIN_DEVIATION)
        w *= n / w.sum()
    limit = LINEAR_MODEL.inlier_sigmas * MAD_TO_SIGMA * typical
    return np.asarray(deviation <= limit + INLIER_ROUNDING * np.ptp(y))
