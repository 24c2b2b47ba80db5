"""Truncated Gaussian mixture: the base distribution of most scenarios, exact in every direction.

Density, sampling and the map to and from standard normal space use one-dimensional normal
distribution functions only. They are evaluated in logarithms of the smaller tail, so they stay
accurate far from the bulk, where rare events live. Every operation works row by row: a row of the
result does not depend, bit for bit, on the other rows of the call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.arrays import FloatArray
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
MIXTURE_FIELDS = ("weights", "means", "covariances", "low", "high")


@dataclass(frozen=True, eq=False)
class TruncatedGaussianMixture:
    """Gaussian mixture with full covariances, truncated to a box coordinate by coordinate.

    With f the density of the untruncated mixture, the density is

        p(x) = prod_j f(x_j | x_1, ..., x_{j-1}) / P_f(low_j <= X_j <= high_j | x_1, ..., x_{j-1})

    inside the box and 0 outside: each conditional of the mixture, in the order of x, is cut to its
    range and renormalised. The jointly truncated distribution, f(x) / P_f(box), divides by one constant
    instead; the two agree up to factors 1 / (1 - mass outside the box), so they differ little when
    that mass is small (the provenance of a fitted file states it), and are equal for d = 1. Cut
    conditionals are one-dimensional, which is what makes the Rosenblatt map exact.

    Args:
        weights: Component weights, shape (K,), positive, sum 1.
        means: Component means, shape (K, d).
        covariances: Component covariances, shape (K, d, d), symmetric positive definite.
        low: Lower ends of the box, shape (d,), finite.
        high: Upper ends of the box, shape (d,), finite, above `low`.

    Raises:
        ValueError: A shape, weight, covariance or bound is not as above.

    Example:
        >>> speed_and_gap = TruncatedGaussianMixture(
        ...     weights=[1.0],
        ...     means=[[20.0, 40.0]],
        ...     covariances=[[[9.0, 12.0], [12.0, 100.0]]],
        ...     low=[0.0, 1.0],
        ...     high=[45.0, 150.0],
        ... )
        >>> x = speed_and_gap.from_standard_normal([[0.0, 0.0], [1.0, 0.0]])
        >>> x.round(2).tolist()  # the mean; one standard deviation of the speed, and the gap that goes with it
        [[20.0, 40.0], [23.0, 44.0]]
        >>> bool(np.abs(speed_and_gap.to_standard_normal(x) - [[0.0, 0.0], [1.0, 0.0]]).max() < 1e-8)
        True

    References:
        Rosenblatt, "Remarks on a multivariate transformation", 1952.
    """

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    low: FloatArray
    high: FloatArray
    _factors: FloatArray = field(init=False, repr=False)  # Cholesky factors, (K, d, d)
    _regressions: tuple[FloatArray, ...] = field(init=False, repr=False)  # j -> (K, j), for sampling

    def __post_init__(self) -> None:
        for name in MIXTURE_FIELDS:
            object.__setattr__(self, name, _as_finite(name, getattr(self, name)))
        _check_shapes(self.weights, self.means, self.covariances, self.low, self.high)
        _check_values(self.weights, self.low, self.high)
        object.__setattr__(self, "_factors", _cholesky(self.covariances))
        object.__setattr__(self, "_regressions", _regressions(self.covariances))
        for name in MIXTURE_FIELDS:
            getattr(self, name).setflags(write=False)

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return int(self.means.shape[1])

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, -inf outside the box.

        Args:
            x: Points, shape (n, d).

        Returns:
            Log density, shape (n,).
        """
        points = self._rows("x", x)
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        out = np.full(len(points), -np.inf)
        out[inside] = _by_chunks(self._log_prob_inside, points[inside], 1)[:, 0]
        return out

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map to standard normal space by Rosenblatt: u_j = Phi^-1(P(X_j <= x_j | x_1, ..., x_{j-1})).

        A point on a face of the box, whose exact image is infinite, is taken one float inside.

        Args:
            x: Points in the box, shape (n, d).

        Returns:
            Standard normal points, shape (n, d).

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        points = self._rows("x", x)
        outside = ~((points >= self.low) & (points <= self.high))
        if outside.any():
            i, j = np.argwhere(outside)[0]
            raise ValueError(
                f"x[{i}, {j}] = {points[i, j]:g} is outside the box [{self.low[j]:g}, "
                f"{self.high[j]:g}] of coordinate {j}; only points in the box have an image."
            )
        return _by_chunks(self._to_normal, points, self.dim)

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map from standard normal space by the inverse Rosenblatt map; the image is strictly inside the box.

        u -> x -> u returns to 1e-8 for |u| <= 6, unless the box cuts the bulk so hard that
        neighbouring floats next to its face are further apart than that.

        Args:
            u: Standard normal points, shape (n, d), finite.

        Returns:
            Points of the mixture, shape (n, d).

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        points = self._rows("u", u)
        if not np.isfinite(points).all():
            i, j = np.argwhere(~np.isfinite(points))[0]
            raise ValueError(f"u[{i}, {j}] = {points[i, j]} must be finite.")
        return _by_chunks(self._from_normal, points, self.dim)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw by ancestral sampling: per coordinate a component, then its truncated normal.

        The first rows do not depend on n: the same generator state gives the same leading rows.

        Args:
            n: Number of points.
            rng: Source of randomness; 2 d uniform numbers per row.

        Returns:
            Independent points, shape (n, d), strictly inside the box.
        """
        uniforms = rng.random((n, 2 * self.dim))
        return _by_chunks(self._ancestral, uniforms, self.dim)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists under the names of the constructor's arguments, ready for JSON."""
        return {name: getattr(self, name).tolist() for name in MIXTURE_FIELDS}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TruncatedGaussianMixture:
        """Return the distribution that `to_dict` describes; other keys (names, units, provenance) are left alone.

        Raises:
            ValueError: A key is missing or its value is not valid.
        """
        missing = [name for name in MIXTURE_FIELDS if name not in data]
        if missing:
            raise ValueError(f"Missing {', '.join(missing)}; needed are {', '.join(MIXTURE_FIELDS)}.")
        return cls(*(data[name] for name in MIXTURE_FIELDS))

    def _rows(self, name: str, points: ArrayLike) -> FloatArray:
        array = np.asarray(points, dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != self.dim:
            hint = "; add a batch axis" if array.shape == (self.dim,) else ""
            raise ValueError(f"Expected {name} of shape (n, {self.dim}), got {array.shape}{hint}.")
        return array

    def _interior(self, j: int, x: FloatArray) -> FloatArray:
        """Move coordinate j off the faces of the box, by one float."""
        low, high = self.low[j], self.high[j]
        return np.clip(x, np.nextafter(low, high), np.nextafter(high, low))

    def _start(self, n: int) -> FloatArray:
        return np.repeat(np.log(self.weights)[:, None], n, axis=1)

    def _conditional(self, j: int, log_weights: FloatArray, residuals: list[FloatArray]) -> TruncatedConditional:
        """Return the distribution of coordinate j given the earlier ones, by their standardised residuals (K, n)."""
        mean = np.repeat(self.means[:, j, None], log_weights.shape[1], axis=1)
        for i, residual in enumerate(residuals):
            mean = mean + self._factors[:, j, i, None] * residual
        scale = self._factors[:, j, j, None]
        return TruncatedConditional(log_weights, mean, scale, self.low[j], self.high[j])

    def _log_prob_inside(self, x: FloatArray) -> FloatArray:
        log_weights = self._start(len(x))
        residuals: list[FloatArray] = []
        total = np.zeros(len(x))
        for j in range(self.dim):
            conditional = self._conditional(j, log_weights, residuals)
            residual = (x[:, j] - conditional.mean) / conditional.scale
            total = total - log_sum(log_weights + conditional.log_mass())
            log_weights = reweight(log_weights, residual, conditional.scale)
            total = total + log_sum(log_weights)
            # Kept relative to the largest, so that far points do not run away.
            log_weights = log_weights - log_sum(log_weights)
            residuals.append(residual)
        return total[:, None]

    def _to_normal(self, x: FloatArray) -> FloatArray:
        log_weights = self._start(len(x))
        residuals: list[FloatArray] = []
        u = np.empty_like(x)
        for j in range(self.dim):
            conditional = self._conditional(j, log_weights, residuals)
            inner = self._interior(j, x[:, j])
            u[:, j] = conditional.to_normal(inner)
            residuals.append((inner - conditional.mean) / conditional.scale)
            log_weights = reweight(log_weights, residuals[-1], conditional.scale)
        return u

    def _from_normal(self, u: FloatArray) -> FloatArray:
        log_weights = self._start(len(u))
        residuals: list[FloatArray] = []
        x = np.empty_like(u)
        for j in range(self.dim):
            conditional = self._conditional(j, log_weights, residuals)
            x[:, j] = self._interior(j, conditional.from_normal(u[:, j]))
            residuals.append((x[:, j] - conditional.mean) / conditional.scale)
            log_weights = reweight(log_weights, residuals[-1], conditional.scale)
        return x

    def _ancestral(self, uniforms: FloatArray) -> FloatArray:
        """Return draws from uniforms of shape (n, 2 d).

        Conditions by regression coefficients, not by the Cholesky residuals of the map, so that
        comparing samples with the map tests both.
        """
        n = len(uniforms)
        log_weights = self._start(n)
        x = np.empty((n, self.dim))
        for j in range(self.dim):
            scale = self._factors[:, j, j, None]
            mean = np.repeat(self.means[:, j, None], n, axis=1)
            for i in range(j):
                mean = mean + self._regressions[j][:, i, None] * (x[:, i] - self.means[:, i, None])
            low, high = (self.low[j] - mean) / scale, (self.high[j] - mean) / scale
            score = log_weights + log_interval(low, high, high - low)
            pick = choose(score, uniforms[:, 2 * j])
            rows = np.arange(n)
            v = uniforms[:, 2 * j + 1]
            with np.errstate(divide="ignore"):  # v = 0 is the lower end of the box
                z = truncated_quantile(low[pick, rows], high[pick, rows], np.log(v), np.log1p(-v))
            x[:, j] = self._interior(j, mean[pick, rows] + scale[pick, 0] * z)
            log_weights = reweight(log_weights, (x[:, j] - mean) / scale, scale)
        return x


def _by_chunks(function: Callable[[FloatArray], FloatArray], points: FloatArray, columns: int) -> FloatArray:
    out = np.empty((len(points), columns))
    for start in range(0, len(points), CHUNK_ROWS):
        out[start : start + CHUNK_ROWS] = function(points[start : start + CHUNK_ROWS])
    return out


def _as_finite(name: str, values: ArrayLike) -> FloatArray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers: {error}.") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite.")
    return array


def _check_shapes(weights: FloatArray, means: FloatArray, covariances: FloatArray, *bounds: FloatArray) -> None:
    if means.ndim != 2 or means.size == 0:
        raise ValueError(f"Expected means of shape (K, d), got {means.shape}.")
    k, d = means.shape
    wanted = {"weights": (k,), "covariances": (k, d, d), "low": (d,), "high": (d,)}
    for (name, shape), array in zip(wanted.items(), (weights, covariances, *bounds), strict=True):
        if array.shape != shape:
            raise ValueError(f"Expected {name} of shape {shape} to go with means {means.shape}, got {array.shape}.")


def _check_values(weights: FloatArray, low: FloatArray, high: FloatArray) -> None:
    if (weights <= 0).any():
        raise ValueError(f"weights must be positive, got {weights.min():g}; drop that component.")
    if abs(weights.sum() - 1.0) > 1e-9:
        raise ValueError(f"weights must sum to 1, got {weights.sum():.12g}.")
    if (low >= high).any():
        j = int(np.argmax(low >= high))
        raise ValueError(f"low must be below high, got [{low[j]:g}, {high[j]:g}] at coordinate {j}.")


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
    """Return the coefficients of coordinate j on the earlier ones, per component: (K, j) for each j."""
    out = []
    for j in range(covariances.shape[1]):
        solution = np.linalg.solve(covariances[:, :j, :j], covariances[:, :j, j, None])
        out.append(np.asarray(solution[:, :, 0], dtype=np.float64))
    return tuple(out)
