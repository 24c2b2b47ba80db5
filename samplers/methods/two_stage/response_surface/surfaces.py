"""Surfaces: regressions of f near its limit state, the one that is right most often at points it has not seen.

Two kinds, for smooth f and for f that is the least of several functions:

- Kriging with a linear trend and one correlation length. `methods.surrogate` has a more careful process for few points,
  this one is fitted in a tenth of a second to many.
- f as the least of linear functions (`mixture/piecewise_linear.py`).

References:
    Bucher and Bourgund, "A fast and efficient response surface approach for structural reliability problems",
    Structural Safety 7, 1990.
    Rasmussen and Williams, "Gaussian Processes for Machine Learning", MIT Press, 2006 (2.7: trends; 5.4: likelihood).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from samplers.methods.two_stage.mixture.piecewise_linear import fit_pieces, points_of_piece, start_pieces
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, PieceSettings
from samplers.methods.two_stage.response_surface.settings import (
    DEFAULT_SURFACE_SETTINGS,
    LENGTHS,
    NUGGET,
    SEARCH_POINTS,
    SurfaceSettings,
)
from samplers.problem import FloatArray

Predictor = Callable[[FloatArray], FloatArray]
"""Compressed outcomes at points (n, d), shape (n,); at most 0 where f fails."""


class Surface(NamedTuple):
    """A regression of f."""

    predict: Predictor
    accuracy: float
    """Share of unseen points near the limit state that it places on the right side."""


def fit_surface(
    x: FloatArray,
    y: FloatArray,
    rng: np.random.Generator,
    settings: SurfaceSettings = DEFAULT_SURFACE_SETTINGS,
    pieces: PieceSettings = DEFAULT_MIXTURE_SETTINGS.pieces,
) -> Surface | None:
    """Return the regression that is right most often, or None where there are too few points near the limit state.

    Args:
        x: Points, shape (n, d).
        y: f - gamma there, finite, shape (n,); some are at most 0.
        rng: Source of randomness: which points are left out for the test, and where pieces start.
        settings: Numbers of points.
        pieces: Of the regression by pieces.

    Example:
        f is the least of 3 - u1 and 3 - u2; a point is taken from each of the two failing sides, and one between:

        >>> rng = np.random.default_rng(0)
        >>> x = rng.normal(1.5, 1.5, (2000, 2))
        >>> surface = fit_surface(x, (3 - x).min(axis=1), rng)
        >>> surface.accuracy > 0.98, surface.predict(np.array([[3.5, 0.0], [0.0, 3.5], [2.0, 2.0]])) <= 0
        (True, array([ True,  True, False]))
    """
    order, m = np.argsort(np.abs(y), kind="stable"), min(settings.process_points, len(y) // 3)
    near = rng.permutation(order[: 2 * m])
    seen, test = near[:m], near[m:]
    if np.count_nonzero(y[seen] <= 0) <= x.shape[1] or np.count_nonzero(y[seen] > 0) <= x.shape[1]:
        return None
    scale = float(np.median(np.abs(y[y <= 0]))) or float(np.median(np.abs(y)))
    if scale == 0:
        return None

    def assess(predict: Predictor) -> Surface:
        return Surface(predict, float(((predict(x[test]) <= 0) == (y[test] <= 0)).mean()))

    first, *_ = compressions = [factor * scale for factor in settings.compressions]
    best = assess(fit_process(x[seen], np.tanh(y[seen] / first)))
    pool, pieces = np.setdiff1d(order[: settings.piece_points], test), replace(pieces, n=settings.pieces)
    for k in range(settings.piece_fits):
        predict = fit_least_of_planes(x[pool], np.tanh(y[pool] / compressions[k % len(compressions)]), rng, pieces)
        if predict is not None:
            best = max(best, assess(predict), key=lambda surface: surface.accuracy)
    return best


def fit_process(x: FloatArray, y: FloatArray) -> Predictor:
    """Return Kriging of y (n,) at points x (n, d), with a linear trend, of the likeliest covariance.

    Example:
        >>> x = np.random.default_rng(0).standard_normal((200, 2))
        >>> predict = fit_process(x, np.sin(x[:, 0]) + x[:, 1])
        >>> predict(np.array([[1.0, 0.5]])).round(2)  # sin 1 + 1 / 2
        array([1.34])
    """
    trend = np.linalg.lstsq(_design(x), y, rcond=None)[0]
    rest = y - _design(x) @ trend
    spread = float(rest.std()) or 1.0
    part = slice(0, SEARCH_POINTS)
    distance = _squared_distances(x[part], x[part])
    options = [(_log_likelihood(k(distance, length), rest[part]), k, length) for k in _KERNELS for length in LENGTHS]
    _, kernel, length = max(options, key=lambda option: option[0])
    covariance = kernel(_squared_distances(x, x), length) + NUGGET * np.eye(len(x))
    weights = np.linalg.solve(covariance, rest / spread)

    def predict(points: FloatArray) -> FloatArray:
        away = kernel(_squared_distances(points, x), length) @ weights
        return np.asarray(_design(points) @ trend + spread * away)

    return predict


def fit_least_of_planes(
    x: FloatArray, y: FloatArray, rng: np.random.Generator, settings: PieceSettings = DEFAULT_MIXTURE_SETTINGS.pieces
) -> Predictor | None:
    """Return y (n,) at points x (n, d) as the least of linear functions; None where there are too few points.

    Args:
        x: Points.
        y: Their outcomes; pieces start around some of those that are at most 0.
        rng: Which of them.
        settings: Of the regression.
    """
    fails = np.flatnonzero(y <= 0)
    if len(fails) == 0 or len(y) < points_of_piece(x.shape[1], settings):
        return None
    centres = rng.choice(fails, min(settings.n, len(fails)), replace=False)
    pieces = fit_pieces(start_pieces(x, y, centres, settings), x, y, settings)
    if pieces is None:
        return None
    return lambda points: pieces.predict(points).min(axis=1)


def _design(x: FloatArray) -> FloatArray:
    return np.column_stack([np.ones(len(x)), x])


def _squared_distances(x: FloatArray, z: FloatArray) -> FloatArray:
    """Return |x_i - z_j|^2 of points x (n, d) and z (m, d), shape (n, m)."""
    apart = (x * x).sum(axis=1)[:, None] + (z * z).sum(axis=1) - 2 * x @ z.T
    return np.asarray(np.maximum(apart, 0.0))


def _squared_exponential(square: FloatArray, length: float) -> FloatArray:
    return np.asarray(np.exp(-0.5 * square / length**2))


def _matern(square: FloatArray, length: float) -> FloatArray:
    """Return the Matern covariance that is twice differentiable (nu = 5/2)."""
    r = np.sqrt(5 * square) / length
    return np.asarray((1 + r + r * r / 3) * np.exp(-r))


_KERNELS = (_squared_exponential, _matern)


def _log_likelihood(correlation: FloatArray, rest: FloatArray) -> float:
    """Return the log likelihood of residuals (n,) with this correlation (n, n), at the best variance."""
    try:
        factor = np.linalg.cholesky(correlation + NUGGET * np.eye(len(rest)))
    except np.linalg.LinAlgError:
        return -math.inf
    white = np.linalg.solve(factor, rest)
    return -0.5 * len(rest) * math.log(max(float(white @ white), 1e-300)) - float(np.log(np.diag(factor)).sum())
