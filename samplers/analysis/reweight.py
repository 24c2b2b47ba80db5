"""Reweighting: p under another base distribution, and under the refits of a fitted one, from the same simulations.

A base distribution that was fitted to events has an error of its own. Its refits are the same recipe applied to
resampled events (whole clusters of them, where events come in clusters): the spread of p over the refits is the
spread that p owes to the events.

Refits may choose the family of distributions anew, and those of one family spread around a value of their own. One
standard deviation over all would take the distance between two families for a spread to both sides: where some refits
lie far below p, the upper limit would rise as well. So each family has an interval around its own centre, and the whole
reaches from the lowest end to the highest; what is expected for the next event is the sum of what each family expects,
by its share of the refits.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from samplers.analysis.weighted import (
    MIN_UNITS,
    Reported,
    add_unresolved,
    cov_inflation,
    has_independent_points,
    interval_of_sum,
    require_sample,
)
from samplers.bases import as_distribution, convert
from samplers.method import EstimateData
from samplers.output import format_alike
from samplers.problem import Distribution, FloatArray
from samplers.sample import Interval, Sample, add_unseen, effective_number, raise_log_end

MIN_POINTS = 30.0
"""Effective number of failing points that the estimate must rest on."""
MAX_LOG = 600.0
"""exp of this, or of its negative, is still a float."""
SUPPORT_DRAWS = 10_000
"""Draws from the new base that are checked for a density of 0 under the old one."""
REFIT_CHECK_DRAWS = 100
"""Draws on which a refit is compared with its base before the first simulation."""


@runtime_checkable
class FittedBase(Distribution, Protocol):
    """A base distribution that was fitted to events, with its bootstrap refits; without refits it is like any other.

    With `ensemble()`, the mixture of the refits with equal weights (a ValueError where they cannot be mixed), it lets
    `estimate` make a further run where the points of the first do not reach the refits; `covering_ensemble()` is the
    mixture of a few of many refits that reach as far; `refit_families` the number of the family of each, 0 for that of
    the base.

    Example:
        >>> import numpy as np, samplers
        >>> from samplers.proposals import Gaussian
        >>> class FittedNormal(samplers.distributions.StandardNormal):
        ...     refits = [Gaussian(np.array([mean]), np.eye(1)) for mean in (-0.2, 0.0, 0.2)]
        ...     clusters, fitted_to, family = 17, "40 events of 17 scenes", "normal"
        >>> bases = FittedNormal(1), samplers.distributions.StandardNormal(1)
        >>> [isinstance(base, samplers.analysis.FittedBase) for base in bases]
        [True, False]
    """

    @property
    def refits(self) -> Sequence[Any]:
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


@dataclass(frozen=True, kw_only=True)
class Reweighted(Reported):
    """P[f(X) <= gamma] with X from another base distribution.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=100_000)
        >>> same = result.reweight(problem.base)
        >>> same.ratio, same.p == result.p, round(same.units) == result.failures.total
        (1.0, True, True)
    """

    p: float
    """Estimated probability under the new base."""
    interval: Interval
    """Interval that should hold the true p with probability `confidence`."""
    confidence: float
    """Nominal coverage of `interval`."""
    cov: float
    """Coefficient of variation of p."""
    ess: float
    """Effective number of failing points behind p, (sum w)^2 / sum w^2."""
    units: float
    """Effective number of independent units that these come from: the same for independent draws."""
    gamma: float
    """Threshold of failure."""
    ratio: float
    """p over the p of the old base."""

    def __str__(self) -> str:
        """Return two lines for people."""
        p, low, high = format_alike(self.p, *self.interval)
        return (
            f"P[f <= {self.gamma:g}] = {p} with the new base, {self.ratio:.2g} times that with the old\n"
            f"  {100 * self.confidence:g} % interval {low} to {high}, c.o.v. {self.cov:.2g}; "
            f"effective sample size {self.ess:.0f} failing points, {self.units:.0f} independent units"
        )


def reweight_estimate(estimate: EstimateData, new_base: Any) -> Reweighted:
    """Return p under another base; see `Estimate.reweight`.

    p1 = sum of w r over the failing points, r = p1(x) / p0(x). With T_c the sums over units, its
    variance is sum T_c^2 - p1^2 / n, to which the largest T_c^2 is added: where one term dominates, the
    sample variance is too small most of the time. The interval is log-normal with the t
    quantile of the effective units. If p rests on a search, the upper limit holds the share that it may have missed,
    as that of the estimate does; its lineages count for less as the effective units become fewer. A stratum without a
    failing point keeps its upper limit, with its share in the new base where that has one of the same name.
    """
    sample = require_sample(estimate)
    if isinstance(new_base, str):
        base: Any = require_base(estimate)
        if not hasattr(base, "sibling"):  # the user's own class
            raise ValueError(f"The base distribution knows no others by name: give one in place of {new_base!r}.")
        new_base = base.sibling(new_base)
    if isinstance(new_base, list | tuple) or convert(new_base) is not None:
        new_base = as_distribution(new_base, sample.x.shape[1])
    strata, new = ([s.name for s in getattr(one, "strata", None) or ()] for one in (estimate.base, new_base))
    if strata and new and strata != new:
        raise ValueError(f"Expected a base with the strata {', '.join(strata)}, in this order; got {', '.join(new)}.")
    failing = sample.f <= estimate.gamma
    f, old, owners = sample.f[failing], sample.weights[failing], sample.units[failing]
    log_ratios = _log_density_ratios(estimate, new_base, sample.x)
    highest = float(log_ratios.max())
    largest = highest if math.isfinite(highest) else 0.0  # taken out, so that nothing overflows
    terms = old * np.exp(log_ratios - largest)
    ess, total, independent = effective_number(terms), float(terms.sum()), has_independent_points(sample)
    units, cov = _spread_of_units(terms, owners, sample.n_units)
    if ess < MIN_POINTS or units < MIN_UNITS:
        raise ValueError(
            f"Under the new base the failing points have an effective sample size of {ess:.1f}, from {units:.1f} "
            f"independent units; at least {MIN_POINTS:g} and {MIN_UNITS:g} are needed. Estimate again with the new "
            f"base, or start from a run with more failing points (it has {estimate.failures.total:,})."
        )
    old_units = effective_number(np.bincount(owners, weights=old).astype(np.float64))
    own = 1 / old_units - 1 / sample.n_units
    inflation = cov_inflation(estimate, math.sqrt(max(own, 0.0)))
    cov *= inflation
    ratio = total / float(old.sum()) * math.exp(min(max(largest, -MAX_LOG), MAX_LOG))
    p = min(1.0, estimate.p * ratio)
    low, high = interval_of_sum(p, cov, units, independent, estimate.confidence)
    high = add_unseen(p, high, sample.lineages * min(1.0, units / old_units), estimate.confidence)
    at = np.array([estimate.gamma])
    high = float(add_unresolved(estimate, at, np.array([p]), np.array([high]), new_base)[0])
    known = np.where(np.isneginf(f), 0.0, terms)
    if estimate.on_error == "bound" and known.sum() < total:
        share, (own_units, own_cov) = float(known.sum()) / total, _spread_of_units(known, owners, sample.n_units)
        ends = interval_of_sum(p * share, inflation * own_cov, own_units, independent, estimate.confidence)
        low = min(low, ends[0]) if share > 0 else 0.0
    return Reweighted(
        p=p,
        interval=(low, high),
        confidence=estimate.confidence,
        cov=cov,
        ess=ess,
        units=units,
        gamma=estimate.gamma,
        ratio=p / estimate.p,
    )


def _spread_of_units(terms: FloatArray, owners: NDArray[np.int64], n_units: int) -> tuple[float, float]:
    """Return the effective units behind a sum of terms (k,) of these units (k,), and its c.o.v.; 0 and inf of none."""
    totals = np.bincount(owners, weights=terms, minlength=1).astype(np.float64)
    units = effective_number(totals)
    if units == 0:
        return 0.0, math.inf
    return units, math.sqrt(max(1 / units - 1 / n_units + float(totals.max() / totals.sum()) ** 2, 0.0))


def require_base(estimate: EstimateData) -> Distribution:
    """Return the base distribution of an estimate, or raise a ValueError that says it is not known."""
    if estimate.base is None:
        raise ValueError(
            "The estimate does not know its base distribution (`Estimate.base` is None); estimate again, or set it by "
            "dataclasses.replace(estimate, base=...)."
        )
    return estimate.base


def log_density(distribution: Any, x: FloatArray) -> FloatArray:
    """Return log_prob at x (k, d), shape (k,), or raise a ValueError if it is not one number per point."""
    if not hasattr(distribution, "log_prob"):
        raise ValueError(f"Expected a distribution with log_prob, got {distribution!r}.")
    own = getattr(distribution, "dim", x.shape[1])  # the user's own class
    if own != x.shape[1]:
        raise ValueError(f"Expected a distribution in {x.shape[1]} dimensions, got one in {own}.")
    values = np.asarray(distribution.log_prob(x), dtype=np.float64)
    if values.shape != (len(x),):
        raise ValueError(f"Expected log_prob to give one number per point, shape ({len(x)},), got {values.shape}.")
    return values


def _log_density_ratios(estimate: EstimateData, new_base: Any, x: FloatArray) -> FloatArray:
    """Return log(p1 / p0) at the failing points x (k, d), shape (k,), after all checks of the new base."""
    base, dim = require_base(estimate), x.shape[1]
    if len(x) == 0:
        raise ValueError(f"No point failed (f <= {estimate.gamma:g}): there is nothing to reweight.")
    new = log_density(new_base, x)
    if hasattr(new_base, "sample"):  # the user's own class
        draws = np.asarray(new_base.sample(SUPPORT_DRAWS, np.random.default_rng(estimate.seed)), dtype=np.float64)
        if draws.shape != (SUPPORT_DRAWS, dim):
            raise ValueError(
                f"Expected a distribution in {dim} dimensions; {SUPPORT_DRAWS} draws of this have shape {draws.shape}."
            )
        outside = float(np.mean(np.isneginf(base.log_prob(draws))))
        if outside > 0:
            raise ValueError(
                f"The old base has no density at {100 * outside:.2g} % of draws from the new one: failures there were "
                "never drawn. Estimate again with the new base."
            )
    return _subtract_log_densities(new, log_density(base, x), x)


def _subtract_log_densities(new: FloatArray, old: FloatArray, x: FloatArray) -> FloatArray:
    """Return log p1 - log p0 at x (k, d), of p1 (k,) or (R, k) for R new bases and p0 (k,); p1 may be 0."""
    wrong = ~((new < np.inf) & np.isfinite(old))  # NaN is not below
    if wrong.any():
        place = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
        raise ValueError(
            f"Expected finite densities at the failing points; at {x[place[-1]]} log_prob is {new[place]} under the "
            f"new base and {old[place[-1]]} under the old."
        )
    return new - old


class RefitSums(NamedTuple):
    """Sums over the failing points under R refits, for m parts of p."""

    log_p: FloatArray
    """Logarithm of the probability, shape (m, R); -inf if a refit has no density at any failing point."""
    ess: FloatArray
    """Effective number of failing points behind it, shape (m, R); a path of a Markov chain counts as one."""


def find_fitted_base(base: Any) -> FittedBase | None:
    """Return the base if it has refits; None for any other. Names are looked up: `isinstance` would compute values."""
    fitted = {"refits", "clusters", "fitted_to", "family"} <= {*dir(base)}
    return base if fitted and len(base.refits) > 0 else None


_checked: WeakKeyDictionary[object, tuple[object, ...]] = WeakKeyDictionary()
"""Bases to the refits and the dimension that were found to fit them; a check takes as long as a thousand rollouts."""


def check_refits(base: Distribution, dim: int) -> None:
    """Raise a ValueError if a refit of a base has other dimensions or another support, or no density.

    A base that can be a key by its identity is checked once.
    """
    fitted = find_fitted_base(base)
    if fitted is None:
        return
    known = (dim, *map(id, fitted.refits))
    remembered = type(base).__hash__ is object.__hash__ and getattr(type(base), "__weakrefoffset__", 0) != 0
    if remembered and _checked.get(fitted) == known:
        return
    x = fitted.sample(REFIT_CHECK_DRAWS, np.random.default_rng(0))
    for number, refit in enumerate(fitted.refits, start=1):
        try:
            inside = np.isfinite(log_density(refit, x)).all()
            if hasattr(refit, "sample"):  # the user's own class
                draws = np.asarray(refit.sample(REFIT_CHECK_DRAWS, np.random.default_rng(0)))
                inside &= np.isfinite(log_density(fitted, draws)).all()
        except ValueError as error:
            raise ValueError(
                f"Refit {number} of {len(fitted.refits)} does not fit its base distribution: {error}"
            ) from error
        if not inside:
            raise ValueError(
                f"Refit {number} of {len(fitted.refits)} has another support than its base distribution: some draws "
                "from the one have no finite density under the other."
            )
    if remembered:
        _checked[fitted] = known


def refit_log_ratios(estimate: EstimateData, sample: Sample, refits: Sequence[Any]) -> FloatArray:
    """Return log(refit_b(x_i) / base(x_i)) at the failing points, shape (R, k); computed once for an estimate."""
    base, x = require_base(estimate), sample.x
    of = (sample, base, refits)
    for kept, ratios in estimate.refit_ratios:
        if all(a is b for a, b in zip(kept, of, strict=True)):
            return ratios
    old = log_density(base, x)
    new = np.array([log_density(refit, x) for refit in refits], dtype=np.float64).reshape(len(refits), len(x))
    estimate.refit_ratios[:] = [(of, _subtract_log_densities(new, old, x))]
    return estimate.refit_ratios[0][1]


def reweight_to_refits(estimate: EstimateData, refits: Sequence[Any], parts: FloatArray | None = None) -> RefitSums:
    """Return p under each of R refits, p_b = sum of w_i refit_b(x_i) / base(x_i) over the failing points.

    As `Estimate.reweight`, without its refusal: refits on few points are counted by the caller, since leaving them out
    would narrow the spread. `parts` (m, k) says what share of each failing point belongs to parts of p; None for p
    itself. A ValueError says that there are no weighted points, none failed, or a density is not finite.
    """
    sample = require_sample(estimate)
    if len(sample.x) == 0 or estimate.p <= 0:
        raise ValueError("nothing failed, so that p under the refits is not known.")
    return _sum_parts(estimate, sample, refit_log_ratios(estimate, sample, refits), parts)


def _sum_parts(estimate: EstimateData, sample: Sample, log_ratios: FloatArray, parts: FloatArray | None) -> RefitSums:
    """Return the sums over the failing points from the density ratios there, shape (R, k)."""
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


def _sum_logarithms(log_terms: FloatArray, units: NDArray[np.intp]) -> tuple[float, float]:
    """Return the logarithm of the sum of terms (k,) given as logarithms, and the effective number of units in it."""
    highest = float(log_terms.max())
    if not np.isfinite(highest):
        return -np.inf, 0.0
    totals = np.bincount(units, weights=np.exp(log_terms - highest)).astype(np.float64)
    return highest + float(np.log(totals.sum())), effective_number(totals)


def reweight_runs_to_refits(
    estimate: EstimateData, refits: Sequence[Any], split: Callable[[EstimateData], FloatArray] | None = None
) -> RefitSums:
    """Return p under each refit from the run or its further run, whichever has more effective points under that refit.

    The mixture of the refits has its failing points where the refits with the largest p have theirs: the others may
    rest on fewer points than in the first run. `split` gives the parts of p in a run, as in `reweight_to_refits`.
    """
    runs = [each for each in (estimate, estimate.ensemble_run) if each is not None and each.p > 0 and each.sample]
    found = [reweight_to_refits(run, refits, None if split is None else split(run)) for run in runs or [estimate]]
    return choose_better_run(found, [sums.ess.min(axis=0, keepdims=True) for sums in found])


def choose_better_run(found: Sequence[RefitSums], points: Sequence[FloatArray] | None = None) -> RefitSums:
    """Return for each refit the sums of that run which has most effective points.

    These are those of each of m parts, or `points`, shape (m, R) or (1, R) for each run.
    """
    ess = np.stack([sums.ess for sums in found])
    best = np.broadcast_to(np.argmax(ess if points is None else np.stack(points), axis=0), ess.shape[1:])[None]
    log_p = np.take_along_axis(np.stack([sums.log_p for sums in found]), best, axis=0)[0]
    return RefitSums(log_p, np.take_along_axis(ess, best, axis=0)[0])


def count_uncovered(ess: FloatArray) -> int:
    """Return how many of R refits rest on under 10 effective failing points, ess (R,); 0 if no more than a tenth.

    From 10 on log p has an error of about 0.3: little beside the usual spread of the refits, 0.7 to 1.5.
    """
    few = int(np.count_nonzero(ess < 10))
    return few if few > 0.1 * len(ess) else 0


def needs_ensemble_run(estimate: EstimateData, split: Callable[[FloatArray], FloatArray] | None = None) -> bool:
    """Return whether a further run under the mixture of the refits would tell p, or a part of it, under them.

    It would where more than a tenth of the refits rest on under 10 effective failing points, or one of them on none.
    False if the base has no refits or no `ensemble`, or if the run, or a part of it, has few effective failing
    points under its own base: another of that size would have as few.
    """
    fitted, sample = find_fitted_base(estimate.base), estimate.sample
    if fitted is None or not hasattr(fitted, "ensemble") or sample is None or len(sample.x) == 0 or estimate.p <= 0:
        return False
    try:
        parts = None if split is None else split(sample.x)
        if _sum_parts(estimate, sample, np.zeros((1, len(sample.x))), parts).ess.min() < 30:
            return False
        sums = _sum_parts(estimate, sample, refit_log_ratios(estimate, sample, fitted.refits), parts)
    except ValueError:  # no points to reweight: the mixture of the refits would not mend that
        return False
    return count_uncovered(sums.ess.min(axis=0)) > 0 or not np.isfinite(sums.log_p).all()


class RefitFamily(NamedTuple):
    """Refits of one family: log p is about normal around the centre."""

    centre: float
    """Of log p: that of the base distribution itself in its own family, the mean of the refits in another."""
    variance: float
    """Of log p over its refits; pooled over all families if it has few."""
    freedom: int
    """Degrees of freedom of `variance`: its refits less 1; of the pooled one all refits less the number of families."""
    share: float
    """Of the refits that are of this family; 0 for that of the base if no refit chose it."""


def read_refit_families(fitted: object, n_refits: int) -> NDArray[np.int64]:
    """Return the family of each refit, shape (n_refits,); all 0 if the base knows none, or each has one member.

    Nothing tells a spread within a family from one between them where each has one member.
    """
    known = getattr(fitted, "refit_families", [0] * n_refits)  # a user's base
    family_of = np.array(known, dtype=np.int64)
    if family_of.shape != (n_refits,):
        raise ValueError(f"Expected one family for each of {n_refits} refits, got {family_of.shape}.")
    return np.zeros_like(family_of) if len(np.unique(family_of)) == n_refits else family_of


def split_families(log_p: float, log_values: FloatArray, family_of: NDArray[np.int64]) -> tuple[RefitFamily, ...]:
    """Return the families (R,) of R > 1 refits with log_values (R,), that of the base itself, with log_p, first."""
    deviations, free = deviate_within_families(log_values[None], family_of)
    pooled = float((deviations**2).sum() / free)
    families = []
    for name in sorted({0, *family_of.tolist()}):
        own = log_values[family_of == name]
        centre = log_p if name == 0 else float(own.mean())
        variance, freedom = (float(own.var(ddof=1)), len(own) - 1) if len(own) >= 10 else (pooled, free)
        families.append(RefitFamily(centre, variance, freedom, len(own) / len(log_values)))
    return tuple(families)


def deviate_within_families(log_values: FloatArray, family_of: NDArray[np.int64]) -> tuple[FloatArray, int]:
    """Return deviations of values (k, R) from the mean of their family, shape (k, R), and their degrees of freedom."""
    names, index = np.unique(family_of, return_inverse=True)
    means = np.stack([log_values[:, index == i].mean(axis=1) for i in range(len(names))], axis=1)
    return log_values - means[:, index], len(family_of) - len(names)


def find_log_ends(
    families: Sequence[RefitFamily], other_variance: float, confidence: float, clusters: int, lineages: float = math.inf
) -> tuple[float, float]:
    """Return the lowest and the highest end of log p over the families.

    Each has the interval centre -+ t S; S^2 is its variance plus `other_variance`, t the quantile for its degrees of
    freedom. The upper limit holds the share of p in regions of failure that a search may have missed, which is missing
    under all refits alike. Families that hardly any refits choose are left out, but not that of the base.
    """
    ends = []
    for number, family in enumerate(families):
        if number == 0 or family.share >= 0.05:
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
