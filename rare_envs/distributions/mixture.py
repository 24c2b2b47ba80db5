"""Gaussian mixtures in a box: the traffic models of most scenarios, exact in every direction.

A mixture is taken one coordinate at a time, each conditional cut to its range. Density, draws and the maps to and from
standard normal space use one-dimensional normal distribution functions only, so they stay accurate far from the bulk.
Every operation works row by row: a row of the result does not depend, bit for bit, on the other rows of the call.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from rare_envs.distributions.coordinates import (
    ClosingSpeed,
    Coordinates,
    FloatArray,
    freeze_arrays,
    move_inside,
    pick_fields,
    read_rows,
)
from rare_envs.distributions.space import (
    RELATIVE_CHANGE,
    Distribution,
    DistributionParameter,
    check_values,
    name_columns,
)
from rare_envs.distributions.truncated_normal import LOG_SQRT_2PI, TruncatedConditional, log_sum

CHUNK = 16384
"""Rows times components worked on together: the temporaries of one chunk stay in the cache."""
COMPONENT_FIELDS = ("weights", "means", "covariances")
CORRELATION_CHANGE = 0.1
"""Change of a correlation for which sensitivities are stated."""


class MappedMixture:
    """Mixtures in one box, taken column by column: u_j = Phi^-1(P(X_j <= x_j | earlier columns)).

    The distribution function of several is the mean of theirs, weighted by their densities of the earlier columns.
    """

    parts: tuple[TruncatedGaussianMixture, ...]
    """Mixtures in the same box, with the columns in the same order."""
    shares: FloatArray = np.ones(1)
    """Weights of the parts, (G,), sum 1."""
    coordinates: Coordinates
    """Those in which the map is computed: of a single part its own."""

    low: FloatArray
    high: FloatArray

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return self.coordinates.dim

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map points in the box to standard normal space, (n, d) -> (n, d).

        u_j belongs to column j of x and rises with it. A point on a face, whose exact image is infinite, is taken one
        float inside.

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        points = read_rows("x", x, self.dim)
        outside = ~self.coordinates.contains(points)
        if outside.any():
            i, j = map(int, np.argwhere(outside)[0])
            low, high = (float(np.squeeze(end)) for end in self.coordinates.range_of(j, points[i : i + 1]))
            raise ValueError(
                f"x[{i}, {j}] = {points[i, j]:g} is outside the range [{low:g}, {high:g}] of coordinate {j} there; "
                "only points in their ranges have an image."
            )
        return self._by_chunks(self._to_normal, self.coordinates.interior(points))

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points strictly inside the box, (n, d) -> (n, d).

        u -> x -> u returns to 1e-8 for |u| <= 6, unless the box cuts the bulk so hard that neighbouring floats next to
        its face are further apart than that.

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        points = read_rows("u", u, self.dim)
        if not np.isfinite(points).all():
            i, j = np.argwhere(~np.isfinite(points))[0]
            raise ValueError(f"u[{i}, {j}] = {points[i, j]} must be finite.")
        return self._by_chunks(self._from_normal, points)

    def _by_chunks(self, function: Callable[[FloatArray], FloatArray], points: FloatArray) -> FloatArray:
        """Return a function of rows, computed for some rows at a time."""
        size = max(1, CHUNK // sum(len(part.weights) for part in self.parts))
        chunks = [function(points[start : start + size]) for start in range(0, max(len(points), 1), size)]
        return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)

    def _to_normal(self, x: FloatArray) -> FloatArray:
        u = np.empty(x.shape)
        for j, column in self._conditionals(x):
            v = column.to_normal(self.coordinates.coordinate(j, x))
            u[:, j] = v if self.coordinates.rises(j) else -v
        return u

    def _from_normal(self, u: FloatArray) -> FloatArray:
        x = np.empty(u.shape)
        for j, column in self._conditionals(x):
            self._set(j, column, column.from_normal(u[:, j] if self.coordinates.rises(j) else -u[:, j]), x)
        return x

    def _set(self, j: int, column: TruncatedConditional, y: FloatArray, x: FloatArray) -> None:
        """Set column j of rows x to what belongs to its coordinate y (n,), inside the box."""
        value = self.coordinates.value(j, move_inside(y, column.low, column.high), x)
        x[:, j] = move_inside(value, *self.coordinates.range_of(j, x))

    def _conditionals(self, x: FloatArray) -> Iterator[tuple[int, TruncatedConditional]]:
        """Yield columns and their distributions given the earlier ones of x (n, d), which may be set on the way."""
        walks, columns = [Walk(part, x) for part in self.parts], self.coordinates.columns
        weights = np.log(self.shares)[:, None] + np.zeros(len(x))
        for j in columns:
            own = [walk.start_column(j) for walk in walks]
            yield j, own[0] if len(own) == 1 else self._join(j, x, own, weights)
            if j != columns[-1]:
                for part, walk, row in zip(self.parts, walks, weights, strict=True):
                    walk.observe(j)
                    if len(walks) > 1:
                        row += walk.take_density() + part.coordinates.log_slope(j, x)

    def _join(
        self, j: int, x: FloatArray, own: Sequence[TruncatedConditional], weights: FloatArray
    ) -> TruncatedConditional:
        """Return the distribution of column j with the components of all parts, whose log weights (G, n) it changes."""
        sizes = [len(part.weights) for part in self.parts]
        joined, ends = np.empty((3, sum(sizes), len(x))), np.cumsum(sizes)
        for part, each, row, size, end in zip(self.parts, own, weights, sizes, ends, strict=True):
            row -= each.log_whole_mass()
            shift, slope = part.coordinates.line(j, x)
            arrays = each.log_weights + row, shift + slope * each.mean, np.abs(slope) * each.scale
            for out, array in zip(joined, arrays, strict=True):
                out[end - size : end] = array
        logs = np.repeat([part.coordinates.is_log(j) for part in self.parts], sizes)[:, None]
        shares, mean, scale = joined
        return TruncatedConditional(shares, mean, scale, *self.coordinates.range_of(j, x), logs if logs.any() else None)


class Walk:
    """A mixture on its way through points x (n, d), each column conditioned on the earlier ones; arrays are (K, n)."""

    def __init__(self, mixture: TruncatedGaussianMixture, x: FloatArray) -> None:
        self._coordinates, self._x = mixture.coordinates, x
        self._means, self._factors = mixture.means[..., None], mixture.factors[..., None]
        self._log_weights: FloatArray = np.log(mixture.weights)[:, None]
        self._residuals: list[FloatArray] = []
        self._column: TruncatedConditional

    def start_column(self, j: int) -> TruncatedConditional:
        """Return the distribution of the coordinate of column j, the next in the order."""
        i = len(self._residuals)
        mean = self._means[:, i]
        for k, residual in enumerate(self._residuals):
            mean = mean + self._factors[:, i, k] * residual
        bounds = self._coordinates.bounds(j, self._x)
        self._column = TruncatedConditional(self._log_weights, mean, self._factors[:, i, i], *bounds)
        return self._column

    def observe(self, j: int) -> None:
        """Take column j as it is in x."""
        column = self._column
        y = move_inside(self._coordinates.coordinate(j, self._x), column.low, column.high)
        residual = (y - column.mean) / column.scale
        self._log_weights = self._log_weights - 0.5 * residual * residual - np.log(column.scale) - LOG_SQRT_2PI
        self._residuals.append(residual)

    def take_density(self) -> FloatArray:
        """Return the log density, not cut, of the coordinate observed last given the earlier ones, (n,)."""
        density = log_sum(self._log_weights)
        self._log_weights = self._log_weights - density  # relative to it, so that far points do not run away
        return density


@dataclass(frozen=True, eq=False)
class TruncatedGaussianMixture(MappedMixture):
    """The distribution of x in a box whose coordinates y follow a Gaussian mixture with full covariances.

    With f the density of the mixture, and the coordinates in their order, the density is

        p(x) = |det dy/dx| prod_j f(y_j | y_1, ..., y_{j-1}) / P_f(low_j <= Y_j <= high_j | y_1, ..., y_{j-1})

    inside the box and 0 outside: each conditional is cut to its range and renormalised. The range of a closing speed
    follows from the earlier columns of its row, so that no mass leaves the box of x. The jointly truncated
    distribution, f(y) / P_f(box), divides by one constant instead; the two agree up to factors 1 / (1 - mass outside
    the box), and are equal for d = 1. Cut conditionals are one-dimensional, which is what makes the Rosenblatt map
    exact.

    Args:
        weights: Component weights, shape (K,), positive, sum 1.
        means: Component means, shape (K, d), in the order of the coordinates.
        covariances: Component covariances, shape (K, d, d), symmetric positive definite, in the same order.
        low: Lower bounds of the box, shape (d,), finite.
        high: Upper bounds of the box, shape (d,), finite, above `low`.
        coordinates: Coordinates of x, their order, and the box unless `low` and `high` are given; x itself by default.

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
        >>> coordinates = Coordinates(
        ...     low=[0.0, 0.0, 1.0],
        ...     high=[45.0, 45.0, 150.0],
        ...     kinds=("plain", ClosingSpeed("speed", "gap"), "log"),
        ...     names=("speed", "lead_speed", "gap"),
        ...     order=("speed", "gap", "lead_speed"),
        ... )
        >>> deviations = np.diag([9.0, 0.25, 0.04])
        >>> following = TruncatedGaussianMixture([1.0], [[20.0, 3.0, 0.0]], [deviations], coordinates=coordinates)
        >>> x = following.from_standard_normal([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        >>> x.round(2).tolist()  # medians; a lead that is 0.2 sqrt(20.09) = 0.9 m/s slower
        [[20.0, 20.0, 20.09], [20.0, 19.1, 20.09]]

    References:
        Rosenblatt, "Remarks on a multivariate transformation", 1952.
    """

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    low: FloatArray = None  # type: ignore[assignment]  # an array once it is made, as the next two
    high: FloatArray = None  # type: ignore[assignment]
    coordinates: Coordinates = None  # type: ignore[assignment]
    factors: FloatArray = field(init=False, repr=False)
    """Cholesky factors of the covariances, (K, d, d)."""

    def __post_init__(self) -> None:
        own = self.coordinates
        low, high = (own.low if self.low is None else self.low), (own.high if self.high is None else self.high)
        made = Coordinates(low, high) if own is None else replace(own, low=low, high=high)
        freeze_arrays(self, *COMPONENT_FIELDS)
        for name, value in (("coordinates", made), ("low", made.low), ("high", made.high)):
            object.__setattr__(self, name, value)
        self._check()
        object.__setattr__(self, "factors", _cholesky(self.covariances))

    @property
    def parts(self) -> tuple[TruncatedGaussianMixture, ...]:  # type: ignore[override]  # read alone
        """Itself."""
        return (self,)

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the box and beyond `Coordinates.ends`.

        Raises:
            ValueError: Wrong shape.
        """
        points = read_rows("x", x, self.dim)
        inside = self.coordinates.contains(points).all(axis=1)
        out = np.full(len(points), -np.inf)
        out[inside] = self._by_chunks(self._log_density, self.coordinates.interior(points[inside]))
        return out

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw points, shape (n, d), by ancestral sampling: per coordinate a component, then its truncated normal.

        2 d uniform numbers per row: the first rows do not depend on n.
        """
        return self._by_chunks(self._draw, rng.random((n, 2 * self.dim)))

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return weights (of several components), means, standard deviations and correlations, by component.

        The components are numbered as those of `like`, if this is a mixture of as many, or fitted as one.
        """
        found: list[DistributionParameter] = []
        k, columns = len(self.weights), tuple(names) or self.coordinates.names or name_columns(self.dim)
        order, like = list(range(k)), getattr(like, "distribution", like)
        if isinstance(like, TruncatedGaussianMixture) and len(like.weights) == k:
            order = _match_components(self, like)
        if k > 1:
            for number, weight in enumerate(self.weights[order].tolist(), start=1):
                change = RELATIVE_CHANGE * weight
                found.append(DistributionParameter(f"weight of component {number}", weight, change, "10 %"))
        for number, c in enumerate(order, start=1):
            found += self._list_component(c, columns, f" (component {number})" if k > 1 else "")
        return tuple(found)

    def with_parameters(self, values: ArrayLike) -> TruncatedGaussianMixture:
        """Return the mixture with other values of its parameters in the same box; weights are scaled to add up to 1.

        Raises:
            ValueError: There is not one value for each parameter, or there is no such mixture.
        """
        given = np.asarray(values, dtype=np.float64)
        k, d = self.means.shape
        own, n_weights = 2 * d + d * (d - 1) // 2, k if k > 1 else 0
        check_values(given, n_weights + k * own)
        weights = given[:n_weights] / given[:n_weights].sum() if n_weights else self.weights
        parts = given[n_weights:].reshape(k, own)
        correlations, below = np.tile(np.eye(d), (k, 1, 1)), np.tril_indices(d, -1)
        correlations[:, below[0], below[1]] = correlations[:, below[1], below[0]] = parts[:, 2 * d :]
        sd = parts[:, d : 2 * d]
        covariances = correlations * (sd[:, :, None] * sd[:, None, :])
        return TruncatedGaussianMixture(weights, parts[:, :d], covariances, coordinates=self.coordinates)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists: the mixture's arrays in the order of the coordinates, and the entries of these."""
        # fields by name
        return {**{name: getattr(self, name).tolist() for name in COMPONENT_FIELDS}, **self.coordinates.to_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TruncatedGaussianMixture:
        """Return the distribution that `to_dict` describes; other keys (units, provenance) are left alone.

        Raises:
            ValueError: A key is missing or its value is not valid.
        """
        weights, means, covariances, _, _ = pick_fields(data, (*COMPONENT_FIELDS, "low", "high"))
        return cls(weights, means, covariances, coordinates=Coordinates.from_dict(data))

    def _log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density at points inside the box, (n,)."""
        walk, density = Walk(self, x), self.coordinates.log_jacobian(x)
        for j in self.coordinates.columns:
            mass = walk.start_column(j).log_whole_mass()
            walk.observe(j)
            density = density - mass + walk.take_density()
        return density

    def _draw(self, uniforms: FloatArray) -> FloatArray:
        """Return draws (n, d) from uniforms (n, 2 d)."""
        x = np.empty((len(uniforms), self.dim))
        for i, (j, column) in enumerate(self._conditionals(x)):
            self._set(j, column, column.draw(uniforms[:, 2 * i], uniforms[:, 2 * i + 1]), x)
        return x

    def _list_component(self, c: int, names: Sequence[str], end: str) -> list[DistributionParameter]:
        """Return means, standard deviations and correlations of one component."""
        coordinates, sd = self.coordinates, np.sqrt(np.diag(self.covariances[c]))
        correlation = self.covariances[c] / np.outer(sd, sd)
        labels, columns = [], coordinates.columns
        for j in columns:
            linear = "" if coordinates.rises(j) else "closing to "
            labels.append(f"{'log ' if coordinates.is_log(j) else linear}{names[j]}")
        found = []
        for label, value, deviation, j in zip(labels, self.means[c].tolist(), sd.tolist(), columns, strict=True):
            found.append(DistributionParameter(f"mean of {label}{end}", value, deviation, "1 sd", (j,)))
        for label, deviation, j in zip(labels, sd.tolist(), columns, strict=True):
            change = RELATIVE_CHANGE * deviation
            found.append(DistributionParameter(f"sd of {label}{end}", deviation, change, "10 %", (j,)))
        for later, earlier in zip(*np.tril_indices(self.dim, -1), strict=True):
            name = f"correlation of {labels[earlier]} and {labels[later]}{end}"
            value, pair = float(correlation[later, earlier]), (columns[earlier], columns[later])
            found.append(DistributionParameter(name, value, CORRELATION_CHANGE, f"{CORRELATION_CHANGE:g}", pair))
        return found

    def _check(self) -> None:
        """Raise a ValueError unless there are as many weights, means and covariances, and weights sum to 1."""
        if self.means.ndim != 2 or self.means.size == 0:
            raise ValueError(f"Expected means of shape (K, d), got {self.means.shape}.")
        k, d = self.means.shape
        for name, shape in (("weights", (k,)), ("covariances", (k, d, d))):
            array = getattr(self, name)  # a field by its name
            if array.shape != shape:
                raise ValueError(
                    f"Expected {name} of shape {shape} to go with means {self.means.shape}, got {array.shape}."
                )
        if d != self.dim:
            raise ValueError(f"Expected means of shape ({k}, {self.dim}), one for each column, got {(k, d)}.")
        if (self.weights <= 0).any():
            raise ValueError(f"weights must be positive, got {self.weights.min():g}; drop that component.")
        if abs(self.weights.sum() - 1.0) > 1e-9:
            raise ValueError(f"weights must sum to 1, got {self.weights.sum():.12g}.")


class PooledMixture(MappedMixture):
    """Mixtures in different coordinates of one box, pooled: the density is the weighted mean of theirs."""

    def __init__(self, parts: Sequence[TruncatedGaussianMixture], shares: FloatArray) -> None:
        """Pool mixtures with the columns in the same order."""
        own = parts[0].coordinates
        self.parts, self.shares, self.low, self.high = tuple(parts), shares, own.low, own.high
        self.coordinates = Coordinates(own.low, own.high, names=own.names, order=own.order, within=own.within)

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the box."""
        return log_sum(np.stack([part.log_prob(x) for part in self.parts]) + np.log(self.shares)[:, None])

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d); the first rows do not depend on n."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))


def pool_mixtures(mixtures: Sequence[Distribution]) -> TruncatedGaussianMixture | PooledMixture:
    """Return one distribution of mixtures in the same box, each with equal weight; a ValueError for any others.

    Those of the same coordinates become one mixture with the components of all, whose conditionals are cut to the box
    as a whole, not each mixture's by itself: its density is the mean of theirs up to factors 1 / (1 - mass outside the
    box). If the coordinates differ, the columns are taken in an order that serves all.
    """
    groups: dict[str, list[TruncatedGaussianMixture]] = {}
    for i, each in enumerate(mixtures):
        if not isinstance(each, TruncatedGaussianMixture):
            raise ValueError("An ensemble needs refits that are Gaussian mixtures.")
        first = next(iter(groups.values()))[0] if groups else each
        if not (np.array_equal(each.low, first.low) and np.array_equal(each.high, first.high)):
            raise ValueError(f"Expected mixtures of the same box, but mixtures 0 and {i} differ.")
        groups.setdefault(f"{name_kinds(each)} {each.coordinates.columns}", []).append(each)
    pools = [_pool_alike(group) for group in groups.values()]
    if len(pools) == 1:
        return pools[0]
    return PooledMixture(_align(pools), np.array([len(group) for group in groups.values()]) / len(mixtures))


def name_kinds(distribution: object) -> str:
    """Return a text that tells the coordinates of a mixture from others; empty for any other distribution.

    Neither the order in which columns are taken nor their names make other coordinates.
    """
    if not isinstance(distribution, TruncatedGaussianMixture):
        return ""
    own = distribution.coordinates
    pairs = [
        (own.names.index(k.behind), own.names.index(k.gap)) if isinstance(k, ClosingSpeed) else k for k in own.kinds
    ]
    return json.dumps(pairs)


def _pool_alike(mixtures: Sequence[TruncatedGaussianMixture]) -> TruncatedGaussianMixture:
    """Return the mixture with the components of mixtures in the same coordinates."""
    weights, means, covariances = (
        np.concatenate([getattr(mixture, name) for mixture in mixtures]) for name in COMPONENT_FIELDS
    )
    coordinates = mixtures[0].coordinates
    return TruncatedGaussianMixture(weights / weights.sum(), means, covariances, coordinates=coordinates)


def _align(pools: Sequence[TruncatedGaussianMixture]) -> list[TruncatedGaussianMixture]:
    """Return mixtures with their coordinates in an order that serves all of them: the first of theirs that does."""
    coordinates = [pool.coordinates for pool in pools]
    names = next((each.names for each in coordinates if each.names), ())
    reasons = []
    for columns in dict.fromkeys(each.columns for each in coordinates):
        try:
            return [_reorder(pool, names, columns) for pool in pools]
        except ValueError as error:
            reasons.append(str(error))
    raise ValueError(f"No order of the columns serves the coordinates of all mixtures: {reasons[0]}")


def _reorder(
    mixture: TruncatedGaussianMixture, names: tuple[str, ...], columns: tuple[int, ...]
) -> TruncatedGaussianMixture:
    """Return a mixture with its coordinates in the order of these columns of x."""
    own = mixture.coordinates
    if own.columns == columns:
        return mixture
    places = [own.columns.index(column) for column in columns]
    order = tuple(names[column] for column in columns)
    coordinates = Coordinates(own.low, own.high, own.kinds, own.names or names, order, own.within, own.origins)
    means, covariances = mixture.means[:, places], mixture.covariances[:, places][:, :, places]
    return TruncatedGaussianMixture(mixture.weights, means, covariances, coordinates=coordinates)


def _match_components(mixture: TruncatedGaussianMixture, like: TruncatedGaussianMixture) -> list[int]:
    """Return the components of a mixture in the numbering of another with as many.

    The assignment has the least sum of squared distances of means, standard deviations and logarithms of weights, in
    standard deviations of the other's components.
    """
    sd, other_sd = (np.sqrt(np.diagonal(each.covariances, axis1=1, axis2=2)) for each in (mixture, like))
    means = ((mixture.means[:, None] - like.means) / other_sd) ** 2
    spreads = np.log(sd[:, None] / other_sd) ** 2
    weights = np.log(mixture.weights[:, None] / like.weights) ** 2
    _, places = linear_sum_assignment(means.sum(axis=2) + spreads.sum(axis=2) + weights)
    return [int(component) for component in np.argsort(places)]


def _cholesky(covariances: FloatArray) -> FloatArray:
    """Return the Cholesky factors of covariances (K, d, d), or raise a ValueError that says which has none."""
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
