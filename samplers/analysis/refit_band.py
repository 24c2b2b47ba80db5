"""Refit band: intervals of a falling curve of probabilities that the events behind a fitted base allow, together.

At each threshold the interval is that of `base_uncertainty`, p exp(-+ t S), at a level higher than that of the band:
the level at which normal errors with the correlation of the log p over the refits (within a family of them), of the
sampling and of the bias of the fit stay within their intervals at all thresholds together (sup-t, as in
`samplers.statistics.simultaneous`). For Student's t the level is on the safe side: its large values come together.
As the curve falls, so may both ends.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from samplers.analysis.base_uncertainty import FIT_BIAS, explain_missing_spread, summarise_refits
from samplers.analysis.refits import FittedBase, RefitSums
from samplers.problem import FloatArray
from samplers.serialization import to_json_value
from samplers.statistics.refit_families import deviate_within_families, read_refit_families
from samplers.statistics.simultaneous import band_generator, simultaneous_level


@dataclass(frozen=True, eq=False, kw_only=True)
class RefitBand:
    """Band of an exceedance curve that the events behind a fitted base allow, for all thresholds together.

    Fields of shape (k,) belong to the thresholds of the curve.

    Example:
        >>> ends = {"low": np.array([1e-4, 0.0]), "high": np.array([4e-3, 4e-3]), "spread": np.array([0.9, np.nan])}
        >>> band = RefitBand(**ends, confidence=0.95, n_refits=30, fitted_to="40 events", family="1 component")
        >>> band.to_dict()["spread"]
        [0.9, None]
    """

    low: FloatArray
    """Lower ends, shape (k,); 0 where the events do not determine the probability, or too few units exceed the
    threshold, and no higher threshold has one."""
    high: FloatArray
    """Upper ends, shape (k,); where too few units exceed the threshold, that of the next lower one."""
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

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON; NaN becomes None."""
        values = asdict(self)
        return {name: to_json_value(v.tolist() if isinstance(v, np.ndarray) else v) for name, v in values.items()}


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
    """Return the band for probabilities P[failure and v > t] at k thresholds t.

    Args:
        thresholds: t in any order, shape (k,).
        p: Under the base itself, shape (k,); 0 where it is not known.
        cov: Their coefficients of variation, shape (k,).
        correlation: Of their sampling errors, shape (k, k).
        sums: The same under R refits, k parts.
        fitted: The base.
        confidence: Nominal coverage of the band.
        seed: Of the run.
        lineages: Independent searches behind p, see `Sample.lineages`.
    """
    known = [i for i in range(len(p)) if p[i] > 0 and not explain_missing_spread(sums.log_p[i], fitted.clusters)]
    low, high, spread = np.zeros(len(p)), np.ones(len(p)), np.full(len(p), np.nan)
    if known:
        errors = _correlate_errors(cov[known], correlation[np.ix_(known, known)], sums.log_p[known], fitted)
        level = simultaneous_level(errors, confidence, band_generator(seed))
    for i in known:
        values = RefitSums(sums.log_p[i : i + 1], sums.ess[i : i + 1])
        found = summarise_refits(float(p[i]), float(cov[i]), level, fitted, values, lineages=lineages)
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


def _correlate_errors(cov: FloatArray, correlation: FloatArray, log_p: FloatArray, fitted: FittedBase) -> FloatArray:
    """Return the correlation of the errors of log p at k thresholds, shape (k, k); log_p of R refits is (k, R)."""
    deviations, freedom = deviate_within_families(log_p, read_refit_families(fitted, log_p.shape[1]))
    covariance = deviations @ deviations.T / freedom + np.outer(cov, cov) * correlation + FIT_BIAS**2
    scale = 1 / np.sqrt(np.diag(covariance))
    return np.asarray(covariance * np.outer(scale, scale))
