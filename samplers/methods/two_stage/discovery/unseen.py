"""The share of p that was not found, and the interval that holds it.

Let nu independent lineages have reached failure, all of them in the regions that are known. The share M of p in other
regions has then the distribution Beta(1/10, nu): each lineage is a trial that a region of share M is missed with
probability 1 - M; the first parameter is small because most problems have no other region. With p-hat exp(s Z) the
probability of the regions known, Z ~ N(0, 1), the upper end is the quantile of p-hat exp(s Z) / (1 - M).
"""

from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.special import ndtr

from samplers.importance.draws import Draws, weighted_interval
from samplers.problem import FloatArray
from samplers.statistics.intervals import Interval, skewed_upper_end
from samplers.statistics.weights import effective_sample_size

PRIOR_SHARE = 0.1
"""First parameter of Beta. With 1/4, 5 of 880 intervals lay below p and 17 above (20 seeds on 44 limit states); with
1/10, 15 and 17 of 1,160 (40 seeds on 29 of these)."""
HITS_PER_LINEAGE = 4
"""Wide failures that count as one lineage at least: draws of N(0, s^2 I) are independent, but reach some regions more
often than others."""
QUANTILES = 400
"""Points that stand for the distribution of M."""


class Discovery(NamedTuple):
    """How thorough the search for regions was."""

    lineages: float
    """Independent lineages that reached failure."""
    ceiling: float = 1.0
    """Upper end of p by the search's own subset simulation, or by as many of its levels as there were."""

    def unseen_share(self, confidence: float) -> float:
        """Return the upper end of the share of p in regions that were not found.

        Example:
            >>> [round(Discovery(n).unseen_share(0.95), 3) for n in (4, 25, 200)]
            [0.24, 0.039, 0.005]
        """
        return float(stats.beta.ppf(0.5 + confidence / 2, PRIOR_SHARE, self.lineages))


def count_lineages(roots: int, wide_log_weights: FloatArray) -> float:
    """Return the number of independent lineages.

    Args:
        roots: Distinct base draws whose line of descent, or path of subset simulation, came to a failure.
        wide_log_weights: log(phi / q) of the wide draws that failed, shape (k,).
    """
    return roots + max(effective_sample_size(wide_log_weights), len(wide_log_weights) / HITS_PER_LINEAGE)


def discovery_interval(
    draws: Draws, cov: float, confidence: float, largest_weight: float, discovery: Discovery
) -> Interval:
    """Return the interval of p from weighted draws, its upper end raised by their skewness and by what is unseen.

    Args:
        draws: From the last proposal.
        cov: C.o.v. of p.
        confidence: Nominal coverage.
        largest_weight: Bound of the weights.
        discovery: How thorough the search was.
    """
    low, high = weighted_interval(draws, confidence, largest_weight, cov, discovery.ceiling)
    if len(draws.f) == 0:
        return low, high
    high = max(high, skewed_upper_end(draws.p, cov, draws.skewness / draws.n**0.5, confidence))
    return low, add_unseen(draws.p, high, discovery.lineages, confidence)


def add_unseen(p: float, high: float, lineages: float, confidence: float) -> float:
    """Return the upper end of p, `high` for the regions known, with the share that is unseen after some lineages.

    Example:
        >>> round(add_unseen(1e-4, 1.1e-4, lineages=25, confidence=0.95) * 1e4, 3)
        1.11
    """
    if not 0 < p < high:
        return high
    tail = 0.5 + confidence / 2
    sigma = np.log(high / p) / stats.norm.ppf(tail)
    shares = stats.beta.ppf((np.arange(QUANTILES) + 0.5) / QUANTILES, PRIOR_SHARE, lineages)
    shift = np.log1p(-np.minimum(shares, 1 - 1e-12))  # of log p, were it all of it
    below, above = 0.0, np.log(high / p) - shift.min()
    for _ in range(60):
        middle = 0.5 * (below + above)
        short = ndtr((middle + shift) / sigma).mean() < tail
        below, above = (middle, above) if short else (below, middle)
    return float(min(1.0, p * np.exp(above)))
