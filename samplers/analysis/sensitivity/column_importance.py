"""Importance of each column of x for failure: how far the failing points are from ordinary ones in its direction.

The measure is the relative entropy of u_j given failure against its base distribution N(0, 1), in standard normal
space, as a share of -log p:

    I_j = D_j / (-log p),    D_j = KL(u_j | failure || N(0, 1)).

The joint relative entropy of u given failure is exactly -log p, and the base of u is a product, so that the I_j add up
to at most 1; the rest is what the columns do together. For a half-space {alpha . u >= beta} I_j tends to alpha_j^2, the
importance factor of first-order reliability analysis, as beta grows. First-order Sobol indices of the indicator of
failure, in contrast, are small wherever failure needs several columns at once.

D_j is computed from mean m and variance s^2 of u_j given failure as (m^2 + s^2 - 1 - log s^2) / 2: exact where u_j
given failure is normal, and else a lower bound, since of all distributions with these moments the normal has most
entropy.

References:
    Liu, Chen and Sudjianto, "Relative entropy based method for probabilistic sensitivity analysis in engineering
    design", Journal of Mechanical Design 128, 2006.
    Li, Papaioannou and Straub, "Global reliability sensitivity estimation based on failure samples", Structural
    Safety 81, 2019 (sensitivities from failing samples).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from samplers.analysis.failure_weights import WeightedFailures, mean_over_failures
from samplers.problem import Distribution, FloatArray
from samplers.serialization import to_json_value
from samplers.statistics.weights import effective_number

ROUNDING_VARIANCE = 1e-12
"""Of u_j given failure: below it points are equal but for rounding."""


@dataclass(frozen=True, kw_only=True)
class ColumnImportance:
    """Importance of one parameter of x, of one column or of a block of several."""

    name: str
    """Name of the parameter."""
    importance: float
    """D over -log p: the share of how rare failure is that the parameter has by itself, 0 to 1; the estimate from few
    points, which may be beyond, is cut to that range."""
    error: float
    """Standard error of `importance`."""
    direction: float
    """Mean of u_j given failure, in standard deviations of ordinary values: negative where failures have small values;
    the distance from 0 for a block of several columns."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {name: to_json_value(value) for name, value in asdict(self).items()}


def rank_columns(
    failures: WeightedFailures, base: Distribution, names: Sequence[str], sizes: Sequence[int]
) -> tuple[ColumnImportance, ...]:
    """Return the importance of each parameter of x, the most important first.

    Args:
        failures: Weighted failing points.
        base: Distribution of X; its map to standard normal space says what u_j belongs to column j, given the columns
            that come earlier in its order.
        names: Names of the parameters.
        sizes: Columns of each.

    Raises:
        ValueError: If a single point failed, which has no spread.
    """
    if np.count_nonzero(failures.weights) < 2:
        raise ValueError("A single point failed: what p is sensitive to needs more of them; give more simulations.")
    u = np.asarray(base.to_standard_normal(failures.x), dtype=np.float64)
    entropy, influence, mean = relative_entropies(failures, u)
    total = -math.log(float(failures.weights.sum()))
    starts = np.cumsum([0, *sizes])
    found = []
    for name, first, last in zip(names, starts[:-1], starts[1:], strict=True):
        part = slice(int(first), int(last))
        error = float(mean_over_failures(failures, influence[:, part].sum(axis=1, keepdims=True))[1][0])
        direction = float(mean[first]) if last - first == 1 else float(np.linalg.norm(mean[part]))
        value = min(max(float(entropy[part].sum()) / total, 0.0), 1.0) if total > 0 else 0.0
        found.append(
            ColumnImportance(
                name=name, importance=value, error=error / total if total > 0 else math.nan, direction=direction
            )
        )
    return tuple(sorted(found, key=lambda each: -each.importance))


def relative_entropies(failures: WeightedFailures, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return D_j of each column, its influence function at the points, and the mean of u_j given failure.

    The estimate of D_j from n effective points is too large by 1 / n on average, which is taken off: the mean of u_j^2
    has no bias, and that of -log(s^2) / 2 is 1 / n for normal u_j, whatever s^2.

    Args:
        failures: Weighted failing points, k of them.
        u: The points in standard normal space, shape (k, d).

    Returns:
        D (d,), influence (k, d) and means (d,).
    """
    share = failures.weights / failures.weights.sum()
    mean = share @ u
    square = share @ u**2
    variance = np.maximum(square - mean**2, ROUNDING_VARIANCE)
    bias = 1 / count_effective_failures(failures)
    entropy = (square - 1 - np.log(variance)) / 2 - bias
    influence = (1 - 1 / variance) / 2 * (u**2 - square) + mean / variance * (u - mean)
    return entropy, influence, mean


def count_effective_failures(failures: WeightedFailures) -> float:
    """Return the effective number of independent units among the failing points."""
    return effective_number(failures.unit_totals(failures.weights))
