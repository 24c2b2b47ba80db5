"""Pools of Gaussian mixtures with equal weights, in the same coordinates or in different ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, ndtri_exp

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinate_mixture import CoordinateMixture
from rare_envs.distributions.coordinates import Coordinates, move_inside
from rare_envs.distributions.mixture_conditionals import (
    COMPONENT_FIELDS,
    ConditioningState,
    MixtureConditionals,
    apply_by_chunks,
)
from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture
from rare_envs.distributions.truncated_normal import (
    MAX_ITERATIONS,
    RootBracket,
    TailSearch,
    TruncatedConditional,
    guess_quantile,
    log_sum,
    sum_components,
)

BoxMixture = TruncatedGaussianMixture | CoordinateMixture


def pool_mixtures(mixtures: Sequence[BoxMixture]) -> CoordinateMixture | PooledMixture:
    """Return one distribution of all mixtures, each with equal weight.

    Those of the same coordinates become one mixture with the components of all, whose conditionals are cut to the box
    as a whole, not each mixture's by itself. Its density is the mean of their densities up to factors 1 / (1 - mass
    outside the box). Where the coordinates differ, the columns are taken in an order that serves all.

    Args:
        mixtures: In the same box; coordinates and numbers of components may differ.

    Raises:
        ValueError: The boxes differ, or no order of the columns serves all coordinates.

    Example:
        >>> narrow, wide = (TruncatedGaussianMixture([1.0], [[0.0]], [[[s * s]]], [-9.0], [9.0]) for s in (1.0, 2.0))
        >>> np.exp(pool_mixtures([narrow, wide]).log_prob([[0.0]])).round(3).tolist()  # (0.399 + 0.199) / 2
        [0.299]
    """
    for i, each in enumerate(mixtures):
        if not (np.array_equal(each.low, mixtures[0].low) and np.array_equal(each.high, mixtures[0].high)):
            raise ValueError(f"Expected mixtures of the same box, but mixtures 0 and {i} differ.")
    groups: dict[str, list[BoxMixture]] = {}
    for each in mixtures:
        groups.setdefault(json.dumps(_without_names(each.coordinates)), []).append(each)
    pools = [_pool_alike(group) for group in groups.values()]
    if len(pools) == 1:
        return pools[0]
    shares = np.array([len(group) for group in groups.values()]) / len(mixtures)
    return PooledMixture(_align([pool.coordinates for pool in pools], pools), shares)


def number_coordinates(distributions: Sequence[object]) -> tuple[int, ...]:
    """Return a number for the coordinates of each distribution, 0 for those of the first; equal ones have the same.

    The order in which columns are taken makes no other coordinates, and distributions that have none are all alike.
    """
    kinds = [getattr(each, "coordinates", None) for each in distributions]
    names = [None if each is None else json.dumps(each.to_dict()["coordinates"]) for each in kinds]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return tuple(numbers[name] for name in names)


def _without_names(coordinates: Coordinates) -> tuple[object, ...]:
    """Return what tells coordinates apart for a pool: kinds and order of the columns."""
    kinds = coordinates.to_dict()["coordinates"]
    return (kinds, coordinates.columns)


def _pool_alike(mixtures: Sequence[BoxMixture]) -> CoordinateMixture:
    """Return the mixture with the components of mixtures in the same coordinates."""
    weights, means, covariances = (
        np.concatenate([getattr(mixture, name) for mixture in mixtures]) for name in COMPONENT_FIELDS
    )
    return CoordinateMixture(mixtures[0].coordinates, weights / weights.sum(), means, covariances)


def _align(coordinates: Sequence[Coordinates], pools: Sequence[CoordinateMixture]) -> tuple[CoordinateMixture, ...]:
    """Return mixtures with their coordinates in an order that serves all of them: the first of theirs that does."""
    names = next((each.names for each in coordinates if each.names), ())
    reasons = []
    for columns in dict.fromkeys(each.columns for each in coordinates):
        try:
            return tuple(_reorder(pool, names, columns) for pool in pools)
        except ValueError as error:
            reasons.append(str(error))
    raise ValueError(f"No order of the columns serves the coordinates of all mixtures: {reasons[0]}")


def _reorder(mixture: CoordinateMixture, names: tuple[str, ...], columns: tuple[int, ...]) -> CoordinateMixture:
    """Return a mixture with its coordinates in the order of these columns of x.

    Raises:
        ValueError: A coordinate depends on a column that comes later.
    """
    own = mixture.coordinates
    if own.columns == columns:
        return mixture
    places = [own.columns.index(column) for column in columns]
    order = tuple(names[column] for column in columns)
    coordinates = Coordinates(own.low, own.high, own.kinds, own.names or names, order)
    means, covariances = mixture.means[:, places], mixture.covariances[:, places][:, :, places]
    return CoordinateMixture(coordinates, mixture.weights, means, covariances)


class _Part(NamedTuple):
    """One part of a pool while rows are gone through column by column."""

    conditionals: MixtureConditionals
    state: ConditioningState
    log_weight: FloatArray
    """Logarithm of its weight times its density of the earlier columns, shape (n,)."""

    def next_conditional(self, j: int, x: FloatArray) -> TruncatedConditional:
        """Return its distribution of the coordinate of column j."""
        return self.conditionals.next_conditional(self.state, self.conditionals.coordinates.bounds(j, x))

    def quantile_scale(self, j: int, x: FloatArray, conditional: TruncatedConditional) -> FloatArray:
        """Return Phi^-1 of its distribution function of column j at x (n, d)."""
        coordinates = self.conditionals.coordinates
        y = move_inside(coordinates.coordinate(j, x), conditional.low, conditional.high)
        return coordinates.sign(j) * conditional.to_normal(y)

    def ends(self, j: int) -> tuple[float, float]:
        """Return the range of column j."""
        coordinates = self.conditionals.coordinates
        return float(coordinates.low[j]), float(coordinates.high[j])

    def observe(self, j: int, x: FloatArray, conditional: TruncatedConditional) -> _Part:
        """Return the part after column j."""
        coordinates = self.conditionals.coordinates
        y = move_inside(coordinates.coordinate(j, x), conditional.low, conditional.high)
        state = self.conditionals.observe(conditional, self.state, y)
        mass = log_sum(self.state.log_weights + conditional.log_mass())
        density = log_sum(state.log_weights) - mass + coordinates.log_slope(j, x)
        return self._replace(state=state, log_weight=self.log_weight + density)


@dataclass(frozen=True, eq=False)
class PooledMixture:
    """Mixtures in different coordinates of one box, pooled: the density is the weighted mean of theirs.

    The map goes column by column, as that of `CoordinateMixture`: u_j = Phi^-1(P(X_j <= x_j | earlier columns)). That
    distribution function is the mean of those of the parts, weighted by their densities of the earlier columns.

    Args:
        parts: Mixtures in the same box, with the columns in the same order.
        weights: Shares of the parts, shape (G,), sum 1.

    Raises:
        ValueError: The columns differ in order, or there is not one weight for each part.

    Example:
        >>> plain, log = (Coordinates([1.0], [99.0], (kind,), ("gap",)) for kind in ("plain", "log"))
        >>> wide, narrow = [[[9.0]]], [[[0.01]]]
        >>> parts = CoordinateMixture(plain, [1.0], [[20.0]], wide), CoordinateMixture(log, [1.0], [[3.0]], narrow)
        >>> pool = PooledMixture(parts, [0.5, 0.5])
        >>> x = pool.from_standard_normal([[1.0], [3.0]])
        >>> x.round(1).tolist(), pool.to_standard_normal(x).round(6).tolist()
        ([[22.6], [28.4]], [[1.0], [3.0]])
    """

    parts: tuple[CoordinateMixture, ...]
    weights: FloatArray
    _conditionals: tuple[MixtureConditionals, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        object.__setattr__(self, "weights", np.asarray(self.weights, dtype=np.float64))
        if len({part.coordinates.columns for part in self.parts}) != 1:
            raise ValueError("Expected parts with the columns in the same order.")
        if self.weights.shape != (len(self.parts),) or not np.isclose(self.weights.sum(), 1.0):
            raise ValueError(f"Expected {len(self.parts)} weights with sum 1, got {self.weights.tolist()}.")
        own = tuple(MixtureConditionals(p.coordinates, p.weights, p.means, p.covariances) for p in self.parts)
        object.__setattr__(self, "_conditionals", own)

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return self.parts[0].dim

    @property
    def low(self) -> FloatArray:
        """Lower ends of the box, shape (d,)."""
        return self.parts[0].low

    @property
    def high(self) -> FloatArray:
        """Upper ends of the box, shape (d,)."""
        return self.parts[0].high

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the box."""
        return log_sum(np.stack([part.log_prob(x) for part in self.parts]) + np.log(self.weights)[:, None])

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d); the first rows do not depend on n."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map points in the box to standard normal space, (n, d) -> (n, d).

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        points = self.parts[0].coordinates.interior(self._conditionals[0].rows_in_box(x))
        return apply_by_chunks(self._to_normal, points, self.dim)

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points strictly inside the box, (n, d) -> (n, d).

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        return apply_by_chunks(self._from_normal, self._conditionals[0].finite_rows(u), self.dim)

    def _start(self, n: int) -> list[_Part]:
        logs = np.log(self.weights)
        pairs = zip(self._conditionals, logs, strict=True)
        return [_Part(own, own.start(n), np.full(n, log_weight)) for own, log_weight in pairs]

    def _to_normal(self, x: FloatArray) -> FloatArray:
        parts, u = self._start(len(x)), np.empty_like(x)
        for j in self.parts[0].coordinates.columns:
            conditionals = [part.next_conditional(j, x) for part in parts]
            u[:, j] = _pooled_quantile_scale(j, x, parts, conditionals)
            parts = [part.observe(j, x, each) for part, each in zip(parts, conditionals, strict=True)]
        return u

    def _from_normal(self, u: FloatArray) -> FloatArray:
        parts, x = self._start(len(u)), np.empty_like(u)
        for j in self.parts[0].coordinates.columns:
            conditionals = [part.next_conditional(j, x) for part in parts]
            x[:, j] = _find_quantile(j, x, u[:, j], parts, conditionals)
            parts = [part.observe(j, x, each) for part, each in zip(parts, conditionals, strict=True)]
        return x


def _pooled_quantile_scale(
    j: int, x: FloatArray, parts: Sequence[_Part], conditionals: Sequence[TruncatedConditional]
) -> FloatArray:
    """Return Phi^-1 of the pooled distribution function of column j at x (n, d), by the smaller tail."""
    pairs = zip(parts, conditionals, strict=True)
    scores = np.stack([part.quantile_scale(j, x, conditional) for part, conditional in pairs])
    log_weights = np.stack([part.log_weight for part in parts])
    lower, upper = log_sum(log_weights + log_ndtr(scores)), log_sum(log_weights + log_ndtr(-scores))
    tail = np.minimum(lower, upper) - np.logaddexp(lower, upper)
    return np.asarray(np.where(lower <= upper, 1.0, -1.0) * ndtri_exp(tail))


def _find_quantile(
    j: int, x: FloatArray, u: FloatArray, parts: Sequence[_Part], conditionals: Sequence[TruncatedConditional]
) -> FloatArray:
    """Return the value of column j at which the pooled distribution function is Phi(u), (n,); each row stops by itself.

    Positive u are solved in the mirror image, as those of one mixture are (`RootBracket`).
    """
    sign = np.where(u > 0, -1.0, 1.0)
    pool = _PooledTail.of(j, x, u, parts, conditionals)
    low, high = parts[0].ends(j)
    left, right = np.where(u > 0, -high, low), np.where(u > 0, -low, high)
    search = RootBracket(-np.abs(u), np.clip(sign * pool.guess(), left, right), left, right, right - left)
    found, rows = sign * search.x, np.arange(len(u))
    for _ in range(MAX_ITERATIONS):
        search, done = search.advance(*pool.log_cdf_and_density(sign[rows] * search.x))
        found[rows] = sign[rows] * search.x
        keep = np.flatnonzero(~done)
        if keep.size == 0:
            break
        if keep.size < len(rows):
            rows, search, pool = rows[keep], search.take(keep), pool.take(keep)
    return np.asarray(found)


class _Tail(NamedTuple):
    """The distribution function of column j of one part, read from the tail in which the root is; row by row."""

    coordinates: Coordinates
    log_weight: FloatArray
    """Logarithm of the part's weight given the earlier columns, (n,)."""
    mirrored: NDArray[np.bool_]
    """Rows whose tail is the upper one of the coordinate, (n,)."""
    low: FloatArray
    high: FloatArray
    """Range of the coordinate, (n,)."""
    search: TailSearch

    @classmethod
    def of(cls, part: _Part, conditional: TruncatedConditional, j: int, u: FloatArray, log_total: FloatArray) -> _Tail:
        """Return the tail of a part with a first guess; what does not depend on column j is computed once."""
        coordinates = part.conditionals.coordinates
        mirrored = coordinates.sign(j) * u > 0
        mirror = conditional.mirror(mirrored)
        score = mirror.log_weights + mirror.log_mass()
        below = -np.abs(u)
        search = TailSearch.start(mirror, log_sum(score), below, guess_quantile(mirror, below, score))
        low, high = (np.broadcast_to(end, len(u)) for end in (conditional.low, conditional.high))
        return cls(coordinates, part.log_weight - log_total, mirrored, low, high, search)

    def guess(self, j: int, x: FloatArray) -> FloatArray:
        """Return the part's own guess of column j for rows x (n, d), (n,)."""
        y = np.where(self.mirrored, -self.search.x, self.search.x)
        return self.coordinates.value(j, move_inside(y, self.low, self.high), x)

    def log_cdf_and_density(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return logarithms at column j of x (n, d): the part's weight times its mass in the tail, and its density."""
        y = move_inside(self.coordinates.coordinate(j, x), self.low, self.high)
        log_cdf, log_density = self.search._replace(x=np.where(self.mirrored, -y, y)).log_cdf_and_density()
        tail = np.minimum(log_cdf - self.search.mass, 0.0)
        slope = self.coordinates.log_slope(j, x)
        return self.log_weight + tail, self.log_weight + log_density - self.search.mass + slope

    def take(self, rows: NDArray[np.intp]) -> _Tail:
        """Return those of some rows."""
        return _Tail(
            self.coordinates,
            self.log_weight[rows],
            self.mirrored[rows],
            self.low[rows],
            self.high[rows],
            self.search.take(rows),
        )


class _PooledTail(NamedTuple):
    """The distribution function of column j of the pool, read from the tail in which the root is; row by row."""

    j: int
    x: FloatArray
    """With the columns before j, shape (n, d); column j is written over."""
    tails: list[_Tail]

    @classmethod
    def of(
        cls, j: int, x: FloatArray, u: FloatArray, parts: Sequence[_Part], conditionals: Sequence[TruncatedConditional]
    ) -> _PooledTail:
        """Return the tails of all parts, for all rows."""
        log_total = log_sum(np.stack([part.log_weight for part in parts]))
        pairs = zip(parts, conditionals, strict=True)
        return cls(j, x.copy(), [_Tail.of(part, conditional, j, u, log_total) for part, conditional in pairs])

    def guess(self) -> FloatArray:
        """Return the mean of the parts' guesses of the root by their weights, (n,)."""
        return sum_components(np.stack([np.exp(each.log_weight) * each.guess(self.j, self.x) for each in self.tails]))

    def log_cdf_and_density(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the logarithms of the mass in the tail up to values (n,), and of the density there."""
        self.x[:, self.j] = values
        pairs = [each.log_cdf_and_density(self.j, self.x) for each in self.tails]
        log_cdf, log_density = (log_sum(np.stack(each)) for each in zip(*pairs, strict=True))
        return np.minimum(log_cdf, 0.0), log_density

    def take(self, rows: NDArray[np.intp]) -> _PooledTail:
        """Return those of some rows."""
        return _PooledTail(self.j, self.x[rows], [each.take(rows) for each in self.tails])
