"""Weighted failures: failing points with weights that add up to p, and means and sums over them with their spread."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.analysis.base import WeightedEstimate, cov_inflation, require_sample
from samplers.analysis.base_uncertainty import BaseUncertainty, summarise_refits
from samplers.analysis.refits import RefitSums, find_fitted_base, reweight_to_refits
from samplers.problem import FloatArray
from samplers.sample import Sample
from samplers.serialization import to_json_value
from samplers.statistics.cluster_sums import has_independent_points, interval_of_sum
from samplers.statistics.intervals import Interval
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


@dataclass(frozen=True, kw_only=True)
class FailureExpectation:
    """E[h(X); failure], the expectation of a quantity h >= 0 that is 0 where nothing fails.

    Example:
        With p = 0.01 and E[h(X) | failure] = 2:

        >>> found = FailureExpectation(value=0.02, interval=(0.01, 0.04), confidence=0.95, cov=0.35, per_failure=2.0)
        >>> found.value / found.per_failure, found.to_dict()["interval"]
        (0.01, [0.01, 0.04])
    """

    value: float
    """The expectation, over all X."""
    interval: Interval
    """Interval that should hold it with probability `confidence`."""
    confidence: float
    """Nominal coverage of `interval`."""
    cov: float
    """Coefficient of variation of `value`."""
    per_failure: float
    """E[h(X) | failure]."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {name: to_json_value(value) for name, value in asdict(self).items()}


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


def expect_over_failures(
    failures: WeightedFailures, values: FloatArray, confidence: float = 0.95
) -> FailureExpectation:
    """Return E[h(X); failure] = sum of w h, with a log-normal interval from the spread over independent units.

    Args:
        failures: Weighted failing points.
        values: h >= 0 at these points, shape (k,).
        confidence: Nominal coverage of the interval.

    Raises:
        ValueError: If h is not one finite number >= 0 per point, or 0 at all of them.

    Example:
        h = 1, 1, 3, 3 at 4 failures among 400 plain draws: (1 + 1 + 3 + 3) / 400.

        >>> failures = WeightedFailures(
        ...     x=np.zeros((4, 2)), rows=np.arange(4), has_outcome=np.full(4, True), weights=np.full(4, 1 / 400),
        ...     units=np.arange(4), n_units=400, independent=True, inflation=1.0, total=4)
        >>> found = expect_over_failures(failures, np.array([1.0, 1.0, 3.0, 3.0]))
        >>> round(found.value, 6), round(found.per_failure, 6)
        (0.02, 2.0)
    """
    h = np.asarray(values, dtype=np.float64)
    if h.shape != failures.weights.shape or not (np.isfinite(h).all() and (h >= 0).all()):
        raise ValueError(f"Expected a finite value >= 0 for each of {len(failures.weights)} points, got {values!r}.")
    largest = float(h.max())
    if largest == 0:
        raise ValueError("The quantity is 0 at every failing point: its expectation has no interval.")
    terms = failures.weights * h
    value, cov = float(terms.sum()), failures.cov_of_sum(terms)
    units = effective_number(failures.unit_totals(terms))
    # in units of the largest value, so that the cut at 1 is the bound h <= largest
    low, high = interval_of_sum(value / largest, cov, units, failures.independent, confidence)
    return FailureExpectation(
        value=value,
        interval=(low * largest, high * largest),
        confidence=confidence,
        cov=cov,
        per_failure=value / float(failures.weights.sum()),
    )


def expect_under_refits(
    estimate: WeightedEstimate, failures: WeightedFailures, values: FloatArray, expectation: FailureExpectation
) -> BaseUncertainty | None:
    """Return the uncertainty of E[h(X); failure] that the events behind a fitted base leave, as that of p.

    It comes from the points of the first run alone, also where p has a further run under the mixture of the refits.

    Args:
        estimate: The run.
        failures: Its weighted failing points.
        values: h at these points, shape (k,).
        expectation: E[h(X); failure] under the base itself.

    Returns:
        Its `p` is the expectation; None where the base has no refits.

    Example:
        h = 2 at every failing point, P[x >= 1] under N(0, 1) and under its refits N(-0.2, 1), N(0, 1) and N(0.2, 1):
        2 Phi(-1.2), 2 Phi(-1) and 2 Phi(-0.8).

        >>> import samplers
        >>> from types import SimpleNamespace
        >>> from samplers.proposals import Gaussian
        >>> class FittedNormal(samplers.StandardNormal):
        ...     refits = [Gaussian(np.array([mean]), np.eye(1)) for mean in (-0.2, 0.0, 0.2)]
        ...     clusters, fitted_to, family = 17, "40 events of 17 scenes", "normal"
        >>> problem = SimpleNamespace(dim=1, base=FittedNormal(1), evaluate=lambda x: 1.0 - x[:, 0])
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)
        >>> failures = weigh_failures(result)
        >>> h = np.full(len(failures.x), 2.0)
        >>> found = expect_under_refits(result, failures, h, expect_over_failures(failures, h))
        >>> [round(value, 2) for value in found.p_refits]
        [0.23, 0.32, 0.42]
    """
    fitted = find_fitted_base(estimate.base)
    if fitted is None:
        return None
    sample, largest = require_sample(estimate), float(np.max(values))
    weights = sample.weights[sample.f <= estimate.gamma]
    parts = np.zeros((1, failures.total))
    parts[0, failures.rows] = values / largest * (weights.sum() / weights[failures.rows].sum())
    sums, reason = RefitSums(np.empty((1, 0)), np.empty((1, 0))), ""
    try:
        sums = reweight_to_refits(estimate, fitted.refits, parts)
    except ValueError as error:
        reason = str(error)
    return summarise_refits(
        expectation.value, expectation.cov, estimate.confidence, fitted, sums, largest=largest, reason=reason
    )


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
