"""Regression of f around a failure region: a hyperplane near which f changes sign, or several of them.

Where failure has no regions of its own but dozens of planes that pass into each other, as in the first passage of a
vibration, f is the least of several linear functions, and its failures are a union of half-spaces. A region that
several conditions bound, each of which must hold, is a corner, and f the greatest of linear functions: these are the
pieces of -f. One plane or one Gaussian describes neither.

All of these are only the source of a proposal: how well they fit f decides how good it is, not whether the estimate is
right.

References:
    Allen, "The relationship between variable selection and data augmentation and a method for prediction",
    Technometrics 16, 1974 (leave-one-out residuals from one fit).
    Rousseeuw and Leroy, "Robust regression and outlier detection", 1987 (inliers within a multiple of the MAD).
    Magnani and Boyd, "Convex piecewise-linear fitting", Optimization and Engineering 10, 2009 (there the largest).
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from samplers.components import (
    HalfSpaceIntersection,
    HalfSpaceNormal,
    HalfSpaceUnion,
    MixtureComponent,
    SubspaceGaussian,
)
from samplers.distributions import LOG_TWO_PI
from samplers.methods.two_stage.settings import CORNER, EDGES, LINEAR_MODEL, PIECES
from samplers.problem import FloatArray

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


def half_space_proposals(failures: FloatArray, u: FloatArray, f: FloatArray, gamma: float) -> list[MixtureComponent]:
    """Return proposals for a failure region that a hyperplane bounds, or [] if f is not nearly linear there.

    Fits f(u) = a + b.u to points u (n, d), f (n,) around failures (m, d). With R^2 (leave-one-out, times the share of
    the points that agree) of at least `min_r2` the region is taken for {u : n.u >= beta}, n = -b / |b|: a Gaussian with
    the moments of N(0, 1) beyond beta along n (Mills' ratio m: mean m, variance 1 + beta m - m^2, times `widening`),
    and N(0, I) given n.u >= beta - `slack`.
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
    return failure_edge(along, len(np.unique(along)))


def failure_edge(along: FloatArray, ess: float) -> float:
    """Return where failures begin, given how far along a direction they lie (n,) and how many they are worth.

    Their quantile at `nearest_share`, less `mean_excesses` times the mean excess over it, divided by how many they are
    worth: the least of a few lies beyond the edge of many. (Failures before the start of a proposal with an edge are
    the heavy draws that no estimate of its error knows of.)
    """
    first = weighted_quantile(along, np.ones(len(along)), LINEAR_MODEL.nearest_share)
    excess = max(float(along.mean()) - first, 0.0)
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
    penalty = np.diag(np.append(np.full(dim, LINEAR_MODEL.ridges[1]), 0.0))
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


LEAST_GAIN = 0.01
"""Share of the mean square of the residuals."""
NO_PIECE = -1
"""In place of the number of a piece."""


class LinearPieces(NamedTuple):
    """y(u) = min_k (intercept_k + slope_k . u)."""

    intercepts: FloatArray
    """Shape (k,)."""
    slopes: FloatArray
    """Shape (k, d)."""

    def predict(self, u: FloatArray) -> FloatArray:
        """Return each piece at u (n, d), shape (n, k)."""
        return self.intercepts + u @ self.slopes.T

    def take(self, kept: NDArray[np.int64]) -> "LinearPieces":
        """Return some of the pieces."""
        return LinearPieces(self.intercepts[kept], self.slopes[kept])


def points_of_piece(dim: int) -> int:
    """Return the points that a piece starts from."""
    return PIECES.points_per_dim * dim + PIECES.least_points


def start_pieces(u: FloatArray, y: FloatArray, centres: NDArray[np.int64]) -> LinearPieces:
    """Return the regressions of y (n,) on the points u (n, d) around each of the `centres`, rows of u."""
    distance = np.linalg.norm(u[centres, None] - u, axis=2)
    around = points_of_piece(u.shape[1])
    near = np.argpartition(distance, around - 1, axis=1)[:, :around]
    return _regress(_design(u), y, near, PIECES.first_ridge)


def fit_pieces(
    pieces: LinearPieces, u: FloatArray, y: FloatArray, inlier_sigmas: float = math.inf, patience: int | None = None
) -> LinearPieces | None:
    """Return the pieces after regressions of y (n,), each on the points u (n, d) at which it is the least one.

    They end when no point moves, or after `patience` steps without a gain, a mean square of residuals that is a
    `LEAST_GAIN` lower: where pieces do not explain y, points move to and fro. Points beyond `inlier_sigmas`
    (`assign_points`) are left out.
    """
    least, design = u.shape[1] + PIECES.least_points, _design(u)
    before, lowest, idle = None, math.inf, 0
    for _ in range(PIECES.iterations):
        own, agrees, deviation = assign_points(pieces, u, y, inlier_sigmas)
        if inlier_sigmas < math.inf:
            own, deviation = np.where(agrees, own, NO_PIECE), deviation[agrees]
        square = float(deviation @ deviation) / len(deviation)
        idle = 0 if square < (1 - LEAST_GAIN) * lowest else idle + 1
        lowest = min(lowest, square)
        if idle == patience or (before is not None and np.array_equal(own, before)):
            break
        groups = [(own == k).nonzero()[0] for k in range(len(pieces.intercepts))]
        groups = [group for group in groups if len(group) >= least]
        if not groups:
            return None
        pieces, before = _regress(design, y, groups, LINEAR_MODEL.ridges[1]), own
    return pieces


def assign_points(
    pieces: LinearPieces, u: FloatArray, y: FloatArray, inlier_sigmas: float = math.inf
) -> tuple[NDArray[np.int64], NDArray[np.bool_], FloatArray]:
    """Return the least piece at each point u (n, d), whether y (n,) agrees with it, and how far it is off, (n,) each.

    It does within so many standard deviations, these from the median absolute deviation of the piece's own points: of
    all points, those of an exact piece would rule out those of another one.
    """
    predicted = pieces.predict(u)
    own = predicted.argmin(axis=1)
    deviation, limit = np.abs(y - predicted[np.arange(len(y)), own]), np.zeros(len(pieces.intercepts))
    if math.isinf(inlier_sigmas):
        return own, np.ones(len(y), dtype=bool), deviation
    for k in range(len(limit)):
        deviations = deviation[own == k]
        if len(deviations):
            limit[k] = inlier_sigmas * MAD_TO_SIGMA * median(deviations)
    return own, deviation <= limit[own] + INLIER_ROUNDING * np.ptp(y), deviation


def piece_errors(
    own: NDArray[np.int64], residual: FloatArray, n: int, dim: int
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the points of each of n pieces and the standard deviation of their residuals (m,), shape (n,) each."""
    counts = np.bincount(own, minlength=n)
    square = np.bincount(own, weights=residual**2, minlength=n)
    return counts, np.sqrt(square / np.maximum(counts - dim - 1, 1))


def _design(u: FloatArray) -> FloatArray:
    """Return points u (n, d) with a column of ones, for the intercept, shape (n, d + 1)."""
    return np.column_stack([u, np.ones(len(u))])


def _regress(design: FloatArray, y: FloatArray, groups: Iterable[NDArray[np.int64]], ridge: float) -> LinearPieces:
    """Return the ridge regressions of y (n,) at some groups of points, one piece each; `design` is (n, d + 1)."""
    dim = design.shape[1] - 1
    chosen = [(design.take(group, axis=0), y.take(group)) for group in groups]
    normal = np.array([x.T @ x for x, _ in chosen])
    normal[:, range(dim), range(dim)] += ridge  # the intercept has no penalty
    moments = np.array([values @ x for x, values in chosen])
    coefficients = np.linalg.solve(normal, moments[:, :, None])[:, :, 0]
    return LinearPieces(coefficients[:, dim], coefficients[:, :dim])


def union_of_half_spaces(u: FloatArray, f: FloatArray, gamma: float, rng: np.random.Generator) -> HalfSpaceUnion | None:
    """Return the half-spaces in which the pieces of f (n,) at u (n, d) fail, or None where pieces do not explain f.

    Pieces start at failures chosen at random. Each half-space begins before its plane by `PIECES.crossing_errors`
    standard deviations of its residuals and by `slack`; those around the origin, nearer than `min_distance`, are left
    out, as are infinite outcomes and the share `PIECES.highest` at the upper end.
    """
    dim = u.shape[1]
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    if not finite.any():
        return None
    used = finite & (f <= np.quantile(f[finite], 1 - PIECES.highest))
    u, f = u[used], f[used]
    unit, fails = float(f.std()), np.flatnonzero(f <= gamma)
    if unit == 0 or len(fails) < LINEAR_MODEL.min_failures or len(f) < points_of_piece(dim):
        return None
    y = (f - gamma) / unit
    centres = rng.choice(fails, min(PIECES.n, len(fails)), replace=False)
    pieces = fit_pieces(start_pieces(u, y, centres), u, y)
    if pieces is None:
        return None
    predicted = pieces.predict(u)
    own, residual = predicted.argmin(axis=1), y - predicted.min(axis=1)
    if 1 - float(residual @ residual) / float(((y - y.mean()) ** 2).sum()) < PIECES.min_r2:
        return None
    steepness = np.linalg.norm(pieces.slopes, axis=1)
    counts, error = piece_errors(own, residual, len(steepness), dim)
    with np.errstate(divide="ignore", invalid="ignore"):
        starts = (pieces.intercepts - PIECES.crossing_errors * error) / steepness - EDGES.slack
        kept = (counts > 0) & np.isfinite(starts) & (starts > EDGES.min_distance)  # a flat piece has no edge
        axes = -pieces.slopes / steepness[:, None]
    return HalfSpaceUnion(axes[kept], starts[kept]) if kept.any() else None


LEAST_SQUARE = 1e-20
"""Mean square of residuals, in units of the values, under which a fit is exact."""


class PiecewiseFit(NamedTuple):
    """Pieces whose least is gamma - f, in units of its spread, and the points that they rest on."""

    pieces: LinearPieces
    u: FloatArray
    """Points that agree with the pieces, shape (n, d)."""
    y: FloatArray
    """gamma - f there, shape (n,)."""
    own: NDArray[np.int64]
    """The least piece there, shape (n,)."""
    r2: float
    """R^2 among these."""
    share: float
    """Their share of all points."""

    @property
    def explained(self) -> float:
        """R^2 times the share of the points that agree."""
        return self.r2 * self.share

    def is_exact(self) -> bool:
        """Return whether f is what the pieces say at most of the points."""
        return self.r2 > LINEAR_MODEL.exact_r2 and self.share > LINEAR_MODEL.agreeing_share

    def is_whole(self) -> bool:
        """Return whether it is so at nearly all of them: a fit with a piece fewer leaves the points of that one out."""
        return self.is_exact() and self.explained > LINEAR_MODEL.boundary_r2

    def locates_edges(self) -> bool:
        """Return whether the pieces locate where failure begins."""
        return self.r2 > LINEAR_MODEL.boundary_r2 and self.share > LINEAR_MODEL.agreeing_share


def intersection_of_half_spaces(u: FloatArray, f: FloatArray, gamma: float) -> HalfSpaceIntersection | None:
    """Return the corner in which all pieces of f fail, or None where no two or more pieces explain f.

    The pieces are fitted to all points, to the failing ones and to those that do not fail: another region may be the
    lesser one beside the failures, and f may be the same for all failures. Each half-space begins before its plane by
    `LINEAR_MODEL.crossing_errors` standard deviations of its residuals and by `slack`. The points u (n, d), f (n,) are
    those around one failure region; infinite outcomes are left out.
    """
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    u, f = u[finite], f[finite]
    fails = f <= gamma
    used = (np.ones(len(f), dtype=bool), fails, ~fails)
    samples = [_scale_sample(u[rows], gamma - f[rows]) for rows in used]
    fit = _find_fit([sample for sample in samples if sample is not None])
    if fit is None or not fit.locates_edges():
        return None
    axes, starts = _find_planes(fit)
    if (fit.y < 0).all() and fails.any():  # f may jump where failure begins
        edges = [failure_edge(u[fails] @ axis, int(fails.sum())) for axis in axes]
        starts = np.minimum(starts, np.array(edges) - EDGES.slack)
    return _beyond_planes(axes, starts)


def _scale_sample(u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return at most some of the points u (n, d), with y (n,) in units of its spread; None where they are too few."""
    size, dim = float(np.abs(y).max()) if len(y) else 0.0, u.shape[1]
    unit = size * float((y / size).std()) if size > 0 else 0.0  # a square may overflow
    if unit == 0 or len(y) < points_of_piece(dim):
        return None
    rows = _spread(len(y), CORNER.points_per_dim * dim)
    return u[rows], y[rows] / unit


def _find_fit(samples: list[tuple[FloatArray, FloatArray]]) -> PiecewiseFit | None:
    """Return the best of some fits of pieces, None without one.

    One of each sample, until one is exact. Where the best of them has several pieces and is promising, its sample has
    further ones, which start elsewhere.
    """
    best, chosen = None, None
    for sample in samples:
        fit = _fit_from(*sample, 0)
        if fit is not None and (best is None or fit.explained > best.explained):
            best, chosen = fit, sample
        if best is not None and best.is_exact():
            break
    if best is None or chosen is None or len(best.pieces.intercepts) == 1 or best.r2 < CORNER.promising_r2:
        return best
    for start in range(1, CORNER.starts):
        if best.is_whole():
            break
        fit = _fit_from(*chosen, start)
        if fit is not None and fit.explained > best.explained:
            best = fit
    return best


def _fit_from(u: FloatArray, y: FloatArray, start: int) -> PiecewiseFit | None:
    """Return the fit of pieces from the points of one of the starts; None where it explains too little of y.

    Where one plane explains y, that is the fit. Points that do not agree are left out at last only: before, they may be
    those of a piece that is still to come.
    """
    whole = _regress(_design(u), y, [np.arange(len(y))], LINEAR_MODEL.ridges[1])
    plane = _judge(whole, u, y)
    if plane.is_whole():
        return plane
    order = np.argsort(y, kind="stable")
    centres = order[_spread(len(order), CORNER.n, (start + 0.5) / CORNER.starts)]
    pieces = fit_pieces(start_pieces(u, y, centres), u, y, patience=CORNER.patience)
    if pieces is None:
        return None
    pieces = _prune(pieces, u, y)
    if _judge(pieces, u, y).r2 < PIECES.min_r2:
        return None
    pieces = fit_pieces(pieces, u, y, LINEAR_MODEL.inlier_sigmas, CORNER.patience)
    return None if pieces is None else _judge(pieces, u, y)


def _spread(n: int, most: int, offset: float = 0.0) -> NDArray[np.int64]:
    """Return at most so many of n rows, evenly spaced; the offset is a share of the space between two."""
    k = min(n, most)
    return ((np.arange(k) + offset) * n / k).astype(np.int64)


def _judge(pieces: LinearPieces, u: FloatArray, y: FloatArray) -> PiecewiseFit:
    """Return pieces with the points that agree with them."""
    own, agrees, deviation = assign_points(pieces, u, y, LINEAR_MODEL.inlier_sigmas)
    u, y, own, share = u[agrees], y[agrees], own[agrees], float(agrees.mean())
    variance = float(y.var())
    square = float((deviation[agrees] ** 2).mean())
    return PiecewiseFit(pieces, u, y, own, 1 - square / variance if variance > 0 else 0.0, share)


def _prune(pieces: LinearPieces, u: FloatArray, y: FloatArray) -> LinearPieces:
    """Return the pieces without those that the Bayesian information criterion leaves out, one by one."""
    predicted = pieces.predict(u)
    cost = (u.shape[1] + 1) * math.log(len(y))  # of a piece

    def score(kept: NDArray[np.int64]) -> float:
        square = float(((y - predicted[:, kept].min(axis=1)) ** 2).mean())
        return float(len(y) * math.log(max(square, LEAST_SQUARE)) + len(kept) * cost)

    kept = np.arange(predicted.shape[1])
    while len(kept) > 1:
        best = min((np.delete(kept, k) for k in range(len(kept))), key=score)
        if score(best) > score(kept):
            break
        kept = best
    return pieces.take(kept)


def _find_planes(fit: PiecewiseFit) -> tuple[FloatArray, FloatArray]:
    """Return the axes (k, d) of the pieces that have points and a direction, and where each begins to fail, (k,)."""
    residual = fit.y - fit.pieces.predict(fit.u).min(axis=1)
    counts, error = piece_errors(fit.own, residual, len(fit.pieces.intercepts), fit.u.shape[1])
    kept = np.flatnonzero((counts > 0) & (np.linalg.norm(fit.pieces.slopes, axis=1) > 0))
    pieces, error = fit.pieces.take(kept), error[kept]
    steepness = np.linalg.norm(pieces.slopes, axis=1)
    starts = -(pieces.intercepts + LINEAR_MODEL.crossing_errors * error) / steepness - EDGES.slack
    return pieces.slopes / steepness[:, None], starts


def _beyond_planes(axes: FloatArray, starts: FloatArray) -> HalfSpaceIntersection | None:
    """Return the corner beyond planes, the furthest first; None of fewer than two.

    Planes that hold nearly all draws, and those that are nearly parallel to further ones, are left out.
    """
    useful = np.flatnonzero(starts > CORNER.min_start)
    kept: list[int] = []
    for k in useful[np.argsort(-starts[useful])]:
        q = np.linalg.qr(axes[kept].T)[0]
        across = axes[k] - q @ (q.T @ axes[k])
        if np.linalg.norm(across) > CORNER.min_turn:
            kept.append(int(k))
    return HalfSpaceIntersection(axes[kept], starts[kept]) if len(kept) > 1 else None
