"""Uncertainty of a ratio of two probabilities under the same refits of one base distribution.

Both probabilities rise and fall together from refit to refit, so that their ratio is known far better than either:
with s the standard deviation of log(p_1b / p_2b) over refits b the interval is ratio exp(-+ t S), one for each family
of refits as in `base_uncertainty`. Being a ratio protects against few events, not against a wrong family of
distributions: in a world with Student t tails it covers 2 to 42 % at 400 events.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from samplers.analysis.base_uncertainty import (
    FIT_BIAS,
    MAX_SPREAD,
    describe_coverage,
    explain_missing_spread,
    scale_by_exp,
)
from samplers.analysis.refits import (
    EnsembleEstimate,
    FittedBase,
    RefitSums,
    find_fitted_base,
    reweight_runs_to_refits,
)
from samplers.serialization import to_json_value
from samplers.statistics.intervals import Interval
from samplers.statistics.refit_families import find_log_ends, read_refit_families, split_families

RATIO_CHECK_DRAWS = 16
"""Draws at which the refits of two estimates are compared."""


@dataclass(frozen=True, kw_only=True)
class RatioUncertainty:
    """What is known of the ratio of two probabilities, given the events that their base distribution was fitted to.

    Example:
        >>> found = RatioUncertainty(
        ...     ratio=1.8, interval=(1.1, 2.9), spread=0.15, confidence=0.95, ratio_refits=(1.7, 1.9, 2.1),
        ...     ess_refits=(150.0, 200.0, 90.0), clusters=17, fitted_to="38 + 15 events of 17 scenes",
        ...     family="1 component, log gaps")
        >>> print(found)
        base distribution 95 %  1.1 to 2.9 (38 + 15 events of 17 scenes, 3 refits)
          assumes that the fitted family is correct (1 component, log gaps); errors of the family are not included
    """

    ratio: float
    """p_1 / p_2 under the base distribution itself."""
    interval: Interval | None
    """Interval that should hold the ratio under the true distribution with probability `confidence`, if that is of
    the fitted family; None where the events do not determine it, or it is not known under the refits."""
    spread: float
    """Standard deviation of the logarithm of the ratio over the refits; NaN where it is not known."""
    confidence: float
    """Nominal coverage of `interval`."""
    ratio_refits: tuple[float, ...]
    """The ratio under each refit; empty where it is not known."""
    ess_refits: tuple[float, ...]
    """Effective number of failing points behind each of these, of the one of the two that has fewer."""
    clusters: int
    """Independent clusters among the events."""
    fitted_to: str
    """The events in words."""
    family: str
    """The family of distributions in words."""
    n_sim: int = 0
    """Simulations of further runs under the mixture of the refits; 0 where none was needed."""
    reason: str = ""
    """Why there is no interval; empty if there is one."""
    warnings: tuple[str, ...] = ()
    """What makes these numbers doubtful."""

    def __str__(self) -> str:
        """Return a few lines for people."""
        if self.interval is None:
            return f"base distribution  no interval: {self.reason}"
        low, high = self.interval
        lines = [
            f"base distribution {100 * self.confidence:g} %  {low:.2g} to {high:.2g} "
            f"({self.fitted_to}, {len(self.ratio_refits)} refits)",
            f"  assumes that the fitted family is correct ({self.family}); errors of the family are not included",
        ]
        if self.n_sim:
            lines.append(f"  under the refits from a further {self.n_sim:,} simulations under their mixture")
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON; NaN and infinities become None."""
        return {name: to_json_value(value) for name, value in asdict(self).items()}


def compute_ratio_uncertainty(first: EnsembleEstimate, second: EnsembleEstimate) -> RatioUncertainty:
    """Return p_1 / p_2 of two estimates with the interval that the events behind their base distribution allow.

    The two are estimates of their own on the same base distribution, of two egos for example. `samplers.compare`
    estimates a ratio from the same draws for both, and states this uncertainty too (`Comparison.base_uncertainty`).

    Args:
        first: Estimate of p_1, on a base distribution with refits.
        second: Estimate of p_2, on the same base distribution; it may have noise coordinates of its own.

    Raises:
        ValueError: If a base has no refits or the refits differ, the confidence differs, or an estimate has no failing
            points.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, seed=0, max_sim=2000)
        >>> compute_ratio_uncertainty(result, result)
        Traceback (most recent call last):
            ...
        ValueError: Expected two estimates on the same base distribution with refits, got StandardNormal.
    """
    bases = _require_same_refits(first, second)
    if first.confidence != second.confidence:
        raise ValueError(
            f"Expected the same confidence, got {first.confidence:g} and {second.confidence:g}; give both estimates "
            "one confidence=..."
        )
    one, two = (reweight_runs_to_refits(each, base.refits) for each, base in zip((first, second), bases, strict=True))
    further = [each.ensemble_run for each in (first, second) if each.ensemble_run is not None]
    return summarise_ratio(
        first.p / second.p,
        math.hypot(first.cov, second.cov),
        RefitSums(np.concatenate([one.log_p, two.log_p]), np.concatenate([one.ess, two.ess])),
        bases[0],
        first.confidence,
        sum(run.n_sim for run in further),
    )


def summarise_ratio(
    ratio: float,
    cov: float,
    sums: RefitSums | None,
    fitted: FittedBase,
    confidence: float,
    n_sim: int = 0,
    sampling: Interval | None = None,
) -> RatioUncertainty:
    """Return the uncertainty of a ratio.

    Args:
        ratio: p_1 / p_2 under the base distribution itself.
        cov: Standard error of its logarithm.
        sums: The two probabilities under R refits, shape (2, R); None where one of them is 0 in the run itself.
        fitted: The base distribution.
        confidence: Nominal coverage.
        n_sim: Simulations of further runs.
        sampling: Interval of the sampling alone, which the interval is to hold; None where it need not.
    """
    log_ratios, ess, reason = np.empty(0), np.empty(0), "one of the two never failed."
    if sums is not None:
        known = np.isfinite(sums.log_p).all(axis=0)
        log_ratios = np.where(known, np.subtract(*np.where(known, sums.log_p, 0.0)), -np.inf)
        ess = sums.ess.min(axis=0)
        reason = explain_missing_spread(log_ratios, fitted.clusters)
    spread = math.nan if reason else float(log_ratios.std(ddof=1))
    interval = None
    if spread > MAX_SPREAD:
        reason = f"the events do not determine the ratio: the spread of its logarithm is {spread:.1f}."
    elif not reason:
        families = split_families(math.log(ratio), log_ratios, read_refit_families(fitted, len(log_ratios)))
        ends = find_log_ends(families, cov**2 + FIT_BIAS**2, confidence, fitted.clusters)
        low, high = (scale_by_exp(1.0, end) for end in ends)
        interval = (low, high) if sampling is None else (min(low, sampling[0]), max(high, sampling[1]))
    return RatioUncertainty(
        ratio=ratio,
        interval=interval,
        spread=spread,
        confidence=confidence,
        ratio_refits=tuple(scale_by_exp(1.0, float(each)) for each in log_ratios),
        ess_refits=tuple(float(each) for each in ess),
        clusters=fitted.clusters,
        fitted_to=fitted.fitted_to,
        family=fitted.family,
        n_sim=n_sim,
        reason=reason,
        warnings=describe_coverage(ess),
    )


def _require_same_refits(first: EnsembleEstimate, second: EnsembleEstimate) -> tuple[FittedBase, FittedBase]:
    """Return the bases of both, or raise a ValueError unless both have the same refits.

    Densities are compared where both have the same coordinates; with noise coordinates of one of them only the number
    of refits and the events can be.
    """
    bases = [find_fitted_base(each.base) for each in (first, second)]
    for base, each in zip(bases, (first, second), strict=True):
        if base is None:
            raise ValueError(
                f"Expected two estimates on the same base distribution with refits, got {type(each.base).__name__}."
            )
    one, two = (base for base in bases if base is not None)
    x, y = (base.sample(RATIO_CHECK_DRAWS, np.random.default_rng(0)) for base in (one, two))
    same = (one.fitted_to, one.family, len(one.refits)) == (two.fitted_to, two.family, len(two.refits))
    if same and x.shape == y.shape:
        pairs = zip(one.refits, two.refits, strict=True)
        same = all(np.allclose(a.log_prob(x), b.log_prob(x), rtol=1e-9, atol=1e-9) for a, b in pairs)
    if not same:
        raise ValueError(
            f"Expected two estimates under the same refits, got {len(one.refits)} of {one.fitted_to} ({one.family}) "
            f"and {len(two.refits)} of {two.fitted_to} ({two.family}), with other densities."
        )
    return one, two
