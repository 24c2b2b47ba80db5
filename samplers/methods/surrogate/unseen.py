"""The share of p that was not found: what it adds to the upper end of an interval.

Let n failures have been met independently of one another, all of them in regions that are known. The share M of p in
other regions has then the distribution Beta(1/4, n): each is a trial that a region of share M is missed with
probability 1 - M; the first parameter is small because most problems have no other region. With p exp(s Z) the
probability of the regions known, Z ~ N(0, 1), the upper end is the quantile of p exp(s Z) / (1 - M).
"""

import numpy as np
from scipy import stats
from scipy.special import ndtr

from samplers.problem import FloatArray
from samplers.statistics.weights import effective_sample_size

SHARE_PRIOR = 0.25
HITS_PER_DISCOVERY = 4
"""Wide failures that count as one independent discovery at least: they reach some regions more often than others."""
SHARE_QUANTILES = 400
"""Points that stand for the distribution of M."""


def count_discoveries(batches: int, wide_log_weights: FloatArray) -> float:
    """Return how many failures were met independently.

    Args:
        batches: Batches of learning in which some point failed; each is drawn anew where the surrogate is in doubt.
        wide_log_weights: log(phi / q) of the wide draws that failed, shape (k,).
    """
    return batches + max(effective_sample_size(wide_log_weights), len(wide_log_weights) / HITS_PER_DISCOVERY)


def upper_end_with_unseen(p: float, high: float, discoveries: float, confidence: float) -> float:
    """Return the upper end of p, `high` for the regions known, with the share that may be unseen.

    Example:
        >>> round(upper_end_with_unseen(1e-4, 1.1e-4, discoveries=25, confidence=0.95) * 1e4, 3)
        1.115
    """
    if not 0 < p < high:
        return high
    tail = 0.5 + confidence / 2
    sigma = np.log(high / p) / stats.norm.ppf(tail)
    shares = stats.beta.ppf((np.arange(SHARE_QUANTILES) + 0.5) / SHARE_QUANTILES, SHARE_PRIOR, max(discoveries, 0.5))
    shift = np.log1p(-np.minimum(shares, 1 - 1e-12))  # of log p, were it all of it
    below, above = 0.0, float(np.log(high / p) - shift.min())
    for _ in range(60):
        middle = 0.5 * (below + above)
        short = ndtr((middle + shift) / sigma).mean() < tail
        below, above = (middle, above) if short else (below, middle)
    return float(min(1.0, p * np.exp(above)))
