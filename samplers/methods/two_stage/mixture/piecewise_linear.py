"""Regression of f by pieces: f as the least of several linear functions.

Each point belongs to the piece that is the least there, and each piece is fitted anew to its points, until hardly a
point changes its piece.

References:
    Magnani and Boyd, "Convex piecewise-linear fitting", Optimization and Engineering 10, 2009 (there the largest).
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.linear_model import INLIER_ROUNDING, MAD_TO_SIGMA, median
from samplers.methods.two_stage.mixture.settings import PieceSettings
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


def points_of_piece(dim: int, settings: PieceSettings) -> int:
    """Return the points that a piece starts from."""
    return settings.points_per_dim * dim + settings.least_points


def start_pieces(u: FloatArray, y: FloatArray, centres: NDArray[np.int64], settings: PieceSettings) -> LinearPieces:
    """Return the regressions of y (n,) on the points u (n, d) around each of the `centres`, rows of u."""
    distance = np.linalg.norm(u[centres, None] - u, axis=2)
    around = points_of_piece(u.shape[1], settings)
    near = np.argpartition(distance, around - 1, axis=1)[:, :around]
    return _regress(_design(u), y, near, settings.first_ridge)


def fit_plane(u: FloatArray, y: FloatArray, settings: PieceSettings) -> LinearPieces:
    """Return the regression of y (n,) on all points u (n, d) as the only piece."""
    return _regress(_design(u), y, [np.arange(len(y))], settings.ridge)


def fit_pieces(
    pieces: LinearPieces,
    u: FloatArray,
    y: FloatArray,
    settings: PieceSettings,
    inlier_sigmas: float = math.inf,
    patience: int | None = None,
) -> LinearPieces | None:
    """Return the pieces after regressions, each on the points at which it is the least one, until no point moves.

    Args:
        pieces: To start from.
        u: Points, shape (n, d).
        y: Their values, shape (n,).
        settings: Most steps, ridge penalty and points of a piece; one with fewer is given up, and None is left of none.
        inlier_sigmas: As in `assign_points`: points that do not agree are left out.
        patience: Steps without a gain, a mean square of residuals that is a `LEAST_GAIN` lower, that end the fit as
            well: where pieces do not explain y, points move to and fro. None: no number of them does.
    """
    least, design = u.shape[1] + settings.least_points, _design(u)
    before, lowest, idle = None, math.inf, 0
    for _ in range(settings.iterations):
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
        pieces, before = _regress(design, y, groups, settings.ridge), own
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
