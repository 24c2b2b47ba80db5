"""Families of refits: where refits choose the family of distributions anew, p spreads within each and between them.

Refits of one family spread around a value of their own. One standard deviation over all would take the distance between
two families for a spread to both sides: where some refits lie far below p, the upper end would rise as well. Here each
family has an interval around its own centre, and the whole reaches from the lowest end to the highest; what is expected
for the next event is the sum of what each family expects, by its share of the refits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from samplers.problem import FloatArray
from samplers.statistics.unseen_share import raise_log_end

MIN_FAMILY_SHARE = 0.05
"""Share of the refits from which a family has an interval of its own: one that fewer choose is not plausible."""
MIN_FAMILY = 10
"""Refits from which a family has a spread of its own; smaller families take the pooled one."""


@runtime_checkable
class HasRefitFamilies(Protocol):
    """A fitted base distribution whose refits may be of other families."""

    @property
    def refit_families(self) -> Sequence[int]:
        """Number of the family of each refit; 0 is that of the base distribution itself."""


class RefitFamily(NamedTuple):
    """Refits of one family: log p is about normal around the centre.

    Example:
        >>> RefitFamily(centre=-7.0, variance=1.0, freedom=29, share=1.0).share
        1.0
    """

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
    family_of = np.array(
        fitted.refit_families if isinstance(fitted, HasRefitFamilies) else [0] * n_refits, dtype=np.int64
    )
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

    Example:
        >>> values = np.array([-1.0, 0.0, 1.0] * 10 + [-11.0, -10.0, -9.0] * 10)
        >>> own, other = split_families(0.2, values, np.repeat([0, 1], 30))
        >>> own.centre, other.centre, own.share, round(own.variance, 3)
        (0.2, -10.0, 0.5, 0.69)
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
    """Return deviations of values (k, R) from the mean of their family, shape (k, R), and their degrees of freedom.

    Example:
        >>> values, family_of = np.array([[1.0, 3.0, 7.0, 8.0, 9.0]]), np.repeat([0, 1], [2, 3])
        >>> deviations, freedom = deviate_within_families(values, family_of)
        >>> deviations.tolist(), freedom
        ([[-1.0, 1.0, -1.0, 0.0, 1.0]], 3)
    """
    names, index = np.unique(_merge_single_members(family_of), return_inverse=True)
    means = np.stack([log_values[:, index == i].mean(axis=1) for i in range(len(names))], axis=1)
    return log_values - means[:, index], len(family_of) - len(names)


def _merge_single_members(family_of: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the families, shape (R,); one for all where each has one member."""
    return np.zeros_like(family_of) if len(np.unique(family_of)) == len(family_of) else family_of


def find_log_ends(
    families: Sequence[RefitFamily],
    other_variance: float,
    confidence: float,
    clusters: int,
    lineages: float = math.inf,
) -> tuple[float, float]:
    """Return the lowest and the highest end of log p over the families.

    Each has the interval centre -+ t S; S^2 is its variance plus `other_variance`, t the quantile for its degrees of
    freedom. The upper end holds the share of p in regions of failure that a search may have missed, which is missing
    under all refits alike. Families that hardly any refits choose are left out, but not that of the base.

    Args:
        families: That of the base first.
        other_variance: Variance of the logarithm from other sources.
        confidence: Nominal coverage.
        clusters: Independent clusters of events.
        lineages: Independent searches that reached failure, see `Sample.lineages`; inf without a search.

    Example:
        Refits of another family, 10 below, lower the lower end alone; t is 2.045 for 29 degrees of freedom:

        >>> families = RefitFamily(0.0, 1.0, 29, 0.5), RefitFamily(-10.0, 4.0, 29, 0.5)
        >>> low, high = find_log_ends(families, other_variance=0.0, confidence=0.95, clusters=100)
        >>> round(low, 2), round(high, 3)
        (-14.09, 2.045)
    """
    ends = []
    for number, family in enumerate(families):
        if number == 0 or family.share >= MIN_FAMILY_SHARE:
            quantile = refit_quantile(confidence, family.freedom, clusters)
            half = quantile * math.sqrt(family.variance + other_variance)
            ends.append((family.centre - half, family.centre + raise_log_end(half, lineages, confidence)))
    return min(low for low, _ in ends), max(high for _, high in ends)


def refit_quantile(confidence: float, freedom: int, clusters: int) -> float:
    """Return t, the quantile of Student's t for a variance over refits.

    Args:
        confidence: Probability between the quantile and its negative.
        freedom: Degrees of freedom of the variance, refits less 1.
        clusters: Independent clusters of events, which leave no more than these less 1.
    """
    return float(stdtrit(min(freedom, clusters - 1), 0.5 + confidence / 2))


def expect_over_families(families: Sequence[RefitFamily], largest: float = 1.0) -> float:
    """Return the expectation of p over families and their refits: the probability that the next event fails.

    The sum of share exp(centre + variance / 2), the mean of a log-normal variable, over all families; none counts for
    more than the largest value possible.

    Args:
        families: Of the refits; their shares add up to 1.
        largest: Largest value possible, 1 for a probability.

    Example:
        Half of the refits expect exp(-4.6 + 0.8 / 2) = 0.015 and half exp(-11.5 + 0.8 / 2), which is next to nothing:

        >>> families = RefitFamily(-4.6, 0.8, 29, 0.5), RefitFamily(-11.5, 0.8, 29, 0.5)
        >>> round(expect_over_families(families), 4)
        0.0075
    """
    log_largest = math.log(largest)
    return sum(each.share * math.exp(min(each.centre + each.variance / 2, log_largest)) for each in families)
