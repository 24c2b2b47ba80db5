"""Gaussian mixtures in a box: the base distributions of most scenarios, exact in every direction.

A mixture is taken one coordinate at a time, each conditional cut to its range. Density, draws and the maps to and from
standard normal space use one-dimensional normal distribution functions only, so they stay accurate far from the bulk.
Every operation works row by row: a row of the result does not depend, bit for bit, on the other rows of the call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rare_envs.distributions.coordinates import CoordinateKind, Coordinates, FloatArray, as_finite, move_inside
from rare_envs.distributions.space import (
    DistributionParameter,
    MixtureArrays,
    arrays_of,
    list_mixture_parameters,
    set_mixture_parameters,
)
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
BOX_FIELDS = ("low", "high")


class ConditioningState(NamedTuple):
    """What the earlier coordinates of rows say about the next, of K components and n rows."""

    log_weights: FloatArray
    """Logarithms of the weights of the components times their densities of the earlier coordinates, shape (K, n).

    (K, 1) before the first coordinate, where all rows are alike."""
    residuals: tuple[FloatArray, ...] = ()
    """Standardised residuals of the earlier coordinates, shape (K, n) each."""


class BoxPoints(NamedTuple):
    """What the density of n points depends on: m of them are in the box, moved off its faces by a float."""

    inside: NDArray[np.bool_]
    """Which they are, (n,)."""
    y: FloatArray
    """Coordinates in their order, (d, m)."""
    ranges: tuple[tuple[Any, Any], ...]
    """Lower and upper ends of each coordinate: numbers, or (m,)."""
    log_jacobian: FloatArray
    """log |det dy/dx|, (m,)."""

    @classmethod
    def of(cls, coordinates: Coordinates, x: FloatArray) -> BoxPoints:
        """Return what the density of points x (n, d), in the box or not, depends on."""
        columns = np.ascontiguousarray(x.T)  # comparisons by rows take five times as long
        low, high = coordinates.low[:, None], coordinates.high[:, None]
        inside = np.asarray(((columns >= low) & (columns <= high)).all(axis=0))
        inner = coordinates.interior((columns if inside.all() else columns[:, inside]).T)
        y = np.array([coordinates.coordinate(j, inner) for j in coordinates.columns])
        ranges = tuple(coordinates.bounds(j, inner) for j in coordinates.columns)
        return cls(inside, y, ranges, coordinates.log_jacobian(inner))


@dataclass(frozen=True, eq=False)
class CoordinateMixture:
    """The distribution of x in a box whose coordinates y follow a Gaussian mixture with full covariances.

    With f the density of the mixture, and the coordinates in their order, the density is

        p(x) = |det dy/dx| prod_j f(y_j | y_1, ..., y_{j-1}) / P_f(low_j <= Y_j <= high_j | y_1, ..., y_{j-1})

    inside the box and 0 outside: each conditional is cut to its range and renormalised. The range of a closing speed
    follows from the earlier columns of its row, so that no mass leaves the box of x. The jointly truncated
    distribution, f(y) / P_f(box), divides by one constant instead; the two agree up to factors 1 / (1 - mass outside
    the box). Cut conditionals are one-dimensional, which is what makes the Rosenblatt map exact.

    Args:
        coordinates: Coordinates of x, their order, and the box of x.
        weights: Component weights, shape (K,), positive, sum 1.
        means: Component means, shape (K, d), in the order of the coordinates.
        covariances: Component covariances, shape (K, d, d), symmetric positive definite, in the same order.

    Raises:
        ValueError: A shape, weight or covariance is not as above.

    Example:
        >>> from rare_envs.distributions import ClosingSpeed, Coordinates
        >>> coordinates = Coordinates(
        ...     low=[0.0, 0.0, 1.0],
        ...     high=[45.0, 45.0, 150.0],
        ...     kinds=("plain", ClosingSpeed("speed", "gap"), "log"),
        ...     names=("speed", "lead_speed", "gap"),
        ...     order=("speed", "gap", "lead_speed"),
        ... )
        >>> following = CoordinateMixture(coordinates, [1.0], [[20.0, 3.0, 0.0]], [np.diag([9.0, 0.25, 0.04])])
        >>> x = following.from_standard_normal([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        >>> x.round(2).tolist()  # medians; a lead that is 0.2 sqrt(20.09) = 0.9 m/s slower
        [[20.0, 20.0, 20.09], [20.0, 19.1, 20.09]]

    References:
        Rosenblatt, "Remarks on a multivariate transformation", 1952.
    """

    coordinates: Coordinates
    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    _factors: FloatArray = field(init=False, repr=False)  # Cholesky factors, (K, d, d)

    def __post_init__(self) -> None:
        for name in COMPONENT_FIELDS:
            array = as_finite(name, getattr(self, name))  # a field by its name
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        _check_shapes(self.weights, self.means, self.covariances, self.coordinates.dim)
        _check_weights(self.weights)
        object.__setattr__(self, "_factors", _cholesky(self.covariances))

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return self.coordinates.dim

    @property
    def low(self) -> FloatArray:
        """Lower ends of the box of x, shape (d,)."""
        return self.coordinates.low

    @property
    def high(self) -> FloatArray:
        """Upper ends of the box of x, shape (d,)."""
        return self.coordinates.high

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the box.

        Raises:
            ValueError: Wrong shape.
        """
        return self.log_prob_at(BoxPoints.of(self.coordinates, self.rows("x", x)))

    def log_prob_at(self, points: BoxPoints) -> FloatArray:
        """Return the same from what equal coordinates say of n points, (n,)."""
        out = np.full(len(points.inside), -np.inf)
        inner = np.empty(points.y.shape[1])
        for start in range(0, len(inner), CHUNK_ROWS):
            rows = slice(start, start + CHUNK_ROWS)
            ranges = [tuple(end if np.ndim(end) == 0 else end[rows] for end in pair) for pair in points.ranges]
            inner[rows] = self._log_prob(points.y[:, rows], ranges)
        out[points.inside] = inner + points.log_jacobian
        return out

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map points in the box to standard normal space, (n, d) -> (n, d).

        u_j = Phi^-1(P(X_j <= x_j | columns earlier in the order)), so it belongs to column j of x and rises with it. A
        point on a face, whose exact image is infinite, is taken one float inside.

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        points = self.coordinates.interior(self.rows_in_box(x))
        return apply_by_chunks(self._to_normal, points, self.dim)

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points strictly inside the box, (n, d) -> (n, d).

        u -> x -> u returns to 1e-8 for |u| <= 6, unless the box cuts the bulk so hard that neighbouring floats next to
        its face are further apart than that.

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        return apply_by_chunks(self._from_normal, self.finite_rows(u), self.dim)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw points, shape (n, d), by ancestral sampling: per coordinate a component, then its truncated normal.

        2 d uniform numbers per row: the first rows do not depend on n.
        """
        return apply_by_chunks(self._ancestral, rng.random((n, 2 * self.dim)), self.dim)

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return weights, means, standard deviations and correlations of the coordinates, see `HasParameters`."""
        return list_mixture_parameters(self._arrays, self.coordinates, names, arrays_of(like))

    def with_parameters(self, values: ArrayLike) -> CoordinateMixture:
        """Return the mixture with other values of its parameters in the same box; weights are scaled to add up to 1.

        Raises:
            ValueError: There is not one value for each parameter, or there is no such mixture.
        """
        return CoordinateMixture(self.coordinates, *set_mixture_parameters(self._arrays, values))

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists: the mixture's arrays in the order of the coordinates, and the entries of these."""
        # fields by name
        return {**{name: getattr(self, name).tolist() for name in COMPONENT_FIELDS}, **self.coordinates.to_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> CoordinateMixture:
        """Return the distribution that `to_dict` describes; other keys are left alone.

        Raises:
            ValueError: A key is missing or its value is not valid.
        """
        arrays = _pick_fields(data, COMPONENT_FIELDS)
        return CoordinateMixture(Coordinates.from_dict(data), *arrays)

    @property
    def _arrays(self) -> MixtureArrays:
        return MixtureArrays(self.weights, self.means, self.covariances)

    def rows(self, name: str, points: ArrayLike) -> FloatArray:
        """Return points as float64 (n, d), if they have that shape."""
        array = np.asarray(points, dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != self.dim:
            hint = "; add a batch axis" if array.shape == (self.dim,) else ""
            raise ValueError(f"Expected {name} of shape (n, {self.dim}), got {array.shape}{hint}.")
        return array

    def finite_rows(self, u: ArrayLike) -> FloatArray:
        """Return standard normal points as float64 (n, d), if they have that shape and are finite."""
        points = self.rows("u", u)
        if not np.isfinite(points).all():
            i, j = np.argwhere(~np.isfinite(points))[0]
            raise ValueError(f"u[{i}, {j}] = {points[i, j]} must be finite.")
        return points

    def rows_in_box(self, x: ArrayLike) -> FloatArray:
        """Return points as float64 (n, d), if they have that shape and are in the box."""
        points, (low, high) = self.rows("x", x), (self.low, self.high)
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

    def _log_prob(self, y: FloatArray, ranges: Sequence[tuple[Any, ...]]) -> FloatArray:
        """Return the log density of coordinates (d, n) in their ranges, (n,)."""
        out, state = np.zeros(y.shape[1]), self.start()
        for values, (low, high) in zip(y, ranges, strict=True):
            conditional = self.next_conditional(state, (low, high))
            state = self.observe(conditional, state, values)
            density = log_sum(state.log_weights)
            out = out - conditional.log_whole_mass() + density
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

        Conditions by regression coefficients, not by the Cholesky residuals of the map, so that comparing samples with
        the map tests both.
        """
        n = len(uniforms)
        rows = np.arange(n)
        log_weights = np.repeat(self.start().log_weights, n, axis=1)
        x, y = np.empty((n, self.dim)), np.empty((n, self.dim))
        for i, j in enumerate(self.coordinates.columns):
            bounds = self.coordinates.bounds(j, x)
            scale = self._factors[:, i, i, None]
            mean = np.repeat(self.means[:, i, None], n, axis=1)
            for k, slope in enumerate(_regress(self.covariances, i)):
                mean = mean + slope[:, None] * (y[:, k] - self.means[:, k, None])
            low, high = ((end - mean) / scale for end in bounds)
            pick = choose(log_weights + log_interval(low, high, high - low), uniforms[:, 2 * i])
            v = uniforms[:, 2 * i + 1]
            with np.errstate(divide="ignore"):  # v = 0 is the lower end of the box
                z = truncated_quantile(low[pick, rows], high[pick, rows], np.log(v), np.log1p(-v))
            y[:, i] = move_inside(mean[pick, rows] + scale[pick, 0] * z, *bounds)
            x[:, j] = self.coordinates.value(j, y[:, i], x)
            log_weights = reweight(log_weights, (y[:, i] - mean) / scale, scale)
        return x


class TruncatedGaussianMixture(CoordinateMixture):
    """Gaussian mixture with full covariances, truncated to a box coordinate by coordinate, in the order of x.

    A `CoordinateMixture` whose coordinates are x itself; both are equal for d = 1 to the jointly truncated mixture.

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
    """

    def __init__(
        self, weights: ArrayLike, means: ArrayLike, covariances: ArrayLike, low: ArrayLike, high: ArrayLike
    ) -> None:
        """Mix normals in a box."""
        kind: CoordinateKind = "plain"
        kinds = (kind,) * as_finite("low", low).size
        arrays: Any = (weights, means, covariances)
        super().__init__(Coordinates(low, high, kinds), *arrays)  # type: ignore[arg-type]  # made arrays there

    def with_parameters(self, values: ArrayLike) -> TruncatedGaussianMixture:
        """Return the mixture with other values of its parameters in the same box; weights are scaled to add up to 1."""
        return TruncatedGaussianMixture(*set_mixture_parameters(self._arrays, values), self.low, self.high)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists under the names of the constructor's arguments, ready for JSON."""
        return {name: getattr(self, name).tolist() for name in (*COMPONENT_FIELDS, *BOX_FIELDS)}  # fields by name

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TruncatedGaussianMixture:
        """Return the distribution that `to_dict` describes; other keys (names, units, provenance) are left alone."""
        return TruncatedGaussianMixture(*_pick_fields(data, (*COMPONENT_FIELDS, *BOX_FIELDS)))


def apply_by_chunks(
    function: Callable[[FloatArray], FloatArray], points: FloatArray, columns: int, rows: int = CHUNK_ROWS
) -> FloatArray:
    """Return a function of rows, shape (n, columns), computed for some rows at a time."""
    out = np.empty((len(points), columns))
    for start in range(0, len(points), rows):
        out[start : start + rows] = function(points[start : start + rows])
    return out


def _pick_fields(data: Mapping[str, Any], names: Sequence[str]) -> list[Any]:
    """Return the entries of a file with these names."""
    missing = [name for name in names if name not in data]
    if missing:
        raise ValueError(f"Missing {', '.join(missing)}; needed are {', '.join(names)}.")
    return [data[name] for name in names]


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


def _regress(covariances: FloatArray, i: int) -> FloatArray:
    """Return the coefficients of coordinate i on the earlier ones, per component, shape (i, K)."""
    solution = np.linalg.solve(covariances[:, :i, :i], covariances[:, :i, i, None])
    return np.asarray(solution[:, :, 0].T, dtype=np.float64)
