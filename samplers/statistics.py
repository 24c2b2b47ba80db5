"""Statistics: importance weights, intervals, the next threshold of a search, the share of p that was not found.

References:
    Clopper and Pearson, "The use of confidence or fiducial limits", Biometrika 26, 1934.
    Au and Beck, "Estimation of small failure probabilities in high dimensions by subset
    simulation", Probabilistic Engineering Mechanics 16, 2001 (equations 25 to 29).
    Hall, "On the removal of skewness by transformation", Journal of the Royal Statistical Society B 54, 1992.
    Korn and Graubard, "Confidence intervals for proportions with small expected number of positive
    counts estimated from survey data", Survey Methodology 24, 1998 (degrees of freedom from units).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, ndtr, ndtri, stdtrit

from samplers.problem import FloatArray


def log_sum_exp(a: FloatArray, axis: int | None = None, weights: FloatArray | None = None) -> Any:
    """Return log(sum of weights * exp(a)) along an axis, which is dropped, or of all numbers; -inf for no numbers.

    Weights are not negative, and all 1 where there are none. The bits are those of `scipy.special.logsumexp`, in a
    third of its time for the arrays of an estimate, most of which have some thousand numbers: the largest number is
    left out of the sum and its share is added by log1p.
    """
    if weights is not None:
        a = np.where(weights == 0, -np.inf, a)
    if a.size == 0:
        return np.full(np.delete(a.shape, axis) if axis is not None else (), -np.inf)[()]
    largest = a.max(axis=axis, keepdims=True)
    first = a == largest
    with np.errstate(invalid="ignore", divide="ignore"):  # all numbers may be -inf
        others = np.exp(a - largest)
        others[first] = 0.0
        m = (first if weights is None else weights * first).sum(axis=axis, keepdims=True, dtype=np.float64)
        s = (others if weights is None else weights * others).sum(axis=axis, keepdims=True)
        out = np.log1p(np.where(s == 0, s, s / m)) + np.log(m) + largest
    return np.where(np.isfinite(largest), out, largest).squeeze(axis)[()]


def normalise_weights(log_weights: FloatArray) -> FloatArray:
    """Return weights proportional to exp(log_weights) (n,) that add up to 1."""
    return np.asarray(np.exp(log_weights - log_sum_exp(log_weights)))


def effective_sample_size(log_weights: FloatArray) -> float:
    """Return Kish's (sum w)^2 / sum w^2 of weights given as logarithms (n,); 0 for none."""
    if log_weights.size == 0:
        return 0.0
    return float(np.exp(2 * log_sum_exp(log_weights) - log_sum_exp(2 * log_weights)))


def largest_weight_share(log_weights: FloatArray) -> float:
    """Return the largest weight as a share of their sum; 0 for none."""
    return float(normalise_weights(log_weights).max()) if log_weights.size else 0.0


def effective_number(terms: FloatArray) -> float:
    """Return the effective number of terms (n,), (sum t)^2 / sum t^2; 0 where all are 0."""
    total, squares = float(terms.sum()), float((terms**2).sum())
    return total**2 / squares if squares > 0 else 0.0


Interval = tuple[float, float]
MAX_SKEWNESS = 0.4
"""Skewness of a mean up to which its first two terms describe it; Hall's end has a pole at about 0.47."""
MIN_SKEWNESS = 1e-3
"""Less is none."""
LARGE_ESS = 200
"""From this effective number of units on normal quantiles are used, below it t quantiles (1 to 3 % larger here)."""


def clopper_pearson(hits: int, n: int, confidence: float) -> Interval:
    """Return the exact binomial interval of a share; one-sided where hits is 0 or n."""
    tail = (1 - confidence) / 2
    low = 0.0 if hits == 0 else float(betaincinv(hits, n - hits + 1, tail))
    high = 1.0 if hits == n else float(betaincinv(hits + 1, n - hits, 1 - tail))
    return low, high


def zero_hit_bound(n: int, confidence: float) -> float:
    """Return the upper bound of a probability of which n independent draws showed nothing; 1 where n = 0.

    The one-sided interval of Clopper and Pearson, with all of 1 - confidence at the upper end.
    """
    return -math.expm1(math.log1p(-confidence) / n) if n else 1.0


def log_normal_interval(p: float, cov: float, confidence: float, df: float = math.inf) -> Interval:
    """Return p exp(-+ q s), s^2 = log(1 + cov^2), q the normal (or, with finite df, t) quantile.

    For estimators whose logarithm is nearly normal; p must be positive. Cut at 1.
    """
    quantile = float(stdtrit(df, 0.5 + confidence / 2))
    half = quantile * math.sqrt(math.log1p(cov * cov))
    return p * math.exp(-half), min(1.0, p * math.exp(half))


def skewed_upper_end(p: float, cov: float, skewness: float, confidence: float) -> float:
    """Return the upper end of a mean p whose distribution is skew, by Hall's transformation; at most 1.

    With g the skewness of the mean (that of a term over sqrt(n), here cut to [0, MAX_SKEWNESS]) and z the normal
    quantile, the end is p (1 + 3 cov / g (1 - (1 - g (z + g / 6))^(1/3))).
    """
    z, g = float(ndtri(0.5 + confidence / 2)), min(skewness, MAX_SKEWNESS)
    if g < MIN_SKEWNESS:
        return min(1.0, p * (1 + z * cov))
    return min(1.0, p * (1 + 3 * cov / g * (1 - float(np.cbrt(1 - g * (z + g / 6))))))


def degrees_of_freedom(ess: float, independent: bool) -> float:
    """Return the degrees of freedom of a sum over `ess` effective units; inf where they are many.

    Sums of chains have ess - 1, as in subset simulation; single draws, whose weights are skewed, a quarter of ess
    but at least 3, as in importance sampling.
    """
    if ess > LARGE_ESS:
        return math.inf
    return max(ess / 4, 3.0) if independent else max(ess - 1, 1.0)


def binomial_cov(p: float, n: float) -> float:
    """Return the c.o.v. of a share p of n independent points; inf where p = 0."""
    return math.sqrt((1 - p) / (p * n)) if p > 0 else math.inf


def gain_over_monte_carlo(p: float, cov: float, n_sim: int) -> float:
    """Return Monte Carlo runs for the same c.o.v. divided by n_sim.

    NaN where p is 0 or 1, and from a c.o.v. of 1 on: p itself is then not known.
    """
    if not 0 < p < 1 or not 0 < cov < 1 or n_sim == 0:
        return math.nan
    return (1 - p) / (p * cov * cov * n_sim)


def correlation_factor(inside: NDArray[np.bool_], lengths: NDArray[np.int64]) -> float:
    """Return Au and Beck's gamma of an indicator (chains, steps), row i chain i in time order.

    Correlation in the chains raises a variance by 1 + gamma,
    gamma = 2 sum_k (M_k / N) rho(k), with M_k the number of pairs at lag k inside the chains, whose `lengths` (chains,)
    count, N the number of points and rho(k) the correlation of the indicator at lag k. With chains of equal length L
    this is the paper's 2 sum_k (1 - k / L) rho(k). Negative sums, which are sampling noise, count as 0.
    """
    used = np.arange(inside.shape[1]) < lengths[:, None]
    total = int(used.sum())
    share = float(inside[used].sum()) / total
    variance = share * (1 - share)
    if variance == 0:
        return 0.0
    gamma = 0.0
    for lag in range(1, inside.shape[1]):
        pairs = used[:, lag:]  # a used point has all its predecessors
        both = (inside[:, :-lag] & inside[:, lag:])[pairs]
        gamma += 2 * (float(both.sum()) - both.size * share * share) / (total * variance)
    return max(gamma, 0.0)


MAX_TIED_SHARE = 0.5
"""A tied level that keeps more than this share of the points is no progress."""


def next_level(f: FloatArray, fraction: float, gamma: float) -> float | None:
    """Return the next threshold for outcomes f (n,), or None if there is none to go to.

    gamma as soon as the fraction is reached by f <= gamma: the answer is then known. Otherwise the `fraction` quantile
    q, an outcome that occurred, so that the share of f <= q is its true share. Where many outcomes tie at q (time to
    collision capped for most scenarios), the share of f <= q may be far above `fraction`. Then the largest distinct
    outcome below q is taken if its share is nearer (in ratio) or if q would keep more than half of the points.
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


PRIOR_SHARE = 0.1
"""First parameter of Beta. With 1/4, 5 of 880 intervals lay below p and 17 above (20 seeds on 44 limit states); with
1/10, 15 and 17 of 1,160 (40 seeds on 29 of these)."""
QUANTILES = 400
"""Points that stand for the distribution of M."""


def add_unseen(p: float, high: float, lineages: float, confidence: float) -> float:
    """Return the upper end of p, `high` for the regions known, with the share that is unseen after some lineages.

    Let nu independent lineages have reached failure, all of them in the regions that are known. The share M of p in
    other regions has then the distribution Beta(1/10, nu): each lineage is a trial that a region of share M is missed
    with probability 1 - M; the first parameter is small because most problems have no other region. With
    p-hat exp(s Z) the probability of the regions known, Z ~ N(0, 1), the end is the quantile of
    p-hat exp(s Z) / (1 - M).
    """
    if not 0 < p < high or np.isinf(lineages):
        return high
    return float(min(1.0, p * np.exp(raise_log_end(float(np.log(high / p)), lineages, confidence))))


def raise_log_end(half: float, lineages: float, confidence: float) -> float:
    """Return how far the upper end of log p lies above its estimate, `half` without the share that is unseen."""
    if np.isinf(lineages):
        return half
    tail = 0.5 + confidence / 2
    sigma = half / ndtri(tail)
    shares = betaincinv(PRIOR_SHARE, lineages, (np.arange(QUANTILES) + 0.5) / QUANTILES)
    shift = np.log1p(-np.minimum(shares, 1 - 1e-12))  # of log p, were it all of it
    below, above = 0.0, half - shift.min()
    for _ in range(60):
        middle = 0.5 * (below + above)
        short = ndtr((middle + shift) / sigma).mean() < tail
        below, above = (middle, above) if short else (below, middle)
    return float(above)
