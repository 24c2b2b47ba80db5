"""Pools of Gaussian mixtures with equal weights, in the same coordinates or in different ones."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.distributions.coordinates import Coordinates, FloatArray, move_inside
from rare_envs.distributions.mixture import (
    COMPONENT_FIELDS,
    CoordinateMixture,
    apply_by_chunks,
)
from rare_envs.distributions.truncated_normal import TruncatedConditional, log_sum

CHUNK_ROWS = 256
"""Rows worked on together, of a hundred components or more in all."""


def pool_mixtures(mixtures: Sequence[CoordinateMixture]) -> CoordinateMixture | PooledMixture:
    """Return one distribution of mixtures in the same box, each with equal weight.

    Those of the same coordinates become one mixture with the components of all, whose conditionals are cut to the box
    as a whole, not each mixture's by itself: its density is the mean of theirs up to factors 1 / (1 - mass outside the
    box). Where the coordinates differ, the columns are taken in an order that serves all.
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
        return apply_by_chunks(self._to_normal, points, self.dim, CHUNK_ROWS)

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points strictly inside the box, (n, d) -> (n, d)."""
        return apply_by_chunks(self._from_normal, self.parts[0].finite_rows(u), self.dim, CHUNK_ROWS)

    def _to_normal(self, x: FloatArray) -> FloatArray:
        u = np.empty_like(x)
        for j, column in self._conditionals(x):
            u[:, j] = column.to_normal(x[:, j])
        return u

    def _from_normal(self, u: FloatArray) -> FloatArray:
        x = np.empty_like(u)
        for j, column in self._conditionals(x):
            x[:, j] = move_inside(column.from_normal(u[:, j]), self.low[j], self.high[j])
        return x

    def _conditionals(self, x: FloatArray) -> Iterator[tuple[int, TruncatedConditional]]:
        """Yield columns and their distributions given the earlier ones of x (n, d), which may be set on the way."""
        weights = np.log(self.weights)[:, None] + np.zeros(len(x))
        states = [part.start() for part in self.parts]
        columns = self.parts[0].coordinates.columns
        for j in columns:
            own = [
                part.next_conditional(state, part.coordinates.bounds(j, x))
                for part, state in zip(self.parts, states, strict=True)
            ]
            masses = [each.log_whole_mass() for each in own]
            yield j, self._join(j, x, own, weights - masses)
            if j == columns[-1]:
                return
            for i, (part, conditional) in enumerate(zip(self.parts, own, strict=True)):
                y = move_inside(part.coordinates.coordinate(j, x), conditional.low, conditional.high)
                states[i] = part.observe(conditional, states[i], y)
                weights[i] += log_sum(states[i].log_weights) - masses[i] + part.coordinates.log_slope(j, x)

    def _join(
        self, j: int, x: FloatArray, own: Sequence[TruncatedConditional], weights: FloatArray
    ) -> TruncatedConditional:
        """Return the distribution of column j with the components of all parts, whose log weights (G, n) are given."""
        pairs = [
            part.coordinates.linear(j, np.broadcast_to(each.mean, (len(each.mean), len(x))), each.scale, x)
            for part, each in zip(self.parts, own, strict=True)
        ]
        mean, scale = (np.concatenate(arrays) for arrays in zip(*pairs, strict=True))
        log_weights = np.concatenate([each.log_weights + row for each, row in zip(own, weights, strict=True)])
        is_log = np.concatenate([[part.coordinates.is_log(j)] * len(part.weights) for part in self.parts])[:, None]
        return TruncatedConditional(
            log_weights, mean, scale, self.low[j], self.high[j], is_log if is_log.any() else None
        )
