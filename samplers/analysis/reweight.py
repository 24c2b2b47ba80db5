"""Reweighting: the probability of failure under another base distribution, from the same simulations."""

import math
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from samplers.analysis.weighted import MIN_UNITS, cov_inflation, has_independent_points, interval_of_sum, require_sample
from samplers.distributions import as_distribution, can_convert
from samplers.method import EstimateData
from samplers.output import to_json_value
from samplers.problem import Distribution, FloatArray
from samplers.statistics import Interval, add_unseen, effective_number

MIN_POINTS = 30.0
"""Effective number of failing points that the estimate must rest on."""
MAX_LOG = 600.0
"""exp of this, or of its negative, is still a float."""
SUPPORT_DRAWS = 10_000
"""Draws from the new base that are checked for a density of 0 under the old one."""


@runtime_checkable
class HasLogProb(Protocol):
    """A distribution whose log density can be evaluated."""

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""


@runtime_checkable
class CanSample(Protocol):
    """A distribution that can be sampled."""

    def sample(self, n: int, rng: np.random.Generator, /) -> FloatArray:
        """Draw n independent points, shape (n, d)."""


@runtime_checkable
class HasSiblings(Protocol):
    """A base distribution that knows others of the same X by name."""

    def sibling(self, name: str) -> HasLogProb:
        """Return the base distribution with this name.

        Raises:
            ValueError: If there is none.
        """


@dataclass(frozen=True, kw_only=True)
class Reweighted:
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
        low, high = self.interval
        return (
            f"P[f <= {self.gamma:g}] = {self.p:.3e} under the new base, {self.ratio:.3g} times that under the old\n"
            f"  {100 * self.confidence:g} % interval [{low:.3e}, {high:.3e}], c.o.v. {self.cov:.3g}; "
            f"effective sample size {self.ess:.0f} failing points, {self.units:.0f} independent units"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {name: to_json_value(value) for name, value in asdict(self).items()}


def reweight_estimate(estimate: EstimateData, new_base: Any) -> Reweighted:
    """Return p under another base; see `Estimate.reweight`.

    p1 = sum of w r over the failing points, r = p1(x) / p0(x). With T_c the sums over units, its
    variance is sum T_c^2 - p1^2 / n, to which the largest T_c^2 is added: where one term dominates, the
    sample variance is too small most of the time. The interval is log-normal with the t
    quantile of the effective units. Where p rests on a search, the upper end holds the share that it may have missed,
    as that of the estimate does; its lineages count for less as the effective units become fewer.

    Raises:
        ValueError: As described in `Estimate.reweight`.
    """
    sample = require_sample(estimate)
    if can_convert(new_base) or isinstance(new_base, list | tuple):
        new_base = as_distribution(new_base, sample.x.shape[1])
    failing = sample.f <= estimate.gamma
    f, old, owners = sample.f[failing], sample.weights[failing], sample.units[failing]
    log_ratios = log_density_ratios(estimate, new_base, sample.x)
    highest = float(log_ratios.max())
    largest = highest if math.isfinite(highest) else 0.0  # taken out, so that nothing overflows
    terms = old * np.exp(log_ratios - largest)
    totals = np.bincount(owners, weights=terms, minlength=1).astype(np.float64)
    ess, units = effective_number(terms), effective_number(totals)
    check_enough(estimate, ess, units)
    total = float(terms.sum())
    square = 1 / units - 1 / sample.n_units + (float(totals.max()) / total) ** 2
    old_units = effective_number(np.bincount(owners, weights=old).astype(np.float64))
    own = 1 / old_units - 1 / sample.n_units
    cov = math.sqrt(max(square, 0.0)) * cov_inflation(estimate, math.sqrt(max(own, 0.0)))
    ratio = total / float(old.sum()) * math.exp(min(max(largest, -MAX_LOG), MAX_LOG))
    p = min(1.0, estimate.p * ratio)
    low, high = interval_of_sum(p, cov, units, has_independent_points(sample), estimate.confidence)
    high = add_unseen(p, high, sample.lineages * min(1.0, units / old_units), estimate.confidence)
    if estimate.on_error == "bound":
        low *= 1 - float(terms[np.isneginf(f)].sum()) / total
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


def log_density_ratios(estimate: EstimateData, new_base: HasLogProb, x: FloatArray) -> FloatArray:
    """Return log(p1 / p0) at the failing points x (k, d), shape (k,).

    Raises:
        ValueError: If the estimate has no base or no failing point, the new base does not fit, or a density is not
            finite.
    """
    base = require_base(estimate)
    if len(x) == 0:
        raise ValueError(f"No point failed (f <= {estimate.gamma:g}): there is nothing to reweight.")
    check_dimensions_fit(new_base, x.shape[1])
    check_support(base, new_base, x.shape[1], estimate.seed)
    return subtract_log_densities(log_density(new_base, x), log_density(base, x), x)


def require_base(estimate: EstimateData) -> Distribution:
    """Return the base distribution of an estimate, or raise a ValueError that says it is not known."""
    if estimate.base is None:
        raise ValueError(
            "The estimate does not know its base distribution (`Estimate.base` is None); estimate again, or set it by "
            "dataclasses.replace(estimate, base=...)."
        )
    return estimate.base


def subtract_log_densities(new: FloatArray, old: FloatArray, x: FloatArray) -> FloatArray:
    """Return log p1(x) - log p0(x), shape (k,), or (R, k) for R new bases.

    Args:
        new: log p1 at x, shape (k,) or (R, k).
        old: log p0 at x, shape (k,).
        x: Points, shape (k, d).

    Raises:
        ValueError: If a density is not finite (p1 may be 0).
    """
    wrong = ~((new < np.inf) & np.isfinite(old))  # NaN is not below
    if wrong.any():
        place = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
        raise ValueError(
            f"Expected finite densities at the failing points; at {x[place[-1]]} log_prob is {new[place]} under the "
            f"new base and {old[place[-1]]} under the old."
        )
    return new - old


def check_dimensions_fit(new_base: object, dim: int) -> None:
    """Raise a ValueError unless the new base has a log_prob and, if it has an attribute dim, `dim` dimensions."""
    if not isinstance(new_base, HasLogProb):
        raise ValueError(f"Expected a distribution with log_prob, got {new_base!r}.")
    own = getattr(new_base, "dim", dim)  # the user's own class
    if own != dim:
        raise ValueError(f"Expected a distribution in {dim} dimensions, got one in {own}.")


def check_support(base: Distribution, new_base: HasLogProb, dim: int, seed: int) -> None:
    """Raise a ValueError if the new base has `sample` and draws from it fall outside the old one."""
    if not isinstance(new_base, CanSample):
        return
    x = np.asarray(new_base.sample(SUPPORT_DRAWS, np.random.default_rng(seed)), dtype=np.float64)
    if x.shape != (SUPPORT_DRAWS, dim):
        raise ValueError(
            f"Expected a distribution in {dim} dimensions; {SUPPORT_DRAWS} draws of this have shape {x.shape}."
        )
    outside = float(np.mean(np.isneginf(base.log_prob(x))))
    if outside > 0:
        raise ValueError(
            f"The old base has no density at {100 * outside:.2g} % of draws from the new one: failures there were "
            "never drawn. Estimate again with the new base."
        )


def log_density(distribution: HasLogProb, x: FloatArray) -> FloatArray:
    """Return log_prob at x (k, d), shape (k,).

    Raises:
        ValueError: If it is not one number per point.
    """
    values = np.asarray(distribution.log_prob(x), dtype=np.float64)
    if values.shape != (len(x),):
        raise ValueError(f"Expected log_prob to give one number per point, shape ({len(x)},), got {values.shape}.")
    return values


def check_enough(estimate: EstimateData, ess: float, units: float) -> None:
    """Raise a ValueError where too few points or units carry the new estimate."""
    if ess >= MIN_POINTS and units >= MIN_UNITS:
        return
    raise ValueError(
        f"Under the new base the failing points have an effective sample size of {ess:.1f}, from {units:.1f} "
        f"independent units; at least {MIN_POINTS:g} and {MIN_UNITS:g} are needed. Estimate again with the new base, "
        f"or start from a run with more failing points (it has {estimate.failures.total:,})."
    )


def find_sibling(base: object, name: str) -> HasLogProb:
    """Return another base distribution of the same X by its name.

    Raises:
        ValueError: If the base knows no others, or none of that name.
    """
    if not isinstance(base, HasSiblings):
        raise ValueError(f"This base distribution knows no others by name: give a distribution in place of {name!r}.")
    return base.sibling(name)
