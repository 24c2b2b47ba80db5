"""Pools of Gaussian mixtures with equal weights, in the same coordinates or in different ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike
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
from rare_envs.distributions.quantiles.column_quantiles import find_quantiles
from rare_envs.distributions.quantiles.mixture_quantile import MixtureColumn
from rare_envs.distributions.quantiles.pool_by_logarithms import PoolTerm, find_quantiles_by_logarithms
from rare_envs.distributions.rows.box_points import BoxPoints, describe_points
from rare_envs.distributions.space import Distribution
from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture
from rare_envs.distributions.truncated_normal import TruncatedConditional, log_sum

BoxMixture = TruncatedGaussianMixture | CoordinateMixture
_BOX_MIXTURES = get_args(BoxMixture)
"""A class of the user's below one of these may have another density."""


class Refits(tuple[Distribution, ...]):
    """Distributions of the same X, of which densities are computed together.

    Example:
        >>> Refits([TruncatedGaussianMixture([1.0], [[m]], [[[1.0]]], [-9.0], [9.0]) for m in (0.0, 1.0)]).log_probs(
        ...     np.array([[0.0], [1.0], [10.0]])
        ... ).round(3).tolist()
        [[-0.919, -1.419, -inf], [-1.419, -0.919, -inf]]
    """

    __slots__ = ()

    def log_probs(self, x: FloatArray) -> FloatArray:
        """Return the log density of each, (n, d) -> (R, n); where points are in equal coordinates is found once.

        Raises:
            ValueError: Wrong shape, of x or of the densities of a refit of the user's.
        """
        known: dict[tuple[object, ...], BoxPoints] = {}
        out = np.empty((len(self), len(x)))
        for row, each in zip(out, self, strict=True):
            if isinstance(each, BoxMixture) and type(each) in _BOX_MIXTURES:
                conditionals = each.conditionals
                key = conditionals.coordinates.key
                if key not in known:
                    known[key] = describe_points(conditionals.coordinates, conditionals.rows("x", x))
                row[:] = conditionals.log_prob_at(known[key])
            else:
                values = np.asarray(each.log_prob(x))
                if values.shape != row.shape:
                    raise ValueError(f"Expected log_prob of a refit of shape {row.shape}, got {values.shape}.")
                row[:] = values
        return out


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
    """Logarithm of its weight times its density of the earlier columns, shape (n,); (1,) where there are none."""

    def term(self, j: int, x: FloatArray) -> PoolTerm:
        """Return what it says of column j."""
        coordinates = self.conditionals.coordinates
        conditional = self.conditionals.next_conditional(self.state, coordinates.bounds(j, x))
        return PoolTerm(coordinates, self.log_weight, conditional)

    def observe(self, j: int, x: FloatArray, conditional: TruncatedConditional) -> _Part:
        """Return the part after column j."""
        coordinates = self.conditionals.coordinates
        y = move_inside(coordinates.coordinate(j, x), conditional.low, conditional.high)
        state = self.conditionals.observe(conditional, self.state, y)
        density = log_sum(state.log_weights) - conditional.log_whole_mass() + coordinates.log_slope(j, x)
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

    def _start(self) -> list[_Part]:
        pairs = zip(self._conditionals, np.log(self.weights), strict=True)
        return [_Part(own, own.start(), np.array([log_weight])) for own, log_weight in pairs]

    def _to_normal(self, x: FloatArray) -> FloatArray:
        parts, u = self._start(), np.empty_like(x)
        for place, j in enumerate(self.parts[0].coordinates.columns, start=1):
            terms = [part.term(j, x) for part in parts]
            u[:, j] = _pooled_quantile_scale(j, x, terms)
            if place < self.dim:
                parts = [part.observe(j, x, term.conditional) for part, term in zip(parts, terms, strict=True)]
        return u

    def _from_normal(self, u: FloatArray) -> FloatArray:
        parts, x = self._start(), np.empty_like(u)
        for place, j in enumerate(self.parts[0].coordinates.columns, start=1):
            terms = [part.term(j, x) for part in parts]
            x[:, j] = _find_quantiles(j, x, u[:, j], terms)
            if place < self.dim:
                parts = [part.observe(j, x, term.conditional) for part, term in zip(parts, terms, strict=True)]
        return x


def _pooled_quantile_scale(j: int, x: FloatArray, terms: Sequence[PoolTerm]) -> FloatArray:
    """Return Phi^-1 of the pooled distribution function of column j at x (n, d), by the smaller tail."""
    scores = np.stack([_quantile_scale(j, x, term) for term in terms])
    log_weights = np.stack([term.log_weight for term in terms])
    lower, upper = log_sum(log_weights + log_ndtr(scores)), log_sum(log_weights + log_ndtr(-scores))
    tail = np.minimum(lower, upper) - np.logaddexp(lower, upper)
    return np.asarray(np.where(lower <= upper, 1.0, -1.0) * ndtri_exp(tail))


def _quantile_scale(j: int, x: FloatArray, term: PoolTerm) -> FloatArray:
    """Return Phi^-1 of the distribution function that a part has of column j, at x (n, d)."""
    conditional = term.conditional
    y = move_inside(term.coordinates.coordinate(j, x), conditional.low, conditional.high)
    return term.coordinates.sign(j) * conditional.to_normal(y)


def _find_quantiles(j: int, x: FloatArray, u: FloatArray, terms: Sequence[PoolTerm]) -> FloatArray:
    """Return the value of column j at which the pooled distribution function is Phi(u), for rows x (n, d), (n,)."""
    column, is_log = _column_of(j, x, terms)
    found, fits = find_quantiles(column, u)
    if is_log:
        found = np.exp(found)
    if not fits.all():
        rest = np.flatnonzero(~fits)
        found[rest] = find_quantiles_by_logarithms(j, x[rest], u[rest], [term.take(rest) for term in terms])
    coordinates = terms[0].coordinates
    return move_inside(found, coordinates.low[j], coordinates.high[j])


def _column_of(j: int, x: FloatArray, terms: Sequence[PoolTerm]) -> tuple[MixtureColumn, bool]:
    """Return column j of rows x (n, d) as mixtures of normals, and whether these are all of its logarithm."""
    ordered = sorted(terms, key=lambda term: term.coordinates.is_log(j))
    logs = [term.coordinates.is_log(j) for term in ordered]
    pairs = [term.coordinates.linear(j, term.conditional.mean, term.conditional.scale, x) for term in ordered]
    mean, scale = (np.concatenate(each) for each in zip(*pairs, strict=True))
    log_weights = np.concatenate([term.conditional.log_weights for term in ordered])
    sizes = [len(term.conditional.mean) for term in ordered]
    edges = tuple(np.cumsum([0, *sizes]).tolist())
    n_plain = edges[-1] if all(logs) else sum(size for size, log in zip(sizes, logs, strict=True) if not log)
    low, high = (np.full(len(x), ends[j]) for ends in (terms[0].coordinates.low, terms[0].coordinates.high))
    if all(logs):
        low, high = np.log(low), np.log(high)
    share = np.stack([term.log_weight for term in ordered])
    return MixtureColumn(log_weights, mean, scale, low, high, edges, np.exp(share - log_sum(share)), n_plain), all(logs)
