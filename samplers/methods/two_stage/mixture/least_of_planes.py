"""Series systems by regression: f as the least of several linear functions, and the half-spaces where these fail.

Where failure has no regions of its own but dozens of planes that pass into each other, as in the first passage of a
vibration, neither Gaussians nor one plane a region describe it. The pieces of f do. They are only the source of a
proposal: how well they fit decides how good it is, not whether the estimate is right.

References:
    Magnani and Boyd, "Convex piecewise-linear fitting", Optimization and Engineering 10, 2009 (assigns each point to
    the piece that is the largest there, and fits the pieces anew; here the least).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.linear_model import LARGEST_OUTCOME
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, MixtureSettings, PieceSettings
from samplers.problem import FloatArray
from samplers.proposals.components import HalfSpaceUnion


class LinearPieces(NamedTuple):
    """f(u) = min_k (intercept_k + slope_k . u), in units of the spread of f."""

    intercepts: FloatArray
    """Shape (k,)."""
    slopes: FloatArray
    """Shape (k, d)."""

    def predict(self, u: FloatArray) -> FloatArray:
        """Return each piece at u (n, d), shape (n, k)."""
        return self.intercepts + u @ self.slopes.T


def union_of_half_spaces(
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    rng: np.random.Generator,
    settings: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
) -> HalfSpaceUnion | None:
    """Return the half-spaces in which the pieces of f fail, or None where pieces do not explain f.

    Each begins before its plane by `PieceSettings.crossing_errors` standard deviations of its residuals and by `slack`;
    those around the origin, nearer than `min_distance`, are left out.

    Args:
        u: Points, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones and the share `PieceSettings.highest` at the upper end are left
            out.
        gamma: Threshold of failure.
        rng: Source of randomness: pieces start at failures chosen at random.
        settings: Of the regression and of the edges.

    Example:
        f is the least of 3 - u1 and 3 - u2:

        >>> rng = np.random.default_rng(0)
        >>> u = rng.normal(1.5, 1.5, (400, 2))
        >>> union = union_of_half_spaces(u, (3 - u).min(axis=1), 0.0, rng)
        >>> union.axes[np.argsort(union.axes[:, 1])].round(2) + 0.0
        array([[1., 0.],
               [0., 1.]])
        >>> union.starts.round(2)
        array([2.98, 2.98])
    """
    edges, linear, dim = settings.edges, settings.linear_model, u.shape[1]
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    if not finite.any():
        return None
    used = finite & (f <= np.quantile(f[finite], 1 - settings.pieces.highest))
    u, f = u[used], f[used]
    unit, fails = float(f.std()), np.flatnonzero(f <= gamma)
    if unit == 0 or len(fails) < linear.min_failures or len(f) < _points_of_piece(dim, settings.pieces):
        return None
    y = (f - gamma) / unit
    pieces = _fit(_start(u, y, fails, rng, settings.pieces), u, y, settings.pieces)
    if pieces is None:
        return None
    predicted = pieces.predict(u)
    own, residual = predicted.argmin(axis=1), y - predicted.min(axis=1)
    if 1 - float(residual @ residual) / float(((y - y.mean()) ** 2).sum()) < settings.pieces.min_r2:
        return None
    steepness = np.linalg.norm(pieces.slopes, axis=1)
    counts = np.bincount(own, minlength=len(steepness))
    square = np.bincount(own, weights=residual**2, minlength=len(steepness))
    error = np.sqrt(square / np.maximum(counts - dim - 1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        starts = (pieces.intercepts - settings.pieces.crossing_errors * error) / steepness - edges.slack
        kept = (counts > 0) & np.isfinite(starts) & (starts > edges.min_distance)  # a flat piece has no edge
        axes = -pieces.slopes / steepness[:, None]
    return HalfSpaceUnion(axes[kept], starts[kept]) if kept.any() else None


def _points_of_piece(dim: int, settings: PieceSettings) -> int:
    """Return the points that a piece starts from."""
    return settings.points_per_dim * dim + settings.least_points


def _start(
    u: FloatArray, y: FloatArray, fails: NDArray[np.int64], rng: np.random.Generator, settings: PieceSettings
) -> LinearPieces:
    """Return the regressions of y (n,) on the points u (n, d) around some of the failing ones."""
    chosen = rng.choice(fails, min(settings.n, len(fails)), replace=False)
    distance = np.linalg.norm(u[chosen, None] - u, axis=2)
    n = _points_of_piece(u.shape[1], settings)
    near = np.argpartition(distance, n - 1, axis=1)[:, :n]
    return _stack([_regress(u[around], y[around], settings.first_ridge) for around in near])


def _fit(pieces: LinearPieces, u: FloatArray, y: FloatArray, settings: PieceSettings) -> LinearPieces | None:
    """Return the pieces after some steps of regression, each on the points at which it is the least one."""
    least = u.shape[1] + settings.least_points
    for _ in range(settings.iterations):
        own = pieces.predict(u).argmin(axis=1)
        groups = [np.flatnonzero(own == k) for k in range(len(pieces.intercepts))]
        groups = [group for group in groups if len(group) >= least]
        if not groups:
            return None
        pieces = _stack([_regress(u[group], y[group], settings.ridge) for group in groups])
    return pieces


def _regress(u: FloatArray, y: FloatArray, ridge: float) -> tuple[float, FloatArray]:
    """Return intercept and slope (d,) of the ridge regression of y (n,) on u (n, d)."""
    mean = u.mean(axis=0)
    centred = u - mean
    slope = np.linalg.solve(centred.T @ centred + ridge * np.eye(u.shape[1]), centred.T @ (y - y.mean()))
    return float(y.mean() - mean @ slope), slope


def _stack(fits: list[tuple[float, FloatArray]]) -> LinearPieces:
    """Return several regressions as pieces."""
    return LinearPieces(np.array([intercept for intercept, _ in fits]), np.array([slope for _, slope in fits]))
