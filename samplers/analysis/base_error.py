"""Uncertainty of the base distribution: intervals of p, of a ratio and of a curve that the events behind a base allow.

With p_b the probability under refit b, s the standard deviation of log p_b and t a quantile of Student's t,

    p exp(-t S) to p exp(t S),    S^2 = s^2 + cov^2 + 0.2^2,

the upper limit raised by the share of p that a search may have missed, as that of the sampling interval is
(`samplers.sample`): S does not hold it, since the refits miss what the run misses. It is nowhere
narrower than the sampling interval, which of few draws is wider than their c.o.v. says.

Percentiles of the p_b are not used: refits repeat the bias of the fit, and 30 of them do not reach the outer 2.5 %, so
that percentiles cover 76 and 82 % (38 and 400 events) and miss on the unsafe side. This interval covers 93 and 92 %
where the family of distributions is the true one (`benchmarks/uncertainty/base_coverage.py`). Another family is not
covered by it.

Two probabilities under the same refits rise and fall together from refit to refit, so that their ratio is known far
better than either: with s the standard deviation of log(p_1b / p_2b) the interval is ratio exp(-+ t S). Being a ratio
protects against few events, not against a wrong family of distributions: in a world with Student t tails it covers 2 to
42 % at 400 events.

The band of a falling curve has at each threshold such an interval, at the level at which normal errors with the
correlation of the log p over the refits (within a family of them), of the sampling and of the bias of the fit stay
within their intervals at all thresholds together (sup-t, as in `samplers.analysis.weighted`). For Student's t the level
is on the safe side: its large values come together.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from samplers.analysis.reweight import (
    FittedBase,
    RefitSums,
    count_uncovered,
    deviate_within_families,
    expect_over_families,
    find_fitted_base,
    find_log_ends,
    read_refit_families,
    reweight_runs_to_refits,
    split_families,
)
from samplers.analysis.weighted import Reported, estimate_known, require_sample, simultaneous_level
from samplers.method import EstimateData
from samplers.output import format_alike, say
from samplers.problem import FloatArray
from samplers.sample import Interval

FIT_BIAS = 0.2
"""Bias of the fit itself in log p (floor of the covariances, local optima of the mixture), which refits repeat: it
keeps the interval of thousands of events from being too narrow, and is nothing beside the spread at 38."""
MIN_REFITS = 2
"""Refits, and clusters of events, from which there is a spread at all."""


@dataclass(frozen=True, kw_only=True)
class BaseUncertainty(Reported):
    """What is known of p, of a mean over failures or of a ratio, given the events that the base was fitted to.

    Example:
        >>> from samplers.analysis import BaseUncertainty
        >>> found = BaseUncertainty(
        ...     value=7.8e-4, interval=(3.2e-5, 1.9e-2), expected=2e-3, spread=1.4, confidence=0.95,
        ...     value_refits=(2e-4, 1e-3, 3e-3), ess_refits=(150.0, 200.0, 90.0), clusters=17,
        ...     fitted_to="38 + 15 events of 17 scenes", family="1 component, log gaps")
        >>> print(found)  # doctest: +NORMALIZE_WHITESPACE
        base distribution 95 %  3.2e-05 to 1.9e-02 (38 + 15 events of 17 scenes, 3 refits); predictive mean
        2e-03
          assumes that the fitted family is correct (1 component, log gaps); errors of the family are not included
    """

    value: float
    """Under the base distribution itself."""
    interval: Interval | None
    """Interval that should hold the value of the true distribution with probability `confidence`, if that is of the
    fitted family; None if the events do not determine it, or it is not known under the refits."""
    expected: float | None = None
    """Probability that the next event fails, the error of the fit averaged: p exp(s^2 / 2) with s the standard
    deviation of log p over the refits; over several families of refits the sum of such means, by their shares. None for
    a ratio."""
    spread: float
    """Standard deviation of the value's logarithm over the refits; NaN where it is not known."""
    bound: float | None = None
    """Upper limit of p in place of an interval, if the events do not determine it (a spread above 2)."""
    confidence: float
    """Nominal coverage of `interval`."""
    value_refits: tuple[float, ...]
    """The value under each refit; empty where it is not known."""
    ess_refits: tuple[float, ...]
    """Effective number of failing points behind the value under each refit, for a ratio of the side that has fewer; a
    path of a Markov chain counts as one."""
    clusters: int
    """Independent clusters among the events."""
    fitted_to: str
    """The events in words."""
    family: str
    """The family of distributions in words."""
    n_sim: int = 0
    """Simulations of further runs under the mixture of the refits; 0 if none was needed."""
    reason: str = ""
    """Why there is no interval, or the value under the refits is not known; empty if there is nothing to say."""
    warnings: tuple[str, ...] = ()
    """What makes these numbers doubtful."""

    def __str__(self) -> str:
        """Return a few lines for people."""
        behind = f"({self.fitted_to}, {len(self.value_refits)} refits)"
        if self.interval is not None:
            form = ".2g" if self.expected is None else ".1e"
            low, high = (format(end, form) for end in self.interval)
            first = f"{100 * self.confidence:g} %  {low} to {high} {behind}"
            first += "" if self.expected is None else f"; predictive mean {self.expected:.0e}"
        elif self.bound is not None:
            what = f"a lower limit; below {format_alike(self.bound)[0]}" if self.bound < 1 else "limits"
            first = f" {say('too few events', what=what)} in this family {behind}"
        else:
            return f"base distribution  no interval: {self.reason}"
        lines = [
            f"base distribution {first}",
            f"  assumes that the fitted family is correct ({self.family}); errors of the family are not included",
        ]
        if self.n_sim:
            lines.append(f"  with {self.n_sim:,} more simulations from the mixture of the refits")
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])


def compute_base_uncertainty(estimate: EstimateData) -> BaseUncertainty | None:
    """Return the uncertainty of p that the events leave, or None if the base distribution has no refits.

    p under each refit comes from the failing points of the run; if there is a further run under the mixture of the
    refits, from those of the two that are worth more effective points under that refit. The lower limit is that of the
    failures with an outcome where the others only bound p (`on_error="bound"`).
    """
    fitted = find_fitted_base(estimate.base)
    if fitted is None:
        return None
    further = estimate.ensemble_run
    found = summarise_refits(
        estimate.p,
        estimate.cov,
        estimate.confidence,
        fitted,
        lambda: reweight_runs_to_refits(estimate, fitted.refits),
        sampling=estimate.interval,
        lineages=estimate.lineages,
        n_sim=0 if further is None else further.n_sim,
        doubts=[] if further is None else [f"in the further run: {text}" for text in further.warnings],
    )
    if found.interval is None or estimate.on_error != "bound" or estimate.no_outcome_share == 0:
        return found
    p, cov, _ = estimate_known(estimate, estimate.gamma, estimate.confidence)
    known = None
    if p > 0:

        def mark(run: EstimateData) -> FloatArray:  # the failing points that have an outcome
            sample = require_sample(run)
            return np.isfinite(sample.f[sample.f <= run.gamma])[None].astype(np.float64)

        sums = partial(reweight_runs_to_refits, estimate, fitted.refits, mark)
        known = summarise_refits(p, cov, estimate.confidence, fitted, sums, sampling=estimate.interval).interval
    return replace(found, interval=(0.0 if known is None else known[0], found.interval[1]))


def summarise_refits(
    value: float,
    cov: float,
    confidence: float,
    fitted: FittedBase,
    compute_sums: Callable[[], RefitSums],
    *,
    sampling: Interval | None = None,
    lineages: float = math.inf,
    largest: float = 1.0,
    n_sim: int = 0,
    doubts: Sequence[str] = (),
    is_ratio: bool = False,
) -> BaseUncertainty:
    """Return the uncertainty of p, of another mean over failures or of a ratio from its values under refits.

    `largest` is the largest value that a mean can have, in units of which the sums are; for a ratio, these are of the
    two probabilities. A ValueError says why there are none. The interval holds that of the sampling, and its upper
    limit what a search of some `lineages` may miss.
    """
    try:
        (log_p, all_ess), reason = compute_sums(), ""
    except ValueError as error:
        (log_p, all_ess), reason = np.empty((2, 1 + is_ratio, 0)), str(error)
    log_values, ess = log_p[0] + math.log(largest), all_ess.min(axis=0)
    if is_ratio:
        known = np.isfinite(log_p).all(axis=0)
        log_values = np.where(known, np.subtract(*np.where(known, log_p, 0.0)), -np.inf)
    reason = reason or _explain_missing_spread(log_values, fitted.clusters)
    interval, expected, spread, bound = None, None, math.nan, None
    if not reason:
        families = split_families(math.log(value), log_values, read_refit_families(fitted, len(log_values)))
        ends = find_log_ends(families, cov**2 + FIT_BIAS**2, confidence, fitted.clusters, lineages)
        low, high = _exp(ends[0]), _exp(ends[1])
        high = high if is_ratio else min(largest, high)
        if sampling is not None:
            low, high = min(low, sampling[0]), max(high, sampling[1])
        spread = float(log_values.std(ddof=1))
        if spread <= 2.0:  # above, the events do not determine p
            interval, expected = (low, high), None if is_ratio else expect_over_families(families, largest)
        elif is_ratio:
            few = say("too few events", what="limits of the ratio")
            reason = f"{few} (standard deviation of its logarithm {spread:.1f})."
        else:
            bound = high
    with np.errstate(over="ignore"):
        values = np.exp(log_values)
    uncovered = count_uncovered(ess)
    about = f"{uncovered} of {len(ess)} refits rest on fewer than 10 effective failing points"
    coarse = [f"{about}: their interval is imprecise; more simulations (max_sim) help."]
    return BaseUncertainty(
        value=value,
        interval=interval,
        expected=expected,
        spread=spread,
        bound=bound,
        reason=reason,
        confidence=confidence,
        value_refits=tuple(float(each) for each in values),
        ess_refits=tuple(float(each) for each in ess),
        clusters=fitted.clusters,
        fitted_to=fitted.fitted_to,
        family=fitted.family,
        n_sim=n_sim,
        warnings=(*(coarse if uncovered else ()), *doubts),
    )


def _explain_missing_spread(log_values: FloatArray, clusters: int) -> str:
    """Return why values of the refits (R,), as logarithms, have no spread; empty if they have one."""
    if len(log_values) < MIN_REFITS or clusters < MIN_REFITS:
        return f"a spread needs {MIN_REFITS} refits and {MIN_REFITS} clusters, got {len(log_values)} and {clusters}."
    missing = int(np.count_nonzero(~np.isfinite(log_values)))
    if missing:
        return f"{missing} of {len(log_values)} refits have no density at any failing point, so that p is not known."
    return ""


def _exp(exponent: float) -> float:
    """Return exp(exponent); inf if that is no float."""
    return math.exp(exponent) if exponent < math.log(np.finfo(np.float64).max) else math.inf


@dataclass(frozen=True, eq=False, kw_only=True)
class RefitBand(Reported):
    """Band of an exceedance curve that the events behind a fitted base allow, for all thresholds together.

    Fields of shape (k,) belong to the thresholds of the curve.

    Example:
        >>> import numpy as np
        >>> from samplers.analysis import RefitBand
        >>> ends = {"low": np.array([1e-4, 0.0]), "high": np.array([4e-3, 4e-3]), "spread": np.array([0.9, np.nan])}
        >>> band = RefitBand(**ends, confidence=0.95, n_refits=30, fitted_to="40 events", family="1 component")
        >>> band.to_dict()["spread"]
        [0.9, None]
    """

    low: FloatArray
    """Lower limits, shape (k,); 0 if the events do not determine the probability, or too few units exceed the
    threshold, and no higher threshold has one."""
    high: FloatArray
    """Upper limits, shape (k,); where too few units exceed the threshold, that of the next lower one."""
    spread: FloatArray
    """Standard deviation of log P over the refits, shape (k,); NaN where it is not known."""
    confidence: float
    """Nominal probability that the band holds the truth at all thresholds together, if it is of the fitted family."""
    n_refits: int
    """Number of refits."""
    fitted_to: str
    """The events in words."""
    family: str
    """The family of distributions in words."""


def compute_refit_band(
    thresholds: FloatArray,
    p: FloatArray,
    cov: FloatArray,
    correlation: FloatArray,
    sums: RefitSums,
    fitted: FittedBase,
    *,
    confidence: float,
    seed: int,
    lineages: float = math.inf,
) -> RefitBand:
    """Return the band for probabilities P[failure and v > t] at k thresholds t (k,), in any order.

    p (k,) is under the base itself, 0 where it is not known, with its c.o.v. (k,) and the correlation (k, k) of the
    sampling errors; `sums` has the same under R refits. As the curve falls, so do both ends.
    """
    known = [i for i in range(len(p)) if p[i] > 0 and not _explain_missing_spread(sums.log_p[i], fitted.clusters)]
    low, high, spread = np.zeros(len(p)), np.ones(len(p)), np.full(len(p), np.nan)
    if known:
        families = read_refit_families(fitted, sums.log_p.shape[1])
        deviations, freedom = deviate_within_families(sums.log_p[known], families)
        sampling = np.outer(cov[known], cov[known]) * correlation[np.ix_(known, known)]
        covariance = deviations @ deviations.T / freedom + sampling + FIT_BIAS**2
        scale = 1 / np.sqrt(np.diag(covariance))
        level = simultaneous_level(np.asarray(covariance * np.outer(scale, scale)), confidence, seed)
    for i in known:
        own = partial(RefitSums, sums.log_p[i : i + 1], sums.ess[i : i + 1])
        found = summarise_refits(float(p[i]), float(cov[i]), level, fitted, own, lineages=lineages)
        low[i], high[i] = found.interval or (0.0, 1.0 if found.bound is None else found.bound)
        spread[i] = found.spread
    rising = np.argsort(thresholds)
    high[rising] = np.minimum.accumulate(high[rising])
    low[rising] = np.maximum.accumulate(low[rising][::-1])[::-1]
    return RefitBand(
        low=low,
        high=high,
        spread=spread,
        confidence=confidence,
        n_refits=len(fitted.refits),
        fitted_to=fitted.fitted_to,
        family=fitted.family,
    )
