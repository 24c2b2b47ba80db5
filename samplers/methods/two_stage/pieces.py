"""Regression of f by pieces: f as the least, or the greatest, of several linear functions.

Regression of f by pieces: f as the least of several linear functions.

Each point belongs to the piece that is the least there, and each piece is fitted anew to its points, until hardly a
point changes its piece.

Series systems by regression: f as the least of several linear functions, and the half-spaces where these fail.

Where failure has no regions of its own but dozens of planes that pass into each other, as in the first passage of a
vibration, neither Gaussians nor one plane a region describe it. The pieces of f do. They are only the source of a
proposal: how well they fit decides how good it is, not whether the estimate is right.

Parallel systems by regression: f as the greatest of several linear functions, and the corner where all of them fail.

A failure region that several conditions bound, each of which must hold, is a corner; a convex one with a curved edge
is nearly one. One plane describes it as badly as one Gaussian. The pieces of f do: f is the greatest of them where -f
is the least. They are only the source of a proposal: how well they fit decides how good it is, not whether the
estimate is right.

References:
    Magnani and Boyd, "Convex piecewise-linear fitting", Optimization and Engineering 10, 2009 (there the largest).
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.components import HalfSpaceIntersection, HalfSpaceUnion
from samplers.methods.two_stage.planes import INLIER_ROUNDING, LARGEST_OUTCOME, MAD_TO_SIGMA, failure_edge, median
from samplers.methods.two_stage.settings import CORNER, EDGES, LINEAR_MODEL, PIECES
from samplers.problem import FloatArray

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


def fit_plane(u: FloatArray, y: FloatArray) -> LinearPieces:
    """Return the regression of y (n,) on all points u (n, d) as the only piece."""
    return _regress(_design(u), y, [np.arange(len(y))], PIECES.ridge)


def fit_pieces(
    pieces: LinearPieces, u: FloatArray, y: FloatArray, inlier_sigmas: float = math.inf, patience: int | None = None
) -> LinearPieces | None:
    """Return the pieces after regressions, each on the points at which it is the least one, until no point moves.

    Args:
        pieces: To start from.
        u: Points, shape (n, d).
        y: Their values, shape (n,).
        inlier_sigmas: As in `assign_points`: points that do not agree are left out.
        patience: Steps without a gain, a mean square of residuals that is a `LEAST_GAIN` lower, that end the fit as
            well: where pieces do not explain y, points move to and fro. None: no number of them does.
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
        pieces, before = _regress(design, y, groups, PIECES.ridge), own
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
    """Return the half-spaces in which the pieces of f fail, or None where pieces do not explain f.

    Each begins before its plane by `PieceSettings.crossing_errors` standard deviations of its residuals and by `slack`;
    those around the origin, nearer than `min_distance`, are left out.

    Args:
        u: Points, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones and the share `PieceSettings.highest` at the upper end are left
            out.
        gamma: Threshold of failure.
        rng: Source of randomness: pieces start at failures chosen at random.
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


class PiecewiseSample(NamedTuple):
    """Points that pieces are fitted to."""

    u: FloatArray
    """Shape (n, d)."""
    y: FloatArray
    """gamma - f there, in units of its spread, shape (n,)."""


def intersection_of_half_spaces(u: FloatArray, f: FloatArray, gamma: float) -> HalfSpaceIntersection | None:
    """Return the corner in which all pieces of f fail, or None where no two or more pieces explain f.

    The pieces are fitted to all points, to the failing ones and to those that do not fail: another region may be the
    lesser one beside the failures, and f may be the same for all failures. Each half-space begins before its plane by
    `LinearModelSettings.crossing_errors` standard deviations of its residuals and by `slack`.

    Args:
        u: Points around one failure region, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones are left out.
        gamma: Threshold of failure.
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
    if (fit.y < 0).all():  # f may jump where failure begins
        starts = np.minimum(starts, _edges_along(axes, u[fails]))
    return _beyond_planes(axes, starts)


def _scale_sample(u: FloatArray, y: FloatArray) -> PiecewiseSample | None:
    """Return at most some of the points u (n, d), with y (n,) in units of its spread; None where they are too few."""
    size, dim = float(np.abs(y).max()) if len(y) else 0.0, u.shape[1]
    unit = size * float((y / size).std()) if size > 0 else 0.0  # a square may overflow
    if unit == 0 or len(y) < points_of_piece(dim):
        return None
    rows = _spread(len(y), CORNER.points_per_dim * dim)
    return PiecewiseSample(u[rows], y[rows] / unit)


def _find_fit(samples: list[PiecewiseSample]) -> PiecewiseFit | None:
    """Return the best of some fits of pieces, None without one.

    One of each sample, until one is exact. Where the best of them has several pieces and is promising, its sample has
    further ones, which start elsewhere.
    """
    best, chosen = None, None
    for sample in samples:
        fit = _fit_from(sample, 0)
        if fit is not None and (best is None or fit.explained > best.explained):
            best, chosen = fit, sample
        if best is not None and best.is_exact():
            break
    if best is None or chosen is None or len(best.pieces.intercepts) == 1 or best.r2 < CORNER.promising_r2:
        return best
    for start in range(1, CORNER.starts):
        if best.is_whole():
            break
        fit = _fit_from(chosen, start)
        if fit is not None and fit.explained > best.explained:
            best = fit
    return best


def _fit_from(sample: PiecewiseSample, start: int) -> PiecewiseFit | None:
    """Return the fit of pieces from the points of one of the starts; None where it explains too little of y.

    Where one plane explains y, that is the fit. Points that do not agree are left out at last only: before, they may be
    those of a piece that is still to come.
    """
    (u, y) = sample
    plane = _judge(fit_plane(u, y), sample, LINEAR_MODEL.inlier_sigmas)
    if plane.is_whole():
        return plane
    order = np.argsort(y, kind="stable")
    centres = order[_spread(len(order), CORNER.n, (start + 0.5) / CORNER.starts)]
    first = start_pieces(u, y, centres)
    pieces = fit_pieces(first, u, y, patience=CORNER.patience)
    if pieces is None:
        return None
    pieces = _prune(pieces, u, y)
    if _judge(pieces, sample, LINEAR_MODEL.inlier_sigmas).r2 < PIECES.min_r2:
        return None
    pieces = fit_pieces(pieces, u, y, LINEAR_MODEL.inlier_sigmas, CORNER.patience)
    return None if pieces is None else _judge(pieces, sample, LINEAR_MODEL.inlier_sigmas)


def _spread(n: int, most: int, offset: float = 0.0) -> NDArray[np.int64]:
    """Return at most so many of n rows, evenly spaced; the offset is a share of the space between two."""
    k = min(n, most)
    return ((np.arange(k) + offset) * n / k).astype(np.int64)


def _judge(pieces: LinearPieces, sample: PiecewiseSample, inlier_sigmas: float) -> PiecewiseFit:
    """Return pieces with the points that agree with them."""
    u, y = sample
    own, agrees, deviation = assign_points(pieces, u, y, inlier_sigmas)
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


def _edges_along(axes: FloatArray, failures: FloatArray) -> FloatArray:
    """Return where failures (n, d) begin along axes (k, d), shape (k,); infinity where there are none."""
    n, share = len(failures), LINEAR_MODEL.nearest_share
    if n == 0:
        return np.full(len(axes), np.inf)
    edges = [failure_edge(failures @ axis, np.ones(n), n, share) for axis in axes]
    return np.array(edges) - EDGES.slack


def _beyond_planes(axes: FloatArray, starts: FloatArray) -> HalfSpaceIntersection | None:
    """Return the corner beyond planes, the furthest first; None of fewer than two.

    Planes that hold nearly all draws, and those that are nearly parallel to further ones, are left out.
    """
    useful = np.flatnonzero(starts > CORNER.min_start)
    kept: list[int] = []
    for k in useful[np.argsort(-starts[useful])]:
        across = axes[k] - _project_on(axes[kept], axes[k])
        if np.linalg.norm(across) > CORNER.min_turn:
            kept.append(int(k))
    return HalfSpaceIntersection(axes[kept], starts[kept]) if len(kept) > 1 else None


def _project_on(axes: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the part of an axis (d,) in the span of others (k, d)."""
    q = np.linalg.qr(axes.T)[0]
    return np.asarray(q @ (q.T @ axis))
