"""Spread shares: which parameters of a fitted base distribution the spread of log p over its refits comes from.

To first order log p under refit b is log p + L_b, L_b = sum_i g_i delta_bi, with g_i = d log p / d theta_i and delta_bi
the displacement of parameter i. Parameter i has the share cov(g_i delta_i, L) / var(L): all add up to 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samplers.analysis.base import WeightedEstimate
from samplers.analysis.refits import find_fitted_base, reweight_to_refits
from samplers.analysis.sensitivity.parameter_scores import ParametricBase, refit_displacements
from samplers.problem import FloatArray

MIN_ALIGNED_REFITS = 10
"""Refits with the parameters of the base that shares of the spread must rest on."""
JOINT_GROUP = "weights of components"
"""Group of parameters that are about all columns."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SpreadShares:
    """Spread of log p over refits, and what each parameter of the base has of it."""

    shares: FloatArray | None = None
    """Share of each parameter, shape (m,); None where it is not known."""
    spread: float | None = None
    """Standard deviation of log p over the refits used."""
    first_order: float | None = None
    """The same of log p to first order in the parameters."""
    correlation: float | None = None
    """Correlation of the two over the refits."""
    n_refits: tuple[int, int] = (0, 0)
    """Refits used, those with the parameters of the base, and refits of the base."""
    reason: str = ""
    """Why the shares are not known; empty if they are."""


def share_spread(
    estimate: WeightedEstimate, base: ParametricBase, derivatives: FloatArray, labels: Sequence[str]
) -> SpreadShares:
    """Return the shares of the parameters in the spread of log p over the refits of the base.

    Args:
        estimate: With weighted points.
        base: Its base, with m parameters.
        derivatives: d log p per change of each parameter, shape (m,).
        labels: Names of the columns of x.
    """
    fitted = find_fitted_base(base)
    if fitted is None:
        return SpreadShares(reason="the base distribution has no refits, so that no share of a spread is known")
    displacements, used = refit_displacements(base, fitted.refits, labels)
    counts = (len(used), len(fitted.refits))
    if len(used) < MIN_ALIGNED_REFITS:
        reason = f"only {counts[0]} of {counts[1]} refits have the parameters of the base, so that no share is known"
        return SpreadShares(reason=reason, n_refits=counts)
    log_p = reweight_to_refits(estimate, fitted.refits).log_p[0, used]
    parts = derivatives * (displacements - displacements.mean(axis=0))
    linear = parts.sum(axis=1)
    variance = float(linear @ linear)
    if not (variance > 0 and np.isfinite(log_p).all()):
        reason = "p under the refits is not known, or does not differ, so that no share is known"
        return SpreadShares(reason=reason, n_refits=counts)
    return SpreadShares(
        shares=np.asarray(linear @ parts / variance),
        spread=float(log_p.std(ddof=1)),
        first_order=math.sqrt(variance / (len(used) - 1)),
        correlation=float(np.corrcoef(linear, log_p)[0, 1]),
        n_refits=counts,
    )


def sum_by_owner(shares: FloatArray, columns: Sequence[tuple[int, ...]], owners: Sequence[str]) -> dict[str, float]:
    """Return the shares of parameters (m,) summed by the parameter of x that they are about, the largest first."""
    sums: dict[str, float] = {}
    for share, about in zip(shares, columns, strict=True):
        for name in [owners[j] for j in about] or [JOINT_GROUP]:
            sums[name] = sums.get(name, 0.0) + float(share) / max(len(about), 1)
    return dict(sorted(sums.items(), key=lambda each: -each[1]))
