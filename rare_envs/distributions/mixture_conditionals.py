"""A Gaussian mixture taken one coordinate at a time, each conditional cut to its range: the exact triangular map.

Every operation works row by row: a row of the result does not depend, bit for bit, on the other rows of the call.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import Coordinates, as_finite, move_inside
from rare_envs.distributions.rows.box_points import BoxPoints, CoordinateRun, describe_points, find_ranges, split_runs
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

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density of points, (n, d) -> (n,); -inf outside the box.

        Raises:
            ValueError: Wrong shape.
        """
        return self.log_prob_at(describe_points(self.coordinates, self.rows("x", x)))

    def log_prob_at(self, points: BoxPoints) -> FloatArray:
        """Return the same from what equal coordinates say of n points, (n,)."""
        out = np.full(len(points.inside), -np.inf)
        out[points.inside] = self._log_prob(points) + points.log_jacobian
        return out

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

    @cached_property
    def _runs(self) -> tuple[CoordinateRun, ...]:
        return split_runs(self.coordinates)

    @cached_property
    def _parameters(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Parameters as compiled code takes them: of the components in the last axis, and not read-only."""
        factors = np.ascontiguousarray(np.moveaxis(self._factors, 0, -1))
        log_scales = np.log(np.einsum("iik->ik", factors))
        return np.log(self.weights), np.array(self.means.T, order="C"), factors, log_scales

    def _log_prob(self, points: BoxPoints) -> FloatArray:
        rows = find_compiled()
        return self._log_prob_by_coordinates(points) if rows is None else self._log_prob_by_rows(points, rows)

    def _log_prob_by_rows(self, points: BoxPoints, rows: Any) -> FloatArray:
        out, fits = rows.find_log_densities(self._parameters, points.ranges, points.y)
        if not fits.all():
            out[~fits] = self._log_prob_by_coordinates(points.take(~fits))
        return np.asarray(out)

    def _log_prob_by_coordinates(self, points: BoxPoints) -> FloatArray:
        out = np.zeros(points.y.shape[1])
        for start in range(0, len(out), CHUNK_ROWS):
            chunk, total = points.take(slice(start, start + CHUNK_ROWS)), out[start : start + CHUNK_ROWS]
            state = self.start()
            for y, low, high in zip(chunk.y, *chunk.ranges, strict=True):
                conditional = self.next_conditional(state, (low, high))
                total -= conditional.log_whole_mass()
                state = self.observe(conditional, state, y)
                density = log_sum(state.log_weights)
                total += density
                # Kept relative to the largest, so that far points do not run away.
                state = state._replace(log_weights=state.log_weights - density)
        return out

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
        rows = find_compiled()
        return self._from_normal_by_coordinates(u) if rows is None else self._from_normal_by_rows(u, rows)

    def _from_normal_by_rows(self, u: FloatArray, rows: Any) -> FloatArray:
        states, x = rows.RowStates(self._parameters, len(u)), np.empty_like(u)
        for first, columns, signs, fixed in self._runs:
            ranges = find_ranges(self.coordinates, columns, x) if fixed is None else fixed
            x[:, columns] = states.map_coordinates(first, ranges, u[:, columns] * signs)
            for j in columns:
                if self.coordinates.kinds[j] != "plain":
                    x[:, j] = self.coordinates.value(j, np.ascontiguousarray(x[:, j]), x)
        if not states.fits.all():
            x[~states.fits] = self._from_normal_by_coordinates(u[~states.fits])
        return x

    def _from_normal_by_coordinates(self, u: FloatArray) -> FloatArray:
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


def find_compiled() -> Any:
    """Return the module `compiled_rows` where this process has numba, else None."""
    return _load_compiled() if "numba" in sys.modules else None


@cache
def _load_compiled() -> Any:
    """Return the module; None where numba does not work, or SciPy's functions are others to it."""
    try:
        from rare_envs.distributions.rows import compiled_rows

        sample, u = _sample()
        x, known = sample._from_normal_by_rows(u, compiled_rows), sample._from_normal_by_coordinates(u)
        points = describe_points(sample.coordinates, x)
        densities = sample._log_prob_by_rows(points, compiled_rows), sample._log_prob_by_coordinates(points)
        same = np.array_equal(x, known) and np.allclose(*densities, rtol=1e-12, atol=1e-12)
    except Exception:  # a compiler may raise anything, and is not needed
        return None
    return compiled_rows if same else None


def _sample() -> tuple[MixtureConditionals, FloatArray]:
    """Return a mixture in a box that cuts each component differently, and points for it."""
    low, high, weights = np.array([-1.0, 0.5]), np.array([2.0, 30.0]), np.array([0.3, 0.7])
    means, covariances = np.array([[0.0, 1.0], [-3.0, 9.0]]), np.array([[[1.0, 0.5], [0.5, 2.0]], 0.1 * np.eye(2)])
    sample = MixtureConditionals(Coordinates(low, high, ("plain", "plain")), weights, means, covariances)
    return sample, np.random.default_rng(0).normal(0.0, 3.0, (64, 2))


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
