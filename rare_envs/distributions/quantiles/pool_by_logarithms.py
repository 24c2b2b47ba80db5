"""Quantiles of pools of mixtures in logarithms, however far out: for rows that do not fit into plain numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import Coordinates, move_inside
from rare_envs.distributions.quantiles.mixture_quantile import sum_components
from rare_envs.distributions.truncated_normal import (
    MAX_ITERATIONS,
    RootBracket,
    TailSearch,
    TruncatedConditional,
    guess_quantile,
    log_sum,
)


class PoolTerm(NamedTuple):
    """One mixture of a pool, at one column of n rows of which the earlier ones are given."""

    coordinates: Coordinates
    log_weight: FloatArray
    """Logarithm of its weight times its density of the earlier columns, shape (n,); (1,) where there are none."""
    conditional: TruncatedConditional
    """Its distribution of the coordinate of the column."""

    def take(self, rows: NDArray[np.intp]) -> PoolTerm:
        """Return that of some rows."""
        weight = self.log_weight if len(self.log_weight) == 1 else self.log_weight[rows]
        return PoolTerm(self.coordinates, weight, self.conditional.take(rows))


def find_quantiles_by_logarithms(j: int, x: FloatArray, u: FloatArray, terms: Sequence[PoolTerm]) -> FloatArray:
    """Return the value of column j at which the pooled distribution function is Phi(u), (n,); each row stops by itself.

    Positive u are solved in the mirror image, as those of one mixture are (`RootBracket`).

    Args:
        j: The column.
        x: Rows with the columns before it, (n, d).
        u: On the quantile scale, (n,).
        terms: The mixtures of the pool.
    """
    sign = np.where(u > 0, -1.0, 1.0)
    pool = _PooledTail.of(j, x, u, terms)
    low, high = (float(ends[j]) for ends in (terms[0].coordinates.low, terms[0].coordinates.high))
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
    def of(cls, term: PoolTerm, j: int, u: FloatArray, log_total: FloatArray) -> _Tail:
        """Return the tail of a mixture with a first guess; what does not depend on column j is computed once."""
        coordinates, conditional = term.coordinates, term.conditional
        mirrored = coordinates.sign(j) * u > 0
        mirror = conditional.mirror(mirrored)
        score = mirror.log_weights + mirror.log_mass()
        below = -np.abs(u)
        search = TailSearch.start(mirror, log_sum(score), below, guess_quantile(mirror, below, score))
        low, high = (np.broadcast_to(end, len(u)) for end in (conditional.low, conditional.high))
        return cls(coordinates, np.broadcast_to(term.log_weight - log_total, len(u)), mirrored, low, high, search)

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
    def of(cls, j: int, x: FloatArray, u: FloatArray, terms: Sequence[PoolTerm]) -> _PooledTail:
        """Return the tails of all mixtures, for all rows."""
        log_total = log_sum(np.stack([term.log_weight for term in terms]))
        return cls(j, x.copy(), [_Tail.of(term, j, u, log_total) for term in terms])

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
