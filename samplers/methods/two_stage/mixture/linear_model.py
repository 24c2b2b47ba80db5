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

from samplers.problem import LOG_TWO_PI, FloatArray
from samplers.proposals.components import HalfSpaceNormal, MixtureComponent, SubspaceGaussian

RIDGES = (1.0, 1e-3)
"""Ridge penalties; the smaller one is tried where points are enough for ordinary regression (`MIN_POINTS_PER_DIM`)."""
LAD_ITERATIONS = 12
"""Steps of iteratively reweighted least squares towards least absolute deviations."""
LAD_RIDGE = 1e-3
"""Ridge penalty of these steps, the smaller one of RIDGES: it keeps the matrix regular."""
LAD_SMOOTHING = 1e-3
"""Share of the median deviation that is added to each before it divides: exact points have no infinite weight."""
LAD_MIN_DEVIATION = 1e-12
"""Added to each deviation as well: all of them are 0 where f is linear."""
INLIER_ROUNDING = 1e-9
"""Share of the range of f up to which a deviation is rounding."""
MIN_LEFT_OUT = 1e-3
"""Least 1 - leverage that a residual is divided by: a point that alone decides on a slope has leverage 1."""
MIN_LEFT_OUT_LAD = 1e-2
"""The same in the steps towards least absolute deviations, where one such point must not hold all the weight."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
INLIER_SIGMAS = 3.0
"""Deviation up to which a point agrees with a hyperplane (Rousseeuw and Leroy use 2.5)."""
MIN_REGRESSION_POINTS = 5
"""Points that a regression needs."""
MIN_POINTS_PER_DIM = 1.2
"""With MIN_REGRESSION_POINTS + this many points per dimension the small ridge and outliers can be judged."""
TRIMMED = 0.02
"""Share of the outcomes left out at either end: f may be capped or wild there."""
LARGEST_OUTCOME = 1e300
"""An f of -inf arrives as the lowest number, about -1.8e308."""
EXACT = 0.999
"""R^2 from which f is linear."""
LINEAR = 0.95
"""R^2 from which the hyperplane locates the failure boundary."""
LEAST_R2 = 0.3
"""R^2 under which a hyperplane is no help; that of pure noise stays below (`test_noise_has_no_hyperplane`)."""
AGREEING = 0.6
"""Share of the points that must agree with a hyperplane for it to be more than chance: over half, for two regions
may have half each."""
CROSSING_ERRORS = 2.0
"""Standard errors of a prediction by which a half-space begins before the hyperplane."""
NEAREST = 0.03
"""Share of the failures that may lie before the edge, where the hyperplane does not locate it: none of 33 or fewer."""
MIN_FAILURES = 8
"""Failures that half-space proposals need: `failure_edge` takes a quarter of the mean excess off the least of eight."""
MIN_DISTANCE = 0.5
"""Nearer to the origin than this a half-space holds 31 % of N(0, I): base draws serve as well."""
SAME_REGION = 0.5
"""Failures nearer than this share of the median distance along the axis are another region's."""
WIDENING = 1.3
"""Variance of the Gaussian over that of N(0, 1) beyond the edge: too small a variance makes weights unbounded, too
large a one costs a few draws."""
MIN_GAUSSIAN_VARIANCE = 0.01
"""Rounding may leave next to nothing of 1 + beta m - m^2 far out, where it is about 1 / beta^2."""
EDGE_SLACK = 0.02
"""By how much a half-space begins before the edge, in standard deviations of N(0, I)."""
EDGE_EXCESSES = 2.0
"""Mean excesses over the quantile, divided by the number of failures, by which an edge is put back."""


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

    @property
    def clear(self) -> bool:
        """Whether it also locates the failure boundary."""
        return self.r2 > LINEAR and self.share > AGREEING

    def crossing(self, gamma: float) -> float:
        """Return where along the axis f falls to gamma, less CROSSING_ERRORS standard errors of a prediction of that.

        A hyperplane that is turned by some degrees has failures before it all along its edge.
        """
        error = math.sqrt(max(1 - self.r2, 0.0)) * self.spread
        return self.at + (self.level - gamma - CROSSING_ERRORS * error) / self.steepness


def fit_hyperplane(u: FloatArray, f: FloatArray) -> Hyperplane:
    """Return the hyperplane that f follows at points u (n, d), f (n,); axis 0 and R^2 0 where there is none.

    Infinite outcomes and the share TRIMMED at either end are left out.
    """
    dim = u.shape[1]
    none = Hyperplane(np.zeros(dim), 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    if finite.sum() < MIN_REGRESSION_POINTS:
        return none
    low, high = np.quantile(f[finite], [TRIMMED, 1 - TRIMMED])
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
        f: Their outcomes, shape (n,); infinite ones and the share TRIMMED at either end are left out.
    """
    hyperplane = fit_hyperplane(u, f)
    return hyperplane.axis, hyperplane.explained


def half_space_proposals(
    failures: FloatArray, u: FloatArray, f: FloatArray, gamma: float = 0.0
) -> list[MixtureComponent]:
    """Return proposals for a failure region that a hyperplane bounds, or [] if f is not nearly linear there.

    Fits f(u) = a + b.u around the failures. With R^2 (leave-one-out, times the share of the points that agree) of at
    least LEAST_R2 the region is taken for {u : n.u >= beta}, n = -b / |b|: a Gaussian with the moments of N(0, 1)
    beyond beta along n (Mills' ratio m: mean m, variance 1 + beta m - m^2, times WIDENING), and N(0, I) given
    n.u >= beta - EDGE_SLACK.

    Args:
        failures: Failing points, shape (m, d).
        u: Points around them, failing or not, shape (n, d).
        f: Outcomes of these, shape (n,).
        gamma: Threshold of failure.

    Example:
        f = 3 - u1: a Gaussian at E[Z | Z > 3] = 3.28, and N(0, I) given u1 >= 3 - EDGE_SLACK.

        >>> u = np.random.default_rng(0).normal([3, 0], 1, (200, 2))
        >>> gaussian, half_space = half_space_proposals(u[u[:, 0] > 3], u, 3 - u[:, 0])
        >>> gaussian.centre.round(2) + 0.0, half_space.axis.round(2) + 0.0, round(half_space.start, 2)
        (array([3.28, 0.  ]), array([1., 0.]), 2.98)
    """
    hyperplane = fit_hyperplane(u, f)
    if hyperplane.explained < EXACT:  # outside the region, f may be that of another one
        inside = f <= gamma
        alone = fit_hyperplane(u[inside], f[inside])
        hyperplane = alone if alone.clear and alone.explained > hyperplane.explained else hyperplane
    if hyperplane.explained < LEAST_R2 or len(failures) < MIN_FAILURES:
        return []
    beta = _find_boundary(hyperplane, failures @ hyperplane.axis, gamma)
    if beta < MIN_DISTANCE:
        return []
    mean = math.exp(-0.5 * (beta * beta + LOG_TWO_PI) - float(log_ndtr(-beta)))
    variance = max(1 + beta * mean - mean * mean, MIN_GAUSSIAN_VARIANCE)
    gaussian = SubspaceGaussian(hyperplane.axis[:, None], np.array([mean]), np.array([WIDENING * variance]))
    return [gaussian, HalfSpaceNormal(hyperplane.axis, beta - EDGE_SLACK)]


def _find_boundary(hyperplane: Hyperplane, along: FloatArray, gamma: float) -> float:
    """Return where along its axis a half-space of failures begins, given how far the failures are along it, (m,).

    0 where the failures are around the origin.
    """
    middle = float(np.median(along))
    if middle < MIN_DISTANCE:
        return 0.0
    if hyperplane.clear:
        return hyperplane.crossing(gamma)
    along = along[along > SAME_REGION * middle]
    return failure_edge(along, np.ones(len(along)), len(np.unique(along)), NEAREST)


def failure_edge(along: FloatArray, weights: FloatArray, ess: float, share: float) -> float:
    """Return where weighted failures begin, given how far along a direction they lie, shape (n,).

    Their quantile at `share`, less EDGE_EXCESSES times the mean excess over it, divided by how many they are worth:
    the least of a few lies beyond the edge of many. (Failures before the start of a proposal with an edge are the
    heavy draws that no estimate of its error knows of.)

    Args:
        along: Distances along the direction, shape (n,).
        weights: Importance weights, of any scale, shape (n,).
        ess: How many independent failures they are worth.
        share: Share of the weights that may lie before the quantile.
    """
    first = weighted_quantile(along, weights, share)
    return first - EDGE_EXCESSES * max(float(np.average(along, weights=weights)) - first, 0.0) / max(ess, 2.0)


def weighted_quantile(x: FloatArray, weights: FloatArray, share: float) -> float:
    """Return the smallest x (n,) up to which at least this share of the weights (n,) lies.

    Example:
        >>> weighted_quantile(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 2.0]), 0.5)
        2.0
    """
    order = np.argsort(x)
    total = np.cumsum(weights[order])
    return float(x[order][min(int(np.searchsorted(total, share * total[-1])), len(x) - 1)])


def _fit_ridge(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """Return the slope (d,) of the ridge regression of y (n,) on x (n, d), and its leave-one-out R^2.

    Of the RIDGES, where points are enough for both, the one with the larger R^2: a large ridge turns and lifts a
    hyperplane that fits exactly.
    """
    n, dim = x.shape
    xc, yc = x - x.mean(axis=0), y - y.mean()
    total = float(yc @ yc)
    if total <= 0 or n < MIN_REGRESSION_POINTS:
        return np.zeros(dim), 0.0
    ridges = RIDGES if n >= MIN_POINTS_PER_DIM * dim + MIN_REGRESSION_POINTS else RIDGES[:1]
    return max((_solve_ridge(xc, yc, total, ridge) for ridge in ridges), key=lambda fit: fit[1])


def _solve_ridge(xc: FloatArray, yc: FloatArray, total: float, ridge: float) -> tuple[FloatArray, float]:
    """Return slope and leave-one-out R^2 for centred x (n, d), y (n,) with sum of squares `total` (Allen 1974)."""
    n, dim = xc.shape
    if n >= dim:
        hat = xc @ np.linalg.inv(xc.T @ xc + ridge * np.eye(dim))
        slope, leverage = hat.T @ yc, np.einsum("ij,ij->i", hat, xc)
    else:
        inverse = np.linalg.inv(xc @ xc.T + ridge * np.eye(n))
        slope, leverage = xc.T @ (inverse @ yc), 1 - ridge * np.diag(inverse)
    left_out = (yc - xc @ slope) / np.maximum(1 - leverage - 1 / n, MIN_LEFT_OUT)
    return slope, 1 - float(left_out @ left_out) / total


def _fit_robust(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float, NDArray[np.bool_]]:
    """Return slope and R^2 as `_fit_ridge` does, without the few points of another region, and the points used (n,).

    Least absolute deviations by reweighting find the points that agree; `_fit_ridge` is fitted to these.
    """
    n, dim = x.shape
    slope, r2 = _fit_ridge(x, y)
    everything = np.ones(n, dtype=bool)
    if r2 > EXACT or n < MIN_POINTS_PER_DIM * dim + MIN_REGRESSION_POINTS:
        return slope, r2, everything
    near = _find_inliers(x, y)
    robust, robust_r2 = _fit_ridge(x[near], y[near])
    share = float(near.mean())
    better = robust_r2 * share > r2 or (robust_r2 > EXACT and share > AGREEING)
    return (robust, robust_r2, near) if better else (slope, r2, everything)


def _find_inliers(x: FloatArray, y: FloatArray) -> NDArray[np.bool_]:
    """Return which points (n,) lie on the hyperplane of least absolute (leave-one-out) deviations."""
    n, dim = x.shape
    design = np.column_stack([x, np.ones(n)])
    penalty = np.diag(np.append(np.full(dim, LAD_RIDGE), 0.0))
    w = np.ones(n)
    for _ in range(LAD_ITERATIONS):
        weighted = design * w[:, None]
        inverse = np.linalg.inv(weighted.T @ design + penalty)
        leverage = np.einsum("ij,ij->i", weighted @ inverse, design)
        deviation = np.abs(y - design @ (inverse @ (weighted.T @ y))) / np.maximum(1 - leverage, MIN_LEFT_OUT_LAD)
        typical = float(np.median(deviation))
        w = 1 / (deviation + LAD_SMOOTHING * typical + LAD_MIN_DEVIATION)
        w *= n / w.sum()
    return np.asarray(deviation <= INLIER_SIGMAS * MAD_TO_SIGMA * typical + INLIER_ROUNDING * np.ptp(y))
