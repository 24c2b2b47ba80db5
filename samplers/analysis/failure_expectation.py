"""Expectations over failures: E[h(X); failure] of a quantity h >= 0, with the errors of sampling and of the base."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from samplers.analysis.base import WeightedEstimate, require_sample
from samplers.analysis.base_uncertainty import BaseUncertainty, read_lineages, summarise_refits
from samplers.analysis.failure_weights import WeightedFailures
from samplers.analysis.refits import (
    EnsembleEstimate,
    FittedBase,
    RefitSums,
    choose_better_run,
    find_fitted_base,
    reweight_to_refits,
)
from samplers.problem import FloatArray
from samplers.serialization import to_json_value
from samplers.statistics.cluster_sums import interval_of_sum
from samplers.statistics.intervals import Interval
from samplers.statistics.weights import effective_number


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


class FurtherFailures(NamedTuple):
    """Failing points of the further run under the mixture of the refits, with a quantity at them.

    Example:
        >>> import samplers
        >>> from samplers.analysis.failure_weights import weigh_failures
        >>> problem = samplers.FunctionProblem(lambda x: 1.0 - x[:, 0], dim=2)
        >>> failures = weigh_failures(samplers.estimate(problem, "mc", seed=0, max_sim=1000))
        >>> bool((FurtherFailures(failures, failures.x[:, 0]).values >= 1.0).all())
        True
    """

    failures: WeightedFailures
    values: FloatArray
    """Shape (k,)."""


def expect_under_refits(
    estimate: EnsembleEstimate,
    failures: WeightedFailures,
    values: FloatArray,
    expectation: FailureExpectation,
    further: FurtherFailures | None = None,
) -> BaseUncertainty | None:
    """Return the uncertainty of E[h(X); failure] that the events behind a fitted base leave, as that of p.

    Args:
        estimate: The run.
        failures: Its weighted failing points.
        values: h at these points, shape (k,).
        expectation: E[h(X); failure] under the base itself.
        further: The same of the run's `ensemble_run`, if it has one; without it the points of the run itself count.

    Returns:
        Its `p` is the expectation; None where the base has no refits.

    Example:
        h = 2 at every failing point, P[x >= 1] under N(0, 1) and under its refits N(-0.2, 1), N(0, 1) and N(0.2, 1):
        2 Phi(-1.2), 2 Phi(-1) and 2 Phi(-0.8).

        >>> import samplers
        >>> from types import SimpleNamespace
        >>> from samplers.analysis.failure_weights import weigh_failures
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
    largest = max(float(np.max(values)), 0.0 if further is None else float(np.max(further.values)))
    more = None if further is None else (further.failures, further.values[None] / largest)
    sums, reason = RefitSums(np.empty((1, 0)), np.empty((1, 0))), ""
    try:
        sums = sum_parts_under_refits(estimate, fitted, (failures, values[None] / largest), more)
    except ValueError as error:
        reason = str(error)
    return summarise_refits(
        expectation.value,
        expectation.cov,
        estimate.confidence,
        fitted,
        sums,
        sampling=expectation.interval,
        lineages=read_lineages(estimate),
        largest=largest,
        n_sim=0 if further is None or estimate.ensemble_run is None else estimate.ensemble_run.n_sim,
        reason=reason,
    )


def sum_parts_under_refits(
    estimate: EnsembleEstimate,
    fitted: FittedBase,
    own: tuple[WeightedFailures, FloatArray],
    further: tuple[WeightedFailures, FloatArray] | None = None,
) -> RefitSums:
    """Return m parts of p under R refits, each from the run or its further run, whichever has more points for it.

    Args:
        estimate: The run.
        fitted: Its base.
        own: Its weighted failing points and what share of each belongs to each part, shape (m, k).
        further: The same of its `ensemble_run`.

    Raises:
        ValueError: If nothing failed, or a density is not finite.
    """
    found = [reweight_to_refits(estimate, fitted.refits, _spread_over_all(estimate, *own))]
    run = estimate.ensemble_run
    if further is not None and run is not None:
        found.append(reweight_to_refits(run, fitted.refits, _spread_over_all(run, *further)))
    return choose_better_run(found)


def _spread_over_all(estimate: WeightedEstimate, failures: WeightedFailures, shares: FloatArray) -> FloatArray:
    """Return shares (m, k) of some failing points as shares (m, total) of all, which add up to the same parts of p."""
    sample = require_sample(estimate)
    weights = sample.weights[sample.f <= estimate.gamma]
    parts = np.zeros((len(shares), failures.total))
    parts[:, failures.rows] = shares * (weights.sum() / weights[failures.rows].sum())
    return parts
