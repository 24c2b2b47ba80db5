"""Parallel systems by regression: f as the greatest of several linear functions, and the corner where all of them fail.

A failure region that several conditions bound, each of which must hold, is a corner; a convex one with a curved edge
is nearly one. One plane describes it as badly as one Gaussian. The pieces of f do: f is the greatest of them where -f
is the least. They are only the source of a proposal: how well they fit decides how good it is, not whether the
estimate is right.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.linear_model import LARGEST_OUTCOME, failure_edge
from samplers.methods.two_stage.mixture.piecewise_linear import (
    LinearPieces,
    assign_points,
    fit_pieces,
    piece_errors,
    points_of_piece,
    start_pieces,
)
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, LinearModelSettings, MixtureSettings
from samplers.problem import FloatArray
from samplers.proposals.components import HalfSpaceIntersection

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

    def is_exact(self, settings: LinearModelSettings) -> bool:
        """Return whether f is what the pieces say at most of the points."""
        return self.r2 > settings.exact_r2 and self.share > settings.agreeing_share

    def locates_edges(self, settings: LinearModelSettings) -> bool:
        """Return whether the pieces also locate where failure begins."""
        return self.r2 > settings.boundary_r2 and self.share > settings.agreeing_share


def intersection_of_half_spaces(
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    settings: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
) -> HalfSpaceIntersection | None:
    """Return the corner in which all pieces of f fail, or None where no two or more pieces explain f.

    The pieces are fitted to the failing points, to all and to those that do not fail: another region may be the lesser
    one beside the failures, and f may be the same for all failures. The first fit that locates the edge counts, else
    the best one. Each half-space begins before its plane by `LinearModelSettings.crossing_errors` standard deviations
    of its residuals and by `slack`.

    Args:
        u: Points around one failure region, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones are left out.
        gamma: Threshold of failure.
        settings: Of the regression and of the edges.

    Example:
        f is the greatest of 2 - u1 and 1.5 - u2:

        >>> u = np.random.default_rng(0).normal(1.5, 1.5, (400, 2))
        >>> corner = intersection_of_half_spaces(u, (np.array([2, 1.5]) - u).max(axis=1), 0.0)
        >>> corner.axes.round(2) + 0.0
        array([[1., 0.],
               [0., 1.]])
        >>> corner.starts.round(2)
        array([1.98, 1.48])
    """
    linear = settings.linear_model
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    u, f = u[finite], f[finite]
    fails, best = f <= gamma, None
    for used in (np.ones(len(f), dtype=bool), fails, ~fails):
        fit = _fit_least(u[used], gamma - f[used], settings)
        if fit is not None and (best is None or fit.explained > best.explained):
            best = fit
        if best is not None and best.is_exact(linear):
            break
    if best is None or best.explained < settings.pieces.min_r2:
        return None
    axes, starts = _find_planes(best, settings)
    if (best.y < 0).all() or not best.locates_edges(linear):  # f may jump where failure begins
        starts = np.minimum(starts, _edges_along(axes, u[fails], settings))
    return _beyond_planes(axes, starts, settings)


def _fit_least(u: FloatArray, y: FloatArray, settings: MixtureSettings) -> PiecewiseFit | None:
    """Return the best of some fits of pieces to y (n,) at u (n, d); None where points are too few.

    Points that do not agree are left out at last only: before, they may be those of a piece that is still to come.
    """
    size = float(np.abs(y).max()) if len(y) else 0.0
    unit = size * float((y / size).std()) if size > 0 else 0.0  # a square may overflow
    if unit == 0 or len(y) < points_of_piece(u.shape[1], settings.pieces):
        return None
    rows = _spread(len(y), settings.corner.most_points)
    u, scaled, best, linear = u[rows], y[rows] / unit, None, settings.linear_model
    order = np.argsort(scaled, kind="stable")
    for k in range(settings.corner.starts):
        centres = order[_spread(len(order), settings.corner.n, (k + 0.5) / settings.corner.starts)]
        pieces = fit_pieces(start_pieces(u, scaled, centres, settings.pieces), u, scaled, settings.pieces)
        if pieces is not None:
            pieces = fit_pieces(_prune(pieces, u, scaled), u, scaled, settings.pieces, linear.inlier_sigmas)
        if pieces is None:
            continue
        fit = _judge(pieces, u, scaled, linear.inlier_sigmas)
        if best is None or fit.explained > best.explained:
            best = fit
        whole = best.is_exact(linear) and best.explained > linear.boundary_r2  # a piece fewer leaves its points out
        if whole or len(pieces.intercepts) == 1:
            break
    return best


def _spread(n: int, most: int, offset: float = 0.0) -> NDArray[np.int64]:
    """Return at most so many of n rows, evenly spaced; the offset is a share of the space between two."""
    k = min(n, most)
    return ((np.arange(k) + offset) * n / k).astype(np.int64)


def _judge(pieces: LinearPieces, u: FloatArray, y: FloatArray, inlier_sigmas: float) -> PiecewiseFit:
    """Return pieces with the points u (n, d), y (n,) that agree with them."""
    own, agrees = assign_points(pieces, u, y, inlier_sigmas)
    u, y, own, share = u[agrees], y[agrees], own[agrees], float(agrees.mean())
    variance = float(y.var())
    square = float(((y - pieces.predict(u).min(axis=1)) ** 2).mean())
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


def _find_planes(fit: PiecewiseFit, settings: MixtureSettings) -> tuple[FloatArray, FloatArray]:
    """Return the axes (k, d) of the pieces that have points and a direction, and where each begins to fail, (k,)."""
    residual = fit.y - fit.pieces.predict(fit.u).min(axis=1)
    counts, error = piece_errors(fit.own, residual, len(fit.pieces.intercepts), fit.u.shape[1])
    kept = np.flatnonzero((counts > 0) & (np.linalg.norm(fit.pieces.slopes, axis=1) > 0))
    pieces, error = fit.pieces.take(kept), error[kept]
    steepness = np.linalg.norm(pieces.slopes, axis=1)
    starts = -(pieces.intercepts + settings.linear_model.crossing_errors * error) / steepness - settings.edges.slack
    return pieces.slopes / steepness[:, None], starts


def _edges_along(axes: FloatArray, failures: FloatArray, settings: MixtureSettings) -> FloatArray:
    """Return where failures (n, d) begin along axes (k, d), shape (k,); infinity where there are none."""
    n, share = len(failures), settings.linear_model.nearest_share
    if n == 0:
        return np.full(len(axes), np.inf)
    edges = [failure_edge(failures @ axis, np.ones(n), n, share, settings.edges) for axis in axes]
    return np.array(edges) - settings.edges.slack


def _beyond_planes(axes: FloatArray, starts: FloatArray, settings: MixtureSettings) -> HalfSpaceIntersection | None:
    """Return the corner beyond planes, the furthest first; None of fewer than two.

    Planes that hold nearly all draws, and those that are nearly parallel to further ones, are left out.
    """
    useful = np.flatnonzero(starts > settings.corner.min_start)
    kept: list[int] = []
    for k in useful[np.argsort(-starts[useful])]:
        across = axes[k] - _project_on(axes[kept], axes[k])
        if np.linalg.norm(across) > settings.corner.min_turn:
            kept.append(int(k))
    return HalfSpaceIntersection(axes[kept], starts[kept]) if len(kept) > 1 else None


def _project_on(axes: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the part of an axis (d,) in the span of others (k, d)."""
    q = np.linalg.qr(axes.T)[0]
    return np.asarray(q @ (q.T @ axis))
