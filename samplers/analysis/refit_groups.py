"""Groups of refits: where refits choose the family of distributions anew, p spreads within each group and between them.

Refits of one family spread around a value of their own. One standard deviation over all would take the distance between
two families for a spread to both sides: where some refits lie far below p, the upper end would rise as well. Here each
family has an interval around its own centre, and the whole reaches from the lowest end to the highest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray

MIN_GROUP_SHARE = 0.05
"""Share of the refits from which a family has an interval of its own: one that fewer choose is not plausible."""
MIN_GROUP = 10
"""Refits from which a group has a spread of its own; smaller groups take the pooled one."""


@runtime_checkable
class HasRefitGroups(Protocol):
    """A fitted base distribution whose refits may be of other families."""

    @property
    def refit_groups(self) -> Sequence[int]:
        """Number of the family of each refit; 0 is that of the base distribution itself."""


def read_groups(fitted: object, n_refits: int) -> NDArray[np.int64]:
    """Return the group of each refit, shape (n_refits,); all 0 where the base knows no groups."""
    groups = np.array(fitted.refit_groups if isinstance(fitted, HasRefitGroups) else [0] * n_refits, dtype=np.int64)
    if groups.shape != (n_refits,):
        raise ValueError(f"Expected one group for each of {n_refits} refits, got {groups.shape}.")
    return groups


def find_log_ends(
    log_p: float, log_values: FloatArray, groups: NDArray[np.int64], other_variance: float, quantile: float
) -> tuple[float, float]:
    """Return the lowest and the highest end of log p over the groups.

    Group 0 has the interval log p -+ quantile S, another one that around the mean of its own refits; S^2 is the
    variance within the group plus `other_variance`.

    Args:
        log_p: Of the base itself.
        log_values: Of each refit, shape (R,), with R > 1.
        groups: Of each refit, shape (R,).
        other_variance: Variance of the logarithm from other sources.
        quantile: Of Student's t.

    Example:
        Refits of another family, 10 below, lower the lower end alone:

        >>> values = np.array([-1.0, 0.0, 1.0] * 10 + [-11.0, -10.0, -9.0] * 10)
        >>> groups = np.repeat([0, 1], 30)
        >>> low, high = find_log_ends(0.0, values, groups, other_variance=0.0, quantile=2.0)
        >>> round(low, 2), round(high, 2)
        (-11.66, 1.66)
    """
    names, counts = np.unique(groups, return_counts=True)
    plausible = [int(name) for name, n in zip(names, counts, strict=True) if n >= MIN_GROUP_SHARE * len(groups)]
    pooled = _pooled_variance(log_values, groups)
    ends = []
    for name in {0, *plausible}:
        own = log_values[groups == name]
        variance = float(own.var(ddof=1)) if len(own) >= MIN_GROUP else pooled
        centre = log_p if name == 0 else float(own.mean())
        half = quantile * math.sqrt(variance + other_variance)
        ends.append((centre - half, centre + half))
    return min(low for low, _ in ends), max(high for _, high in ends)


def _pooled_variance(log_values: FloatArray, groups: NDArray[np.int64]) -> float:
    """Return the variance within the groups; over all where each group has one member."""
    names, index = np.unique(groups, return_inverse=True)
    free = len(log_values) - len(names)
    if free == 0:
        return float(log_values.var(ddof=1))
    means = np.bincount(index, weights=log_values) / np.bincount(index)
    return float(((log_values - means[index]) ** 2).sum() / free)
