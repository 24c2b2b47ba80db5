"""The share of p that was not found, and the interval that holds it.

`samplers/statistics/unseen_share.py` has the equations; here lineages are counted.
"""

from typing import NamedTuple

from scipy.special import betaincinv

from samplers.importance.draws import Draws, weighted_interval
from samplers.problem import FloatArray
from samplers.statistics.intervals import Interval, skewed_upper_end
from samplers.statistics.unseen_share import PRIOR_SHARE, add_unseen
from samplers.statistics.weights import effective_sample_size

HITS_PER_LINEAGE = 4
"""Wide failures that count as one lineage at least: draws of N(0, s^2 I) are independent, but reach some regions more
often than others."""


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
        return float(betaincinv(PRIOR_SHARE, self.lineages, 0.5 + confidence / 2))


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
