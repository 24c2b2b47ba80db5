"""Weighted failures: failing points with weights that add up to p, and means over them with their spread."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from samplers.analysis.base import WeightedEstimate, cov_inflation, require_sample
from samplers.problem import FloatArray
from samplers.sample import Sample
from samplers.statistics.cluster_sums import has_independent_points
from samplers.statistics.weights import effective_number


@dataclass(frozen=True, eq=False, kw_only=True)
class WeightedFailures:
    """Failing points of a run, all or evenly spaced among them, with weights that add up to p.

    Example:
        4 failures among 400 plain draws: p = 0.01 with a c.o.v. of sqrt((1 - p) / (400 p)).

        >>> failures = WeightedFailures(
        ...     x=np.zeros((4, 2)), rows=np.arange(4), has_outcome=np.full(4, True), weights=np.full(4, 1 / 400),
        ...     units=np.arange(4), n_units=400, independent=True, inflation=1.0, total=4)
        >>> round(failures.cov_of_sum(failures.weights), 4), round(math.sqrt(0.99 / 4), 4)
        (0.4975, 0.4975)
    """

    x: FloatArray
    """The points, shape (k, d)."""
    rows: NDArray[np.int64]
    """Their rows among all failing points, `Sample.x`, shape (k,)."""
    has_outcome: NDArray[np.bool_]
    """Where f gave a value; elsewhere the point counts as failing because f raised or gave NaN, shape (k,)."""
    weights: FloatArray
    """Weights scaled so that they add up to the estimate's p, shape (k,)."""
    units: NDArray[np.int64]
    """Independent unit of each point, see `Sample`, shape (k,)."""
    n_units: int
    """Independent units drawn in the run."""
    independent: bool
    """Whether every point of the run is a unit of its own."""
    inflation: float
    """Factor by which the estimate's c.o.v. exceeds that of the weights' sum."""
    total: int
    """Failing points that the run has."""

    def unit_totals(self, terms: FloatArray) -> FloatArray:
        """Return the sums over units of terms (k,) or (k, m): one row for each unit that has a point."""
        owners = np.unique(self.units, return_inverse=True)[1]
        totals = np.zeros((owners.max(initial=-1) + 1, *terms.shape[1:]))
        np.add.at(totals, owners, terms)
        return totals

    def cov_of_sum(self, terms: FloatArray) -> float:
        """Return the c.o.v. of the sum of terms (k,) over independent units; inf for a sum of 0."""
        effective = effective_number(self.unit_totals(terms))
        if effective == 0:
            return math.inf
        return self.inflation * math.sqrt(max(1 / effective - 1 / self.n_units, 0.0))


def choose_failures(sample: Sample, gamma: float, most: int | None = None) -> NDArray[np.int64]:
    """Return rows of `Sample.x`: all of them, or `most` evenly spaced ones where there are more.

    Raises:
        ValueError: If `most` is not positive.
    """
    if most is not None and most < 1:
        raise ValueError(f"Expected most of at least 1 point, got {most!r}.")
    rows = np.arange(int(np.count_nonzero(sample.f <= gamma)))
    if most is None or len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]


def weigh_failures(estimate: WeightedEstimate, most: int | None = None) -> WeightedFailures:
    """Return the failing points of an estimate with weights that add up to its p.

    Args:
        estimate: With weighted points.
        most: At most so many points, evenly spaced; None for all.

    Raises:
        ValueError: If there are no weighted points, or none failed.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=1000)
        >>> failures = weigh_failures(result)
        >>> failures.total == result.failures.total, bool((failures.x >= 2.0).all())
        (True, True)
        >>> bool(np.allclose(failures.weights, 1 / 1000))  # plain draws
        True
    """
    sample = require_sample(estimate)
    failing = np.flatnonzero(sample.f <= estimate.gamma)
    rows = choose_failures(sample, estimate.gamma, most)
    chosen = failing[rows]
    weights = sample.weights[chosen]
    if not weights.sum() > 0:
        raise ValueError(f"No point failed (f <= {estimate.gamma:g}): there is nothing to analyse.")
    raw = WeightedFailures(
        x=sample.x[rows],
        rows=rows,
        has_outcome=~np.isneginf(sample.f[chosen]),
        weights=weights * (estimate.p / float(weights.sum())),
        units=sample.units[chosen],
        n_units=sample.n_units,
        independent=has_independent_points(sample),
        inflation=1.0,
        total=len(failing),
    )
    return replace(raw, inflation=cov_inflation(estimate, raw.cov_of_sum(raw.weights)))


def mean_over_failures(failures: WeightedFailures, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return E[h(X) | failure] and its standard error, for m quantities h at once.

    The mean is a ratio of two sums, so its variance is that of the sum of w (h - mean) over independent units.

    Args:
        failures: Weighted failing points.
        values: h at these points, shape (k, m).

    Returns:
        Means and standard errors, shape (m,) each.
    """
    share = failures.weights / failures.weights.sum()
    means = share @ values
    totals = failures.unit_totals(share[:, None] * (values - means))
    return means, failures.inflation * np.sqrt((totals**2).sum(axis=0))
