"""Uncertainty of the base distribution: the interval of p that the events behind a fitted base allow.

With p_b the probability under refit b, s the standard deviation of log p_b and t a quantile of Student's t,

    p exp(-t S) to p exp(t S),    S^2 = s^2 + cov^2 + 0.2^2,

the upper end raised by the share of p that a search may have missed, as that of the sampling interval is
(`samplers.statistics.unseen_share`): S does not hold it, since the refits miss what the run misses. It is nowhere
narrower than the sampling interval, which of few draws is wider than their c.o.v. says.

Where refits choose their family anew, each family has such an interval, and the whole reaches from the lowest end to
the highest; what is expected for the next event is a sum over the families (`samplers.statistics.refit_families`).
Percentiles of the p_b are not used: refits repeat the bias of the fit, and 30 of them do not reach the outer 2.5 %, so
that percentiles cover 76 and 82 % (38 and 400 events) and miss on the unsafe side. This interval covers 93 and 92 %
where the family of distributions is the true one (`benchmarks/uncertainty/base_coverage.py`). Another family is not
covered by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from samplers.analysis.base import WeightedEstimate, no_outcome_weight, require_sample
from samplers.analysis.refits import (
    MAX_UNCOVERED_SHARE,
    EnsembleEstimate,
    FittedBase,
    RefitSums,
    count_uncovered,
    find_fitted_base,
    reweight_runs_to_refits,
)
from samplers.problem import FloatArray
from samplers.serialization import to_json_value
from samplers.statistics.intervals import Interval
from samplers.statistics.refit_families import (
    expect_over_families,
    find_log_ends,
    read_refit_families,
    split_families,
)

FIT_BIAS = 0.2
"""Bias of the fit itself in log p (floor of the covariances, local optima of the mixture), which refits repeat: it
keeps the interval of thousands of events from being too narrow, and is nothing beside the spread at 38."""
MAX_SPREAD = 2.0
"""Standard deviation of log p_b above which the events do not determine p."""
MIN_REFITS = 2
"""Refits, and clusters of events, from which there is a spread at all."""


@dataclass(frozen=True, kw_only=True)
class BaseUncertainty:
    """What is known of p, given the events that the base distribution was fitted to.

    Example:
        >>> found = BaseUncertainty(
        ...     p=7.8e-4, interval=(3.2e-5, 1.9e-2), expected=2e-3, spread=1.4, bound=None, confidence=0.95,
        ...     p_refits=(2e-4, 1e-3, 3e-3), ess_refits=(150.0, 200.0, 90.0), clusters=17,
        ...     fitted_to="38 + 15 events of 17 scenes", family="1 component, log gaps")
        >>> print(found)  # doctest: +NORMALIZE_WHITESPACE
        base distribution 95 %  3.2e-05 to 1.9e-02 (38 + 15 events of 17 scenes, 3 refits); predictive mean
        2e-03
          assumes that the fitted family is correct (1 component, log gaps); errors of the family are not included
    """

    p: float
    """Probability under the base distribution itself."""
    interval: Interval | None
    """Interval that should hold the p of the true distribution with probability `confidence`, if that is of the fitted
    family; None where the events do not determine p, or p under the refits is not known."""
    expected: float | None
    """Probability that the next event fails, the error of the fit averaged: p exp(s^2 / 2) with s the standard
    deviation of log p over the refits; over several families of refits the sum of such means, by their shares."""
    spread: float
    """Standard deviation of log p over the refits; NaN where it is not known."""
    bound: float | None
    """Upper end in place of an interval, where the events do not determine p (a spread above 2)."""
    confidence: float
    """Nominal coverage of `interval`."""
    p_refits: tuple[float, ...]
    """p under each refit; empty where it is not known."""
    ess_refits: tuple[float, ...]
    """Effective number of failing points behind each of these; a path of a Markov chain counts as one."""
    clusters: int
    """Independent clusters among the events."""
    fitted_to: str
    """The events in words."""
    family: str
    """The family of distributions in words."""
    n_sim: int = 0
    """Simulations of the further run under the mixture of the refits; 0 where none was needed."""
    reason: str = ""
    """Why p under the refits, or their spread, is not known; empty if it is."""
    warnings: tuple[str, ...] = ()
    """What makes these numbers doubtful."""

    def __str__(self) -> str:
        """Return a few lines for people."""
        behind = f"({self.fitted_to}, {len(self.p_refits)} refits)"
        if self.interval is not None:
            low, high = self.interval
            first = f"{100 * self.confidence:g} %  {low:.1e} to {high:.1e} {behind}"
            first += "" if self.expected is None else f"; predictive mean {self.expected:.0e}"
        elif self.bound is not None:
            below = f"below {self.bound:.1e} in this family" if self.bound < 1 else "nor an upper end in this family"
            first = f" the events do not determine p; {below} {behind}"
        else:
            return f"base distribution  no interval: {self.reason}"
        lines = [
            f"base distribution {first}",
            f"  assumes that the fitted family is correct ({self.family}); errors of the family are not included",
        ]
        if self.n_sim:
            lines.append(f"  p of the refits from a further {self.n_sim:,} simulations under their mixture")
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON; NaN becomes None."""
        return {name: to_json_value(value) for name, value in asdict(self).items()}


def compute_base_uncertainty(estimate: EnsembleEstimate) -> BaseUncertainty | None:
    """Return the uncertainty of p that the events leave, or None where the base distribution has no refits.

    p under each refit comes from the failing points of the run; where there is a further run under the mixture of the
    refits, from those of the two that are worth more effective points under that refit. The lower end leaves out
    points without an outcome where these only bound p (`on_error="bound"`).

    Args:
        estimate: With weighted points, on a base distribution with refits; see `Estimate.base_uncertainty`.
    """
    fitted = find_fitted_base(estimate.base)
    if fitted is None:
        return None
    sums, low_factor, reason = RefitSums(np.empty((1, 0)), np.empty((1, 0))), 1.0, ""
    try:
        sums = reweight_runs_to_refits(estimate, fitted.refits)
        low_factor = _lower_factor(estimate)
    except ValueError as error:
        reason = str(error)
    further = estimate.ensemble_run
    doubts = [] if further is None else [f"in the further run: {text}" for text in further.warnings]
    return summarise_refits(
        estimate.p,
        estimate.cov,
        estimate.confidence,
        fitted,
        sums,
        sampling=estimate.interval,
        lineages=read_lineages(estimate),
        low_factor=low_factor,
        n_sim=0 if further is None else further.n_sim,
        doubts=doubts,
        reason=reason,
    )


def summarise_refits(
    value: float,
    cov: float,
    confidence: float,
    fitted: FittedBase,
    sums: RefitSums,
    *,
    sampling: Interval | None = None,
    lineages: float = math.inf,
    low_factor: float = 1.0,
    largest: float = 1.0,
    n_sim: int = 0,
    doubts: Sequence[str] = (),
    reason: str = "",
) -> BaseUncertainty:
    """Return the uncertainty of a probability, or of another expectation over failures, from its values under refits.

    Args:
        value: Under the base distribution itself.
        cov: Its coefficient of variation.
        confidence: Nominal coverage of the interval.
        fitted: The base.
        sums: Values under each refit, one row; as shares of `largest`.
        sampling: Interval of the sampling alone, which the interval is to hold; None where it need not.
        lineages: Independent searches behind the value, see `Sample.lineages`; inf without a search.
        low_factor: Factor of the lower end.
        largest: Largest value possible, 1 for a probability.
        n_sim: Simulations of a further run.
        doubts: Further warnings.
        reason: Why the values are not known.
    """
    log_values, ess = sums.log_p[0] + math.log(largest), sums.ess[0]
    reason = reason or explain_missing_spread(log_values, fitted.clusters)
    interval, expected, spread, bound = None, None, math.nan, None
    if not reason:
        spread = float(log_values.std(ddof=1))
        families = split_families(math.log(value), log_values, read_refit_families(fitted, len(log_values)))
        below, above = find_log_ends(families, cov**2 + FIT_BIAS**2, confidence, fitted.clusters, lineages)
        low, high = low_factor * scale_by_exp(1.0, below), min(largest, scale_by_exp(1.0, above))
        low, high = (low, high) if sampling is None else (min(low, sampling[0]), max(high, sampling[1]))
        if spread <= MAX_SPREAD:
            interval, expected = (low, high), expect_over_families(families, largest)
        else:
            bound = high
    return BaseUncertainty(
        p=value,
        interval=interval,
        expected=expected,
        spread=spread,
        bound=bound,
        reason=reason,
        confidence=confidence,
        p_refits=tuple(float(each) for each in np.exp(log_values)),
        ess_refits=tuple(float(each) for each in ess),
        clusters=fitted.clusters,
        fitted_to=fitted.fitted_to,
        family=fitted.family,
        n_sim=n_sim,
        warnings=(*describe_coverage(ess), *doubts),
    )


def explain_missing_spread(log_values: FloatArray, clusters: int) -> str:
    """Return why values of the refits (R,), as logarithms, have no spread; empty if they have one."""
    if len(log_values) < MIN_REFITS or clusters < MIN_REFITS:
        return f"a spread needs {MIN_REFITS} refits and {MIN_REFITS} clusters, got {len(log_values)} and {clusters}."
    missing = int(np.count_nonzero(~np.isfinite(log_values)))
    if missing:
        return f"{missing} of {len(log_values)} refits have no density at any failing point, so that p is not known."
    return ""


def scale_by_exp(value: float, exponent: float) -> float:
    """Return value exp(exponent) for value > 0, formed in logarithms; inf where that is no float."""
    exponent += math.log(value)
    return math.exp(exponent) if exponent < math.log(np.finfo(np.float64).max) else math.inf


def describe_coverage(ess: FloatArray) -> tuple[str, ...]:
    """Return a warning if more than a tenth of the refits rest on under 10 effective failing points (R,)."""
    few = count_uncovered(ess)
    if few <= MAX_UNCOVERED_SHARE * len(ess):
        return ()
    return (f"{few} of {len(ess)} refits rest on under 10 effective failing points: the spread is coarse.",)


def read_lineages(estimate: WeightedEstimate) -> float:
    """Return the independent searches that reached failure behind an estimate; inf without a search or points."""
    return math.inf if estimate.sample is None else estimate.sample.lineages


def _lower_factor(estimate: WeightedEstimate) -> float:
    """Return the share of p from points that have an outcome where the others only bound p; else 1."""
    sample = require_sample(estimate)
    return 1 - no_outcome_weight(estimate, sample) / float(sample.weights[sample.f <= estimate.gamma].sum())
