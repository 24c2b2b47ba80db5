"""Thresholds: the next intermediate level of a search, also where many outcomes are equal."""

import math

import numpy as np

from samplers.problem import FloatArray

MAX_TIED_SHARE = 0.5
"""A tied level that keeps more than this share of the points is no progress."""


def next_level(f: FloatArray, fraction: float, gamma: float) -> float | None:
    """Return the next threshold for outcomes f (n,), or None if there is none to go to.

    gamma as soon as the fraction is reached by f <= gamma: the answer is then known. Otherwise the `fraction` quantile
    q, an outcome that occurred, so that the share of f <= q is its true share. Where many outcomes tie at q (time to
    collision capped for most scenarios), the share of f <= q may be far above `fraction`. Then the largest distinct
    outcome below q is taken if its share is nearer (in ratio) or if q would keep more than half of the points.

    Args:
        f: Outcomes; +inf is allowed.
        fraction: Wanted share, p0 or rho, in (0, 1).
        gamma: Final threshold; never passed.

    Example:
        >>> f = np.arange(10.0)
        >>> next_level(f, fraction=0.2, gamma=-1.0), next_level(f, fraction=0.2, gamma=3.0)
        (1.0, 3.0)
    """
    n = len(f)
    wanted = fraction * n
    if np.count_nonzero(f <= gamma) >= wanted:
        return gamma
    quantile = float(np.partition(f, math.ceil(wanted) - 1)[math.ceil(wanted) - 1])
    up_to, below = int(np.count_nonzero(f <= quantile)), int(np.count_nonzero(f < quantile))
    usable = up_to <= MAX_TIED_SHARE * n
    if below > 0 and (not usable or up_to * below > wanted * wanted):
        return max(gamma, float(f[f < quantile].max()))
    return max(gamma, quantile) if usable else None
