"""A Gaussian mixture taken one coordinate at a time, each conditional cut to its range: the exact triangular map.

Every operation works row by row: a row of the result does not depend, bit for bit, on the other rows of the call.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import Coordinates, as_finite, move_inside
from rare_envs.distributions.truncated_normal import (
    TruncatedConditional,
    choose,
    log_interval,
    log_sum,
    reweight,
    truncated_quantile,
)

CHUNK_ROWS = 8192
"""Rows worked on together: the temporaries of one chunk stay in the cache."""
COMPONENT_FIELDS = ("weights", "means", "covariances")


class ConditioningState(NamedTuple):
    """What the earlier coordinates of rows say about the next, of K components and n rows."""

    log_weights: FloatArray
    """Logarithms of the weights of the components times their densities of the earlier coordinates, shape (K, n).

    (K, 1) before the first coordinate, where all rows are alike."""
    residuals: tuple[FloatArray, ...] = ()
    """Standardised residuals of the earlier coordinates, shape (K, n) each."""


@dataclass(frozen=True, eq=False)
class MixtureConditionals:
    """Conditionals of a Gaussian mixture of coordinates, each given the earlier ones and cut to its range.

    Args:
        coordinates: Coordinates of points x and their box.
        weights: Component weights, shape (K,), positive, sum 1.
        means: Component means, shape (K, d), in the order of the coordinates.
        covariances: Component covariances, shape (K, d, d), symmetric positive definite.

    Raises:
        ValueError: A shape, weight or covariance is not as above.
    """

    coordinates: Coordinates
    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    _factors: FloatArray = field(init=False, repr=False)  # Cholesky factors, (K, d, d)
    _regressions: tuple[FloatArray, ...] = field(init=False, repr=False)  # i -> (K, i), for sampling

    def __post_init__(self) -> None:
        for name in COMPONENT_FIELDS:
            object.__setattr__(self, name, as_finite(name, getattr(self, name)))  # a field by its name
        _check_shapes(self.weights, self.means, self.covariances, self.coordinates.dim)
        _check_weights(self.weights)
        object.__setattr__(self, "_factors", _cholesky(self.covariances))
        object.__setattr__(self, "_regressions", _regressions(self.covariances))
        for name in COMPONENT_FIELDS:
            getattr(self, name).setflags(write=False)  # likewise

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return int(self.means.shape[1])

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density of the coordinates of points in the box, (n, d) -> (n,)."""
        return apply_by_chunks(self._log_prob, x, 1)[:, 0]

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map points in the box to standard normal space, (n, d) -> (n, d); u_j rises with column j of x."""
        return apply_by_chunks(self._to_normal, x, self.dim)

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points strictly inside the box, (n, d) -> (n, d).

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        return apply_by_chunks(self._from_normal, self.finite_rows(u), self.dim)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw by ancestral sampling: per coordinate a component, then its truncated normal.

        The first rows do not depend on n: the same generator state gives the same leading rows.

        Args:
            n: Number of points.
            rng: Source of randomness; 2 d uniform numbers per row.

        Returns:
            Independent points, shape (n, d), strictly inside the box.
        """
        return apply_by_chunks(self._ancestral, rng.random((n, 2 * self.dim)), self.dim)

    def rows(self, name: str, points: ArrayLike) -> FloatArray:
        """Return points as float64 of shape (n, d).

        Raises:
            ValueError: Wrong shape.
        """
        array = np.asarray(points, dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != self.dim:
            hint = "; add a batch axis" if array.shape == (self.dim,) else ""
            raise ValueError(f"Expected {name} of shape (n, {self.dim}), got {array.shape}{hint}.")
        return array

    def finite_rows(self, u: ArrayLike) -> FloatArray:
        """Return standard normal points as float64 of shape (n, d).

        Raises:
            ValueError: Wrong shape, or a value is not finite.
        """
        points = self.rows("u", u)
        if not np.isfinite(points).all():
            i, j = np.argwhere(~np.isfinite(points))[0]
            raise ValueError(f"u[{i}, {j}] = {points[i, j]} must be finite.")
        return points

    def rows_in_box(self, x: ArrayLike) -> FloatArray:
        """Return points as float64 of shape (n, d).

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        points, (low, high) = self.rows("x", x), (self.coordinates.low, self.coordinates.high)
        outside = ~((points >= low) & (points <= high))
        if outside.any():
            i, j = np.argwhere(outside)[0]
            raise ValueError(
                f"x[{i}, {j}] = {points[i, j]:g} is outside the box [{low[j]:g}, "
                f"{high[j]:g}] of coordinate {j}; only points in the box have an image."
            )
        return points

    def start(self) -> ConditioningState:
        """Return the state of rows before the first coordinate, in which they are alike."""
        return ConditioningState(np.log(self.weights)[:, None])

    def next_conditional(self, state: ConditioningState, bounds: tuple[Any, Any]) -> TruncatedConditional:
        """Return the distribution of the next coordinate given the earlier ones, within bounds."""
        i = len(state.residuals)
        mean = self.means[:, i, None]
        for k, residual in enumerate(state.residuals):
            mean = mean + self._factors[:, i, k, None] * residual
        return TruncatedConditional(state.log_weights, mean, self._factors[:, i, i, None], *bounds)

    def observe(self, conditional: TruncatedConditional, state: ConditioningState, y: FloatArray) -> ConditioningState:
        """Return the state after the next coordinate y (n,), whose distribution is `conditional`."""
        residual = (y - conditional.mean) / conditional.scale
        log_weights = reweight(conditional.log_weights, residual, conditional.scale)
        return ConditioningState(log_weights, (*state.residuals, residual))

    def _log_prob(self, x: FloatArray) -> FloatArray:
        state, total = self.start(), np.zeros(len(x))
        for j in self.coordinates.columns:
            conditional = self.next_conditional(state, self.coordinates.bounds(j, x))
            total = total - conditional.log_whole_mass()
            state = self.observe(conditional, state, self.coordinates.coordinate(j, x))
            density = log_sum(state.log_weights)
            total = total + density
            # Kept relative to the largest, so that far points do not run away.
            state = state._replace(log_weights=state.log_weights - density)
        return total[:, None]

    def _to_normal(self, x: FloatArray) -> FloatArray:
        state, u = self.start(), np.empty_like(x)
        for j in self.coordinates.columns:
            bounds = self.coordinates.bounds(j, x)
            conditional = self.next_conditional(state, bounds)
            inner = move_inside(self.coordinates.coordinate(j, x), *bounds)
            u[:, j] = self.coordinates.sign(j) * conditional.to_normal(inner)
            if j != self.coordinates.columns[-1]:
                state = self.observe(conditional, state, inner)
        return u

    def _from_normal(self, u: FloatArray) -> FloatArray:
        state, x = self.start(), np.empty_like(u)
        for j in self.coordinates.columns:
            bounds = self.coordinates.bounds(j, x)
            conditional = self.next_conditional(state, bounds)
            inner = move_inside(conditional.from_normal(self.coordinates.sign(j) * u[:, j]), *bounds)
            x[:, j] = self.coordinates.value(j, inner, x)
            if j != self.coordinates.columns[-1]:
                state = self.observe(conditional, state, inner)
        return x

    def _ancestral(self, uniforms: FloatArray) -> FloatArray:
        """Return draws from uniforms of shape (n, 2 d).

        Conditions by regression coefficients, not by the Cholesky residuals of the map, so that
        comparing samples with the map tests both.
        """
        n = len(uniforms)
        rows = np.arange(n)
        log_weights = np.repeat(self.start().log_weights, n, axis=1)
        x, y = np.empty((n, self.dim)), np.empty((n, self.dim))
        for i, j in enumerate(self.coordinates.columns):
            bounds = self.coordinates.bounds(j, x)
            scale = self._factors[:, i, i, None]
            mean = np.repeat(self.means[:, i, None], n, axis=1)
            for k in range(i):
                mean = mean + self._regressions[i][:, k, None] * (y[:, k] - self.means[:, k, None])
            low, high = ((end - mean) / scale for end in bounds)
            pick = choose(log_weights + log_interval(low, high, high - low), uniforms[:, 2 * i])
            v = uniforms[:, 2 * i + 1]
            with np.errstate(divide="ignore"):  # v = 0 is the lower end of the box
                z = truncated_quantile(low[pick, rows], high[pick, rows], np.log(v), np.log1p(-v))
            y[:, i] = move_inside(mean[pick, rows] + scale[pick, 0] * z, *bounds)
            x[:, j] = self.coordinates.value(j, y[:, i], x)
            log_weights = reweight(log_weights, (y[:, i] - mean) / scale, scale)
        return x


def apply_by_chunks(function: Callable[[FloatArray], FloatArray], points: FloatArray, columns: int) -> FloatArray:
    """Return a function of rows, shape (n, columns), computed for `CHUNK_ROWS` rows at a time."""
    out = np.empty((len(points), columns))
    for start in range(0, len(points), CHUNK_ROWS):
        out[start : start + CHUNK_ROWS] = function(points[start : start + CHUNK_ROWS])
    return out


def _check_shapes(weights: FloatArray, means: FloatArray, covariances: FloatArray, columns: int) -> None:
    if means.ndim != 2 or means.size == 0:
        raise ValueError(f"Expected means of shape (K, d), got {means.shape}.")
    k, d = means.shape
    for name, shape, array in (("weights", (k,), weights), ("covariances", (k, d, d), covariances)):
        if array.shape != shape:
            raise ValueError(f"Expected {name} of shape {shape} to go with means {means.shape}, got {array.shape}.")
    if d != columns:
        raise ValueError(f"Expected means of shape ({k}, {columns}), one for each column, got {means.shape}.")


def _check_weights(weights: FloatArray) -> None:
    if (weights <= 0).any():
        raise ValueError(f"weights must be positive, got {weights.min():g}; drop that component.")
    if abs(weights.sum() - 1.0) > 1e-9:
        raise ValueError(f"weights must sum to 1, got {weights.sum():.12g}.")


def _cholesky(covariances: FloatArray) -> FloatArray:
    for k, covariance in enumerate(covariances):
        if not np.allclose(covariance, covariance.T, rtol=1e-9, atol=0.0):
            raise ValueError(f"covariances[{k}] is not symmetric.")
        smallest = float(np.linalg.eigvalsh(covariance)[0])
        if smallest <= 0.0:
            raise ValueError(f"covariances[{k}] is not positive definite: smallest eigenvalue {smallest:g}.")
    try:
        return np.asarray(np.linalg.cholesky(covariances), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise ValueError("A covariance is too close to singular; add to its diagonal.") from None


def _regressions(covariances: FloatArray) -> tuple[FloatArray, ...]:
    """Return the coefficients of coordinate i on the earlier ones, per component: (K, i) for each i."""
    out = []
    for i in range(covariances.shape[1]):
        solution = np.linalg.solve(covariances[:, :i, :i], covariances[:, :i, i, None])
        out.append(np.asarray(solution[:, :, 0], dtype=np.float64))
    return tuple(out)
