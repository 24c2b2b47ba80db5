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
    fit_plane,
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

    def is_whole(self, settings: LinearModelSettings) -> bool:
        """Return whether it is so at nearly all of them: a fit with a piece fewer leaves the points of that one out."""
        return self.is_exact(settings) and self.explained > settings.boundary_r2

    def locates_edges(self, settings: LinearModelSettings) -> bool:
        """Return whether the pieces locate where failure begins."""
        return self.r2 > settings.boundary_r2 and self.share > settings.agreeing_share


class PiecewiseSample(NamedTuple):
    """Points that pieces are fitted to."""

    u: FloatArray
    """Shape (n, d)."""
    y: FloatArray
    """gamma - f there, in units of its spread, shape (n,)."""


def intersection_of_half_spaces(
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    settings: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
) -> HalfSpaceIntersection | None:
    """Return the corner in which all pieces of f fail, or None where no two or more pieces explain f.

    The pieces are fitted to all points, to the failing ones and to those that do not fail: another region may be the
    lesser one beside the failures, and f may be the same for all failures. Each half-space begins before its plane by
    `LinearModelSettings.crossing_errors` standard deviations of its residuals and by `slack`.

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
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    u, f = u[finite], f[finite]
    fails = f <= gamma
    used = (np.ones(len(f), dtype=bool), fails, ~fails)
    samples = [_scale_sample(u[rows], gamma - f[rows], settings) for rows in used]
    fit = _find_fit([sample for sample in samples if sample is not None], settings)
    if fit is None or not fit.locates_edges(settings.linear_model):
        return None
    axes, starts = _find_planes(fit, settings)
    if (fit.y < 0).all():  # f may jump where failure begins
        starts = np.minimum(starts, _edges_along(axes, u[fails], settings))
    return _beyond_planes(axes, starts, settings)


def _scale_sample(u: FloatArray, y: FloatArray, settings: MixtureSettings) -> PiecewiseSample | None:
    """Return at most some of the points u (n, d), with y (n,) in units of its spread; None where they are too few."""
    size, dim = float(np.abs(y).max()) if len(y) else 0.0, u.shape[1]
    unit = size * float((y / size).std()) if size > 0 else 0.0  # a square may overflow
    if unit == 0 or len(y) < points_of_piece(dim, settings.pieces):
        return None
    rows = _spread(len(y), settings.corner.points_per_dim * dim)
    return PiecewiseSample(u[rows], y[rows] / unit)


def _find_fit(samples: list[PiecewiseSample], settings: MixtureSettings) -> PiecewiseFit | None:
    """Return the best of some fits of pieces, None without one.

    One of each sample, until one is exact. Where the best of them has several pieces and is promising, its sample has
    further ones, which start elsewhere.
    """
    corner, linear = settings.corner, settings.linear_model
    best, chosen = None, None
    for sample in samples:
        fit = _fit_from(sample, 0, settings)
        if fit is not None and (best is None or fit.explained > best.explained):
            best, chosen = fit, sample
        if best is not None and best.is_exact(linear):
            break
    if best is None or chosen is None or len(best.pieces.intercepts) == 1 or best.r2 < corner.promising_r2:
        return best
    for start in range(1, corner.starts):
        if best.is_whole(linear):
            break
        fit = _fit_from(chosen, start, settings)
        if fit is not None and fit.explained > best.explained:
            best = fit
    return best


def _fit_from(sample: PiecewiseSample, start: int, settings: MixtureSettings) -> PiecewiseFit | None:
    """Return the fit of pieces from the points of one of the starts; None where it explains too little of y.

    Where one plane explains y, that is the fit. Points that do not agree are left out at last only: before, they may be
    those of a piece that is still to come.
    """
    (u, y), corner, linear = sample, settings.corner, settings.linear_model
    plane = _judge(fit_plane(u, y, settings.pieces), sample, linear.inlier_sigmas)
    if plane.is_whole(linear):
        return plane
    order = np.argsort(y, kind="stable")
    centres = order[_spread(len(order), corner.n, (start + 0.5) / corner.starts)]
    first = start_pieces(u, y, centres, settings.pieces)
    pieces = fit_pieces(first, u, y, settings.pieces, patience=corner.patience)
    if pieces is None:
        return None
    pieces = _prune(pieces, u, y)
    if _judge(pieces, sample, linear.inlier_sigmas).r2 < settings.pieces.min_r2:
        return None
    pieces = fit_pieces(pieces, u, y, settings.pieces, linear.inlier_sigmas, corner.patience)
    return None if pieces is None else _judge(pieces, sample, linear.inlier_sigmas)


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
