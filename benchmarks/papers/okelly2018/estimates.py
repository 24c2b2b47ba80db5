"""Estimates of a threshold: naive Monte Carlo, importance sampling, and how they compare."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats.contingency import relative_risk

from samplers.problem import FloatArray
from samplers.sample import Interval, clopper_pearson, effective_sample_size


@dataclass(frozen=True)
class ThresholdEstimate:
    """P[f <= gamma] from a sample.

    Example:
        >>> import numpy as np
        >>> found = estimate_naive(np.array([0.1, 0.5, 0.9, 0.9]), gamma=0.5)
        >>> found.events, found.p, found.standard_error
        (2, 0.5, 0.25)
    """

    gamma: float
    n: int
    """Draws, without those of a search."""
    events: int
    """Draws with f <= gamma."""
    p: float
    standard_error: float
    """As the paper has it: standard deviation of a term / sqrt(n)."""
    interval: Interval | None = None
    """95 %, of naive Monte Carlo (Clopper and Pearson)."""
    ess: float | None = None
    """Effective number of the events, of importance sampling."""


@dataclass(frozen=True)
class ThresholdComparison:
    """Importance sampling against naive Monte Carlo at one threshold; None where that cannot be said."""

    gamma: float
    events_ratio: float | None
    """Rare events in as many draws, sampler over base distribution (the paper's first figure)."""
    events_interval: Interval | None
    """95 %, of the ratio (Katz et al., 1978)."""
    variance_ratio: float | None
    """p (1 - p) / n of naive Monte Carlo over the sample variance of the weighted mean (their second figure)."""
    all_in: float | None
    """Likewise with the rollouts of the search counted: at equal total cost."""
    error_ratio: float | None
    """The same with the squared distance from the longest naive estimate in the place of the sample variance: what is
    left of the gain if the sampler has missed failures; with the search counted."""
    errors_off: float | None
    """Distance of the two estimates in their joint standard error."""


def estimate_naive(f: FloatArray, gamma: float) -> ThresholdEstimate:
    """Return the share of outcomes f (n,) that are not above gamma."""
    n, events = len(f), int(np.count_nonzero(f <= gamma))
    p = events / n
    return ThresholdEstimate(gamma, n, events, p, math.sqrt(p * (1 - p) / n), interval=clopper_pearson(events, n, 0.95))


def estimate_weighted(f: FloatArray, log_ratios: FloatArray, gamma: float) -> ThresholdEstimate:
    """Return the mean of likelihood ratio times indicator of failure.

    Example:
        >>> found = estimate_weighted(np.array([0.1, 0.9]), np.log([0.5, 2.0]), gamma=0.5)
        >>> found.events, found.p
        (1, 0.25)
    """
    n, fails = len(f), f <= gamma
    terms = np.where(fails, np.exp(log_ratios), 0.0)
    error = float(terms.std()) / math.sqrt(n)
    return ThresholdEstimate(
        gamma, n, int(fails.sum()), float(terms.mean()), error, ess=effective_sample_size(log_ratios[fails])
    )


def mean_ratio(log_ratios: FloatArray) -> float:
    """Return the mean likelihood ratio of draws from a sampler, which is 1 but for chance.

    One that is far below 1 says that the draws lie where the base distribution hardly is, and that p from
    them will be too small.
    """
    return float(np.exp(log_ratios).mean())


def compare_with_naive(found: ThresholdEstimate, reference: ThresholdEstimate, search: int) -> ThresholdComparison:
    """Compare an estimate from a sampler with the longest naive one at the same threshold.

    Raises:
        ValueError: The thresholds differ.

    Example:
        >>> naive = ThresholdEstimate(0.5, n=10_000, events=10, p=1e-3, standard_error=3.2e-4)
        >>> tilted = ThresholdEstimate(0.5, n=1000, events=50, p=1e-3, standard_error=2e-4)
        >>> both = compare_with_naive(tilted, naive, search=4000)
        >>> both.events_ratio, round(both.variance_ratio, 1), round(both.all_in, 1)
        (50.0, 25.0, 5.0)
    """
    if found.gamma != reference.gamma:
        raise ValueError(f"Expected estimates at one threshold, got {found.gamma} and {reference.gamma}.")
    p = reference.p
    events, interval = _ratio_of_shares(found, reference)
    if p == 0.0:
        return ThresholdComparison(found.gamma, events, interval, None, None, None, None)
    alone = p * (1.0 - p) / found.n
    together = p * (1.0 - p) / (found.n + search)
    distance, joint = found.p - p, math.hypot(found.standard_error, reference.standard_error)
    return ThresholdComparison(
        found.gamma,
        events,
        interval,
        variance_ratio=_divide(alone, found.standard_error**2),
        all_in=_divide(together, found.standard_error**2),
        error_ratio=_divide(together, distance**2 + found.standard_error**2),
        errors_off=_divide(distance, joint),
    )


def _ratio_of_shares(found: ThresholdEstimate, reference: ThresholdEstimate) -> tuple[float | None, Interval | None]:
    if reference.events == 0:
        return None, None
    risk = relative_risk(found.events, found.n, reference.events, reference.n)
    if found.events == 0:
        return 0.0, None
    interval = risk.confidence_interval(0.95)
    return float(risk.relative_risk), (float(interval.low), float(interval.high))


def _divide(value: float, by: float) -> float | None:
    return None if by == 0.0 else value / by
