"""Refits of a base distribution: p under each of them, from the failing points of one run.

A base distribution that was fitted to events has an error of its own. Its refits are the same recipe applied to
resampled events (whole clusters of them, where events come in clusters): the spread of p over the refits is the
spread that p owes to the events.

Families of refits: where refits choose the family of distributions anew, p spreads within each and between them.

Refits of one family spread around a value of their own. One standard deviation over all would take the distance between
two families for a spread to both sides: where some refits lie far below p, the upper end would rise as well. Here each
family has an interval around its own centre, and the whole reaches from the lowest end to the highest; what is expected
for the next event is the sum of what each family expects, by its share of the refits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from samplers.analysis.reweight import (
    CanSample,
    HasLogProb,
    check_dimensions_fit,
    log_density,
    require_base,
    subtract_log_densities,
)
from samplers.analysis.weighted import require_sample
from samplers.method import EstimateData
from samplers.problem import Distribution, FloatArray
from samplers.statistics import effective_number, raise_log_end

MIN_REFIT_ESS = 10.0
"""Effective failing points from which p under a refit has an error of about 0.3 in its logarithm: little beside the
usual spread of the refits, 0.7 to 1.5."""
MIN_OWN_ESS = 30.0
"""Effective failing points under the own base from which a lack of points is the refits' and not that of the budget."""
MAX_UNCOVERED_SHARE = 0.1
"""Share of the refits that may rest on fewer points than that."""
REFIT_CHECK_DRAWS = 100
"""Draws on which a refit is compared with its base before the first simulation."""


@runtime_checkable
class FittedBase(Distribution, Protocol):
    """A base distribution that was fitted to events, with its bootstrap refits; without refits it is like any other.

    With `ensemble()`, the mixture of the refits with equal weights (a ValueError where they cannot be mixed), it lets
    `estimate` make a further run where the points of the first do not reach the refits; `covering_ensemble()` is the
    mixture of a few of many refits that reach as far. `refits.log_probs(x)` may give the log densities of all R refits
    at x (k, d) at once, shape (R, k); `refit_families` the number of the family of each, 0 for that of the base.

    Example:
        >>> import samplers
        >>> from samplers.proposals import Gaussian
        >>> class FittedNormal(samplers.StandardNormal):
        ...     refits = [Gaussian(np.array([mean]), np.eye(1)) for mean in (-0.2, 0.0, 0.2)]
        ...     clusters, fitted_to, family = 17, "40 events of 17 scenes", "normal"
        >>> [isinstance(base, samplers.FittedBase) for base in (FittedNormal(1), samplers.StandardNormal(1))]
        [True, False]
    """

    @property
    def refits(self) -> Sequence[HasLogProb]:
        """The same recipe applied to resampled events, R distributions on the same support."""

    @property
    def clusters(self) -> int:
        """Number of independent clusters among the events; of events, where each is one."""

    @property
    def fitted_to(self) -> str:
        """The events in words, such as "38 + 15 events of 17 scenes"."""

    @property
    def family(self) -> str:
        """The family of distributions in words, such as "1 component, log gaps"."""


class RefitSums(NamedTuple):
    """Sums over the failing points under R refits, for m parts of p."""

    log_p: FloatArray
    """Logarithm of the probability, shape (m, R); -inf where a refit has no density at any failing point."""
    ess: FloatArray
    """Effective number of failing points behind it, shape (m, R); a path of a Markov chain counts as one."""


def find_fitted_base(base: object) -> FittedBase | None:
    """Return the base if it has refits; None for any other."""
    return base if isinstance(base, FittedBase) and len(base.refits) > 0 else None


_checked: WeakKeyDictionary[object, tuple[object, ...]] = WeakKeyDictionary()
"""Bases to the refits and the dimension that were found to fit them; a check takes as long as a thousand rollouts."""


def check_refits(base: Distribution, dim: int) -> None:
    """Check the refits of a base distribution, if it has some; once for each base.

    Raises:
        ValueError: If a refit has other dimensions or another support than the base, or no density.
    """
    fitted = find_fitted_base(base)
    if fitted is None:
        return
    known = (dim, *map(id, fitted.refits))
    if _can_be_remembered(fitted) and _checked.get(fitted) == known:
        return
    x = fitted.sample(REFIT_CHECK_DRAWS, np.random.default_rng(0))
    for number, refit in enumerate(fitted.refits, start=1):
        try:
            check_dimensions_fit(refit, dim)
            outside = _count_outside(refit, x)
            if isinstance(refit, CanSample):
                outside += _count_outside(fitted, np.asarray(refit.sample(REFIT_CHECK_DRAWS, np.random.default_rng(0))))
        except ValueError as error:
            raise ValueError(
                f"Refit {number} of {len(fitted.refits)} does not fit its base distribution: {error}"
            ) from error
        if outside:
            raise ValueError(
                f"Refit {number} of {len(fitted.refits)} has another support than its base distribution: some draws "
                "from the one have no finite density under the other."
            )
    if _can_be_remembered(fitted):
        _checked[fitted] = known


def _can_be_remembered(base: object) -> bool:
    """Return whether a base can be a key by its identity."""
    return type(base).__hash__ is object.__hash__ and getattr(type(base), "__weakrefoffset__", 0) != 0


def _count_outside(distribution: HasLogProb, x: FloatArray) -> int:
    """Return at how many of the points x (n, d) the density is 0 or not finite."""
    return int(np.count_nonzero(~np.isfinite(log_density(distribution, x))))


def refit_log_ratios(estimate: EstimateData, refits: Sequence[HasLogProb]) -> FloatArray:
    """Return log(refit_b(x_i) / base(x_i)) at the failing points, shape (R, k); computed once for an estimate.

    Raises:
        ValueError: If there are no weighted points, or a density is not finite.
    """
    sample, base = require_sample(estimate), require_base(estimate)
    of = (sample, base, refits)
    for kept, ratios in estimate.refit_ratios:
        if all(a is b for a, b in zip(kept, of, strict=True)):
            return ratios
    old = log_density(base, sample.x)
    new = _log_densities(refits, sample.x)
    estimate.refit_ratios[:] = [(of, subtract_log_densities(new, old, sample.x))]
    return estimate.refit_ratios[0][1]


def _log_densities(refits: Sequence[HasLogProb], x: FloatArray) -> FloatArray:
    """Return the log density of each refit at x (k, d), shape (R, k)."""
    if hasattr(refits, "log_probs"):  # a user's sequence
        return np.asarray(refits.log_probs(x))
    return np.array([log_density(refit, x) for refit in refits], dtype=np.float64).reshape(len(refits), len(x))


def reweight_to_refits(
    estimate: EstimateData, refits: Sequence[HasLogProb], parts: FloatArray | None = None
) -> RefitSums:
    """Return p under each refit, p_b = sum of w_i refit_b(x_i) / base(x_i) over the failing points.

    As `Estimate.reweight`, without its refusal: refits on few points are counted by the caller, since leaving them out
    would narrow the spread.

    Args:
        estimate: The run.
        refits: R distributions.
        parts: Parts of p: what share of each failing point belongs to it, shape (m, k); None for p itself.

    Raises:
        ValueError: If there are no weighted points, none failed, or a density is not finite.
    """
    sample = require_sample(estimate)
    if len(sample.x) == 0 or estimate.p <= 0:
        raise ValueError("nothing failed, so that p under the refits is not known.")
    return _sum_parts(estimate, refit_log_ratios(estimate, refits), parts)


def _sum_parts(estimate: EstimateData, log_ratios: FloatArray, parts: FloatArray | None) -> RefitSums:
    """Return the sums over the failing points from the density ratios there, shape (R, k)."""
    sample = require_sample(estimate)
    failing = sample.f <= estimate.gamma
    weights = sample.weights[failing]
    parts = np.ones((1, len(weights))) if parts is None else parts
    units = np.unique(sample.units[failing], return_inverse=True)[1]
    with np.errstate(divide="ignore"):  # weights and parts of 0
        log_weights = np.log(parts * weights)
    scale = np.log(estimate.p) - np.log(weights.sum())
    sums = [[_sum_logarithms(row + ratios, units) for row in log_weights] for ratios in log_ratios]
    log_p, ess = np.asarray(sums, dtype=np.float64).reshape(len(log_ratios), len(log_weights), 2).transpose(2, 1, 0)
    return RefitSums(np.minimum(log_p + scale, 0.0), ess)


def reweight_runs_to_refits(
    estimate: EstimateData, refits: Sequence[HasLogProb], split: Callable[[FloatArray], FloatArray] | None = None
) -> RefitSums:
    """Return p under each refit from the run or its further run, whichever has more effective points under that refit.

    The mixture of the refits has its failing points where the refits with the largest p have theirs: the others may
    rest on fewer points than in the first run.

    Raises:
        ValueError: As in `reweight_to_refits`.
    """
    runs = [each for each in (estimate, estimate.ensemble_run) if each is not None and each.p > 0 and each.sample]
    found = [
        reweight_to_refits(run, refits, None if split is None else split(require_sample(run).x))
        for run in runs or [estimate]
    ]
    return choose_better_run(found, [sums.ess.min(axis=0, keepdims=True) for sums in found])


def choose_better_run(found: Sequence[RefitSums], points: Sequence[FloatArray] | None = None) -> RefitSums:
    """Return for each refit the sums of that run which has most effective points.

    Args:
        found: Sums of each run, of m parts and R refits.
        points: Effective points to judge by, shape (m, R) or (1, R) each; None for those of each part.
    """
    ess = np.stack([sums.ess for sums in found])
    best = np.broadcast_to(np.argmax(ess if points is None else np.stack(points), axis=0), ess.shape[1:])[None]
    log_p = np.take_along_axis(np.stack([sums.log_p for sums in found]), best, axis=0)[0]
    return RefitSums(log_p, np.take_along_axis(ess, best, axis=0)[0])


def _sum_logarithms(log_terms: FloatArray, units: NDArray[np.intp]) -> tuple[float, float]:
    """Return the logarithm of the sum of terms (k,) given as logarithms, and the effective number of units in it."""
    highest = float(log_terms.max())
    if not np.isfinite(highest):
        return -np.inf, 0.0
    totals = np.bincount(units, weights=np.exp(log_terms - highest)).astype(np.float64)
    return highest + float(np.log(totals.sum())), effective_number(totals)


def are_uncovered(sums: RefitSums) -> bool:
    """Return whether the points do not reach the refits.

    So it is where more than a tenth of the refits rest on under 10 effective failing points, or one of them on none.
    """
    ess = sums.ess.min(axis=0)
    return count_uncovered(ess) > MAX_UNCOVERED_SHARE * len(ess) or not np.isfinite(sums.log_p).all()


def count_uncovered(ess: Iterable[float]) -> int:
    """Return how many refits rest on under 10 effective failing points."""
    return sum(each < MIN_REFIT_ESS for each in ess)


def pool_refits(base: Any) -> Distribution:
    """Return the mixture of refits that a further run simulates under.

    Raises:
        ValueError: The refits are of a kind that the base cannot mix.
    """
    mix = base.covering_ensemble if hasattr(base, "covering_ensemble") else base.ensemble
    mixture: Distribution = mix()
    return mixture


def needs_ensemble_run(estimate: EstimateData, split: Callable[[FloatArray], FloatArray] | None = None) -> bool:
    """Return whether a further run under the mixture of the refits would tell p, or a part of it, under them.

    False where the base has no refits or no `ensemble`, or where the run, or a part of it, has few effective failing
    points under its own base: another of that size would have as few.
    """
    fitted = find_fitted_base(estimate.base)
    if fitted is None or not hasattr(fitted, "ensemble"):
        return False
    if estimate.sample is None or len(estimate.sample.x) == 0 or estimate.p <= 0:
        return False
    try:
        parts = None if split is None else split(estimate.sample.x)
        own = float(_sum_parts(estimate, np.zeros((1, len(estimate.sample.x))), parts).ess.min())
        return own >= MIN_OWN_ESS and are_uncovered(reweight_to_refits(estimate, fitted.refits, parts))
    except ValueError:  # no points to reweight: the mixture of the refits would not mend that
        return False


MIN_FAMILY_SHARE = 0.05
"""Share of the refits from which a family has an interval of its own: one that fewer choose is not plausible."""
MIN_FAMILY = 10
"""Refits from which a family has a spread of its own; smaller families take the pooled one."""


class RefitFamily(NamedTuple):
    """Refits of one family: log p is about normal around the centre."""

    centre: float
    """Of log p: that of the base distribution itself in its own family, the mean of the refits in another."""
    variance: float
    """Of log p over its refits; pooled over all families where it has few."""
    freedom: int
    """Degrees of freedom of `variance`: its refits less 1; of the pooled one all refits less the number of families."""
    share: float
    """Of the refits that are of this family; 0 for that of the base where no refit chose it."""


def read_refit_families(fitted: object, n_refits: int) -> NDArray[np.int64]:
    """Return the family of each refit, shape (n_refits,); all 0 where the base knows no families."""
    known = getattr(fitted, "refit_families", [0] * n_refits)  # a user's base
    family_of = np.array(known, dtype=np.int64)
    if family_of.shape != (n_refits,):
        raise ValueError(f"Expected one family for each of {n_refits} refits, got {family_of.shape}.")
    return family_of


def split_families(log_p: float, log_values: FloatArray, family_of: NDArray[np.int64]) -> tuple[RefitFamily, ...]:
    """Return the families of the refits, that of the base distribution first.

    All refits are one family where each has one member: nothing tells then a spread within from one between.

    Args:
        log_p: Of the base itself.
        log_values: Of each refit, shape (R,), with R > 1.
        family_of: Of each refit, shape (R,).
    """
    family_of = _merge_single_members(family_of)
    deviations, free = deviate_within_families(log_values[None], family_of)
    pooled = float((deviations**2).sum() / free)
    families = []
    for name in sorted({0, *family_of.tolist()}):
        own = log_values[family_of == name]
        centre = log_p if name == 0 else float(own.mean())
        variance, freedom = (float(own.var(ddof=1)), len(own) - 1) if len(own) >= MIN_FAMILY else (pooled, free)
        families.append(RefitFamily(centre, variance, freedom, len(own) / len(log_values)))
    return tuple(families)


def deviate_within_families(log_values: FloatArray, family_of: NDArray[np.int64]) -> tuple[FloatArray, int]:
    """Return deviations of values (k, R) from the mean of their family, shape (k, R), and their degrees of freedom."""
    names, index = np.unique(_merge_single_members(family_of), return_inverse=True)
    means = np.stack([log_values[:, index == i].mean(axis=1) for i in range(len(names))], axis=1)
    return log_values - means[:, index], len(family_of) - len(names)


def _merge_single_members(family_of: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the families, shape (R,); one for all where each has one member."""
    return np.zeros_like(family_of) if len(np.unique(family_of)) == len(family_of) else family_of


def find_log_ends(
    families: Sequence[RefitFamily], other_variance: float, confidence: float, clusters: int, lineages: float = math.inf
) -> tuple[float, float]:
    """Return the lowest and the highest end of log p over the families.

    Each has the interval centre -+ t S; S^2 is its variance plus `other_variance`, t the quantile for its degrees of
    freedom. The upper end holds the share of p in regions of failure that a search may have missed, which is missing
    under all refits alike. Families that hardly any refits choose are left out, but not that of the base.
    """
    ends = []
    for number, family in enumerate(families):
        if number == 0 or family.share >= MIN_FAMILY_SHARE:
            quantile = refit_quantile(confidence, family.freedom, clusters)
            half = quantile * math.sqrt(family.variance + other_variance)
            ends.append((family.centre - half, family.centre + raise_log_end(half, lineages, confidence)))
    return min(low for low, _ in ends), max(high for _, high in ends)


def refit_quantile(confidence: float, freedom: int, clusters: int) -> float:
    """Return t, the quantile of Student's t for a variance over refits."""
    return float(stdtrit(min(freedom, clusters - 1), 0.5 + confidence / 2))


def expect_over_families(families: Sequence[RefitFamily], largest: float = 1.0) -> float:
    """Return the expectation of p over families and their refits: the probability that the next event fails.

    The sum of share exp(centre + variance / 2), the mean of a log-normal variable, over all families; none counts for
    more than the largest value possible.
    """
    log_largest = math.log(largest)
    return sum(each.share * math.exp(min(each.centre + each.variance / 2, log_largest)) for each in families)
