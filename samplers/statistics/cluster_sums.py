"""Cluster sums: P[f <= g] as a sum over independent units, with the spread and the interval of that sum.

A unit is what was drawn independently: a draw, or a point of level 0 with all that descends from it.
With T_c the sum of the weights in unit c, p-hat = sum T_c and its variance is sum T_c^2 - p^2 / n.

References:
    Lee and Whiteley, "Variance estimation in the particle filter", Biometrika 105, 2018 (the spread from roots).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from samplers.problem import FloatArray
from samplers.sample import Sample
from samplers.statistics.intervals import Interval, clopper_pearson, degrees_of_freedom, log_normal_interval


@dataclass(frozen=True, eq=False)
class UnitSums:
    """Sums over units at G thresholds."""

    p: FloatArray
    """Sum of the weights of the points with f <= g, shape (G,)."""
    second: FloatArray
    """Sum over units of T_c(g) T_c(g'), shape (G, G)."""
    n_units: int
    """Units drawn."""
    independent: bool
    """Whether every point is a unit of its own."""

    @property
    def cov(self) -> FloatArray:
        """Coefficient of variation of `p`, shape (G,); inf where p = 0."""
        square = self.p**2  # may underflow
        relative = np.divide(np.diag(self.second), square, out=np.full(len(self.p), np.inf), where=square > 0)
        return np.asarray(np.sqrt(np.maximum(relative - 1 / self.n_units, 0.0)))

    @property
    def ess(self) -> FloatArray:
        """Effective number of units behind `p`, (sum T)^2 / sum T^2, shape (G,)."""
        second = np.diag(self.second)
        return np.divide(self.p**2, second, out=np.zeros(len(self.p)), where=second > 0)

    @property
    def is_count(self) -> NDArray[np.bool_]:
        """Mask of those `p` that are shares of n_units equal draws, one point each: T_c is 0 or 1 / n, shape (G,)."""
        return np.isclose(np.diag(self.second) * self.n_units, self.p, rtol=1e-9, atol=0.0)

    @property
    def correlation(self) -> FloatArray:
        """Correlation of `p` between thresholds, shape (G, G); 0 to those that do not vary."""
        covariance = self.second - np.outer(self.p, self.p) / self.n_units
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        varies = deviation > 1e-7 * self.p  # less is rounding: it is the root of a difference
        scale = np.where(varies, 1 / np.where(varies, deviation, 1.0), 0.0)
        return np.asarray(covariance * np.outer(scale, scale))


def unit_sums(sample: Sample, gammas: FloatArray) -> UnitSums:
    """Return the sums over units of a sample at rising thresholds, shape (G,).

    A point enters at the first threshold that is not below its f (nor below its layer's range) and
    leaves where the range of its layer ends, so that the sums are running sums over thresholds.
    """
    rows, columns, steps = [], [], []
    for layer in sample.all_layers:
        enters = np.searchsorted(gammas, np.maximum(layer.f, layer.low))
        leaves = np.full(len(enters), np.searchsorted(gammas, layer.high))
        seen = enters < leaves
        rows += [layer.units[seen]] * 2
        columns += [enters[seen], leaves[seen]]
        steps += [layer.weights[seen], -layer.weights[seen]]
    shape = (sample.n_units, len(gammas) + 1)
    place = (np.concatenate(rows), np.concatenate(columns))
    increments = csr_array((np.concatenate(steps), place), shape=shape)
    products = (increments.T @ increments).toarray()
    return UnitSums(
        p=np.cumsum(np.asarray(increments.sum(axis=0)))[:-1],
        second=np.cumsum(np.cumsum(products, axis=0), axis=1)[:-1, :-1],
        n_units=sample.n_units,
        independent=has_independent_points(sample),
    )


def has_independent_points(sample: Sample) -> bool:
    """Return whether every point of a sample is a unit of its own (a draw, no chain)."""
    return not sample.layers and len(np.unique(sample.units)) == len(sample.units)


def interval_of_sum(p: float, cov: float, ess: float, independent: bool, confidence: float) -> Interval:
    """Return a log-normal interval of p > 0 with the t quantile of `ess` effective units."""
    return log_normal_interval(p, cov, confidence, df=degrees_of_freedom(ess, independent))


def interval_of_count(p: float, n: int, confidence: float) -> Interval:
    """Return the exact binomial interval of a share p of n draws."""
    return clopper_pearson(round(p * n), n, confidence)
