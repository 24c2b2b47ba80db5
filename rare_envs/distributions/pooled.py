"""Pools of Gaussian mixtures with equal weights, in the same coordinates or in different ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import Coordinates, move_inside
from rare_envs.distributions.mixture import (
    COMPONENT_FIELDS,
    BoxPoints,
    ConditioningState,
    CoordinateMixture,
    TruncatedGaussianMixture,
    apply_by_chunks,
)
from rare_envs.distributions.space import Distribution
from rare_envs.distributions.truncated_normal import (
    MIN_U,
    TAIL_U,
    Tail,
    TruncatedConditional,
    find_root,
    log_sum,
    quantile_scale,
    solve,
    sum_components,
)

MIN_SHARE = 1e-20
"""Parts with a smaller share than this may be left out."""


class Refits(tuple[Distribution, ...]):
    """Distributions of the same X, of which densities are computed together."""

    __slots__ = ()

    def log_probs(self, x: FloatArray) -> FloatArray:
        """Return the log density of each, (n, d) -> (R, n); where points are in equal coordinates is found once."""
        known: dict[tuple[object, ...], BoxPoints] = {}
        out = np.empty((len(self), len(x)))
        for row, each in zip(out, self, strict=True):
            # A class of the user's below one of these may have another density.
            if type(each) in (CoordinateMixture, TruncatedGaussianMixture):
                assert isinstance(each, CoordinateMixture)
                key = each.coordinates.key
                if key not in known:
                    known[key] = BoxPoints.of(each.coordinates, each.rows("x", x))
                row[:] = each.log_prob_at(known[key])
            else:
                values = np.asarray(each.log_prob(x))
                if values.shape != row.shape:
                    raise ValueError(f"Expected log_prob of a refit of shape {row.shape}, got {values.shape}.")
                row[:] = values
        return out


def pool_mixtures(mixtures: Sequence[CoordinateMixture]) -> CoordinateMixture | PooledMixture:
    """Return one distribution of all mixtures, each with equal weight.

    Those of the same coordinates become one mixture with the components of all, whose conditionals are cut to the box
    as a whole, not each mixture's by itself. Its density is the mean of their densities up to factors 1 / (1 - mass
    outside the box). Where the coordinates differ, the columns are taken in an order that serves all.

    Args:
        mixtures: In the same box; coordinates and numbers of components may differ.
    """
    for i, each in enumerate(mixtures):
        if not (np.array_equal(each.low, mixtures[0].low) and np.array_equal(each.high, mixtures[0].high)):
            raise ValueError(f"Expected mixtures of the same box, but mixtures 0 and {i} differ.")
    groups: dict[str, list[CoordinateMixture]] = {}
    for each in mixtures:  # names do not tell coordinates apart
        key = json.dumps((each.coordinates.to_dict()["coordinates"], each.coordinates.columns))
        groups.setdefault(key, []).append(each)
    pools = [_pool_alike(group) for group in groups.values()]
    if len(pools) == 1:
        return pools[0]
    shares = np.array([len(group) for group in groups.values()]) / len(mixtures)
    return PooledMixture(_align(pools), shares)


def number_coordinates(distributions: Sequence[object]) -> tuple[int, ...]:
    """Return a number for the coordinates of each distribution, 0 for those of the first; equal ones have the same.

    The order in which columns are taken makes no other coordinates, and distributions that have none are all alike.
    """
    kinds = [getattr(each, "coordinates", None) for each in distributions]
    names = [None if each is None else json.dumps(each.to_dict()["coordinates"]) for each in kinds]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return tuple(numbers[name] for name in names)


def _pool_alike(mixtures: Sequence[CoordinateMixture]) -> CoordinateMixture:
    """Return the mixture with the components of mixtures in the same coordinates."""
    weights, means, covariances = (
        np.concatenate([getattr(mixture, name) for mixture in mixtures]) for name in COMPONENT_FIELDS
    )
    return CoordinateMixture(mixtures[0].coordinates, weights / weights.sum(), means, covariances)


def _align(pools: Sequence[CoordinateMixture]) -> tuple[CoordinateMixture, ...]:
    """Return mixtures with their coordinates in an order that serves all of them: the first of theirs that does."""
    coordinates = [pool.coordinates for pool in pools]
    names = next((each.names for each in coordinates if each.names), ())
    reasons = []
    for columns in dict.fromkeys(each.columns for each in coordinates):
        try:
            return tuple(_reorder(pool, names, columns) for pool in pools)
        except ValueError as error:
            reasons.append(str(error))
    raise ValueError(f"No order of the columns serves the coordinates of all mixtures: {reasons[0]}")


def _reorder(mixture: CoordinateMixture, names: tuple[str, ...], columns: tuple[int, ...]) -> CoordinateMixture:
    """Return a mixture with its coordinates in the order of these columns of x."""
    own = mixture.coordinates
    if own.columns == columns:
        return mixture
    places = [own.columns.index(column) for column in columns]
    order = tuple(names[column] for column in columns)
    coordinates = Coordinates(own.low, own.high, own.kinds, own.names or names, order)
    means, covariances = mixture.means[:, places], mixture.covariances[:, places][:, :, places]
    return CoordinateMixture(coordinates, mixture.weights, means, covariances)


class _Part(NamedTuple):
    """One part of a pool at column j of n rows, of which the earlier columns are given."""

    mixture: CoordinateMixture
    state: ConditioningState
    log_weight: FloatArray
    """Logarithm of its weight times its density of the earlier columns, shape (n,)."""
    conditional: TruncatedConditional
    """Its distribution of the coordinate of the column."""

    @classmethod
    def at(
        cls, j: int, x: FloatArray, mixture: CoordinateMixture, state: ConditioningState, log_weight: FloatArray
    ) -> _Part:
        """Return the part at column j of rows x (n, d)."""
        conditional = mixture.next_conditional(state, mixture.coordinates.bounds(j, x))
        return cls(mixture, state, log_weight, conditional)

    def log_masses(self, j: int, x: FloatArray, rows: NDArray[np.intp]) -> FloatArray:
        """Return logarithms of its weight times its masses below and above column j of some rows x (m, d), (2, m)."""
        coordinates, conditional = self.mixture.coordinates, self.conditional.take(rows)
        y = move_inside(coordinates.coordinate(j, x), conditional.low, conditional.high)
        below, above = conditional.log_masses(y)
        if coordinates.sign(j) < 0.0:
            below, above = above, below
        return self.log_weight[rows] + np.stack([below, above]) - np.logaddexp(below, above)

    def observe(self, j: int, after: int, x: FloatArray) -> _Part:
        """Return the part at the column after column j."""
        coordinates, conditional = self.mixture.coordinates, self.conditional
        y = move_inside(coordinates.coordinate(j, x), conditional.low, conditional.high)
        state = self.mixture.observe(conditional, self.state, y)
        density = log_sum(state.log_weights) - conditional.log_whole_mass() + coordinates.log_slope(j, x)
        return _Part.at(after, x, self.mixture, state, self.log_weight + density)


@dataclass(frozen=True, eq=False)
class PooledMixture:
    """Mixtures in different coordinates of one box, pooled: the density is the weighted mean of theirs.

    The map goes column by column, as that of `CoordinateMixture`: u_j = Phi^-1(P(X_j <= x_j | earlier columns)). That
    distribution function is the mean of those of the parts, weighted by their densities of the earlier columns.

    Args:
        parts: Mixtures in the same box, with the columns in the same order.
        weights: Shares of the parts, shape (G,), sum 1.
    """

    parts: tuple[CoordinateMixture, ...]
    weights: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        object.__setattr__(self, "weights", np.asarray(self.weights, dtype=np.float64))
        if len({part.coordinates.columns for part in self.parts}) != 1:
            raise ValueError("Expected parts with the columns in the same order.")
        if self.weights.shape != (len(self.parts),) or not np.isclose(self.weights.sum(), 1.0):
            raise ValueError(f"Expected {len(self.parts)} weights with sum 1, got {self.weights.tolist()}.")

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
        """Map points in the box to standard normal space, (n, d) -> (n, d)."""
        points = self.parts[0].coordinates.interior(self.parts[0].rows_in_box(x))
        return apply_by_chunks(self._to_normal, points, self.dim)

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points strictly inside the box, (n, d) -> (n, d)."""
        return apply_by_chunks(self._from_normal, self.parts[0].finite_rows(u), self.dim)

    @property
    def _columns(self) -> tuple[int, ...]:
        return self.parts[0].coordinates.columns

    def _start(self, x: FloatArray) -> list[_Part]:
        weights = np.log(self.weights)[:, None] + np.zeros(len(x))
        pairs = zip(self.parts, weights, strict=True)
        return [_Part.at(self._columns[0], x, each, each.start(), weight) for each, weight in pairs]

    def _to_normal(self, x: FloatArray) -> FloatArray:
        parts, u, rows = self._start(x), np.empty_like(x), np.arange(len(x))
        for j, after in zip(self._columns, (*self._columns[1:], None), strict=True):
            u[:, j] = _pooled_quantile_scale(j, x, rows, parts)
            if after is not None:
                parts = [part.observe(j, after, x) for part in parts]
        return u

    def _from_normal(self, u: FloatArray) -> FloatArray:
        x = np.empty_like(u)
        parts = self._start(x)
        for j, after in zip(self._columns, (*self._columns[1:], None), strict=True):
            x[:, j] = _find_quantiles(j, x, u[:, j], parts)
            if after is not None:
                parts = [part.observe(j, after, x) for part in parts]
        return x


def _pooled_quantile_scale(j: int, x: FloatArray, rows: NDArray[np.intp], parts: Sequence[_Part]) -> FloatArray:
    """Return Phi^-1 of the pooled distribution function of column j at x (m, d), which are some rows of the parts."""
    lower, upper = np.moveaxis(np.array([part.log_masses(j, x, rows) for part in parts]), 1, 0)
    return quantile_scale(log_sum(lower), log_sum(upper))


def _find_quantiles(j: int, x: FloatArray, u: FloatArray, parts: Sequence[_Part]) -> FloatArray:
    """Return the value of column j at which the pooled distribution function is Phi(u), for rows x (n, d), (n,)."""
    pool, fits = _PooledTail.of(j, x, u, parts)
    below = np.maximum(-np.abs(u), MIN_U)
    found, fits = pool.sign * solve(pool, below, pool.guess(below)), fits & (below > MIN_U)
    coordinates = parts[0].mixture.coordinates
    low, high = coordinates.low[j], coordinates.high[j]
    if not fits.all():
        rest = np.flatnonzero(~fits)
        found[rest] = find_root(
            partial(_find_scale, j, x, rest, parts), u[rest], *np.full((len(rest), 2), (low, high)).T
        )
    return move_inside(found, low, high)


def _find_scale(
    j: int, x: FloatArray, of: NDArray[np.intp], parts: Sequence[_Part], values: FloatArray, rows: NDArray[np.intp]
) -> FloatArray:
    """Return Phi^-1 of the pooled distribution function of column j at values (m,) in some of some rows of x (n, d)."""
    points = x[of[rows]]
    points[:, j] = values
    return _pooled_quantile_scale(j, points, of[rows], parts)


class _PooledTail(NamedTuple):
    """The distribution function of column j of the pool, to be inverted from its lower end; rows may be mirrored."""

    j: int
    x: FloatArray
    """With the columns before j, shape (n, d); column j is written over."""
    sign: FloatArray
    """-1 in rows that are mirrored, (n,)."""
    low: FloatArray
    high: FloatArray
    """Interval of the column, mirrored where the row is, (n,)."""
    coordinates: list[Coordinates]
    tails: list[Tail]
    shares: FloatArray
    """Of the parts given the earlier columns, (G, n)."""

    @classmethod
    def of(cls, j: int, x: FloatArray, u: FloatArray, parts: Sequence[_Part]) -> tuple[_PooledTail, NDArray[np.bool_]]:
        """Return the distribution functions to be inverted at u (n,), and which rows fit into plain numbers."""
        coordinates = [part.mixture.coordinates for part in parts]
        pairs = [Tail.of(part.conditional, own.sign(j) * u) for part, own in zip(parts, coordinates, strict=True)]
        log_weights = np.stack([part.log_weight for part in parts])
        shares = np.exp(log_weights - log_sum(log_weights))
        ends = coordinates[0].low[j], coordinates[0].high[j]
        low, high = (np.where(u > 0.0, -far, near) for near, far in (ends, ends[::-1]))
        fits = np.all([each | (share < MIN_SHARE) for (_, each), share in zip(pairs, shares, strict=True)], axis=0)
        sign = np.where(u > 0.0, -1.0, 1.0)
        return cls(j, x.copy(), sign, low, high, coordinates, [tail for tail, _ in pairs], shares), fits

    def take(self, rows: NDArray[np.intp]) -> _PooledTail:
        """Return those of some rows."""
        sign, low, high, shares = (array[..., rows] for array in (self.sign, self.low, self.high, self.shares))
        tails = [tail.take(rows) for tail in self.tails]
        return _PooledTail(self.j, self.x[rows], sign, low, high, self.coordinates, tails, shares)

    def guess(self, u: FloatArray) -> FloatArray:
        """Return about where the distribution functions are Phi(u), (n,) for u <= 0.

        The mean of the guesses of the parts; in the tail the least of those at Phi(u) over their shares.
        """
        alone = ndtri(np.minimum(ndtr(u) / np.maximum(self.shares, MIN_SHARE), 0.5))
        guesses = []
        for coordinates, tail, own in zip(self.coordinates, self.tails, np.where(u < TAIL_U, alone, u), strict=True):
            y = tail.sign * tail.guess(own)
            guesses.append(self.sign * coordinates.value(self.j, y, self.x))
        mean = sum_components(self.shares * np.stack(guesses))
        return np.clip(np.where(u < TAIL_U, np.min(guesses, axis=0), mean), self.low, self.high)

    def evaluate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the distribution functions, the densities, and over what length these change, at x (n,)."""
        self.x[:, self.j] = self.sign * x
        cdf, density, length = np.zeros_like(x), np.zeros_like(x), np.full_like(x, np.inf)
        for coordinates, tail, share in zip(self.coordinates, self.tails, self.shares, strict=True):
            own_cdf, own_density, own_length = tail.evaluate(tail.sign * coordinates.coordinate(self.j, self.x))
            slope = np.exp(coordinates.log_slope(self.j, self.x))
            cdf, density = cdf + share * own_cdf, density + share * own_density * slope
            length = np.minimum(length, own_length / slope)
        return cdf, density, length
