"""Draws: importance-weighted points from one proposal, with their spread, interval and doubts."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.sample import DrawWeights, Sample
from samplers.statistics.intervals import Interval, clopper_pearson, degrees_of_freedom, log_normal_interval
from samplers.statistics.weights import effective_sample_size, largest_weight_share

LOW_ESS = 30
"""Effective failing draws below which the normal approximation of the interval is not relied on."""
LARGE_SHARE = 0.15
"""Share of p in one draw that is worth a warning; with 30 equal draws it is 0.03."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Independent draws from one proposal; p rests on the failing ones.

    Example:
        >>> import numpy as np
        >>> f, log_weights = np.array([-1.0, 2.0, -0.5, 3.0]), np.log([0.01, 1.0, 0.03, 2.0])
        >>> draws = Draws.from_outcomes(f, log_weights, x=np.zeros((4, 1)), gamma=0.0)
        >>> draws.n, round(draws.p, 6), round(draws.ess, 6)  # (0.01 + 0.03) / 4, (1 + 3)^2 / (1 + 9)
        (4, 0.01, 1.6)
    """

    n: int
    """Number of draws."""
    f: FloatArray
    """Outcomes of the k failing ones, shape (k,)."""
    log_weights: FloatArray
    """log(p0 / q) at the failing ones, calibrated or not, shape (k,)."""
    x: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    """The failing ones in physical space, shape (k, d)."""
    f_safe: FloatArray = field(default_factory=lambda: np.empty(0))
    """Outcomes of the others, shape (n - k,)."""
    log_weights_safe: FloatArray = field(default_factory=lambda: np.empty(0))
    """log(p0 / q) at the others, shape (n - k,)."""
    fails: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))
    """Which draws fail, in the order in which they were simulated, shape (n,); empty where that is not known."""

    @classmethod
    def from_outcomes(cls, f: FloatArray, log_weights: FloatArray, x: FloatArray, gamma: float) -> Draws:
        """Return draws with outcomes f (n,), log(p0 / q) (n,) and points x (n, d) in physical space."""
        fails = f <= gamma
        return cls(len(f), f[fails], log_weights[fails], x[fails], f[~fails], log_weights[~fails], fails)

    def join(self, other: Draws) -> Draws:
        """Return these draws and others; `log_weights` are those of the proposal that each is from."""
        if self.n == 0:
            return other
        parts = ("f", "log_weights", "x", "f_safe", "log_weights_safe", "fails")
        # fields by name
        return Draws(self.n + other.n, *(np.concatenate([getattr(self, p), getattr(other, p)]) for p in parts))

    @property
    def sample(self) -> Sample:
        """The draws as the weighted points behind p, for every threshold."""
        return Sample(
            f=np.concatenate([self.f, self.f_safe]),
            weights=np.exp(np.concatenate([self.log_weights, self.log_weights_safe])) / self.n,
            units=np.arange(self.n, dtype=np.int64),
            n_units=self.n,
            x=self.x,
        )

    def weights_after(self, first: int, total: int | None = None) -> tuple[DrawWeights, ...]:
        """Return the weight of each draw in p, in the order of their simulation, of which this many came before.

        Args:
            first: Simulations before the first draw.
            total: Draws that p is the mean of, where others count too; None for these alone.
        """
        if len(self.fails) != self.n:
            return ()
        in_order = np.empty(self.n)
        in_order[self.fails], in_order[~self.fails] = self.log_weights, self.log_weights_safe
        return (DrawWeights(first=first, log_weights=in_order - math.log(total or self.n)),)

    @property
    def ess(self) -> float:
        """Effective number of failing draws."""
        return effective_sample_size(self.log_weights)

    @property
    def p(self) -> float:
        """Mean of weight times indicator of failure."""
        return float(np.exp(self.log_weights).sum()) / self.n

    @property
    def cov(self) -> float:
        """Coefficient of variation of `p`; inf without a failing draw.

        Standard error of the mean, with (largest term / n)^2 added to its square: where one
        weight dominates, the sample variance alone is too small most of the time.
        """
        return weighted_cov(self.n, self.log_weights)

    @property
    def skewness(self) -> float:
        """Skewness of a term, weight times indicator of failure; 0 where all are equal."""
        if len(self.f) == 0:
            return 0.0
        w = np.exp(self.log_weights - self.log_weights.max())
        mean = float(w.sum()) / self.n
        variance = float((w * w).sum()) / self.n - mean**2
        third = (float(((w - mean) ** 3).sum()) - (self.n - len(w)) * mean**3) / self.n
        return third / variance**1.5 if variance > 0 else 0.0


def weighted_cov(n: int, log_weights: FloatArray) -> float:
    """Return the c.o.v. of sum(w) / n over n draws whose nonzero terms have these log weights."""
    if log_weights.size == 0:
        return math.inf
    w = np.exp(log_weights - log_weights.max())
    mean = float(w.sum()) / n
    spread = (float((w * w).sum()) / n - mean * mean) / max(n - 1, 1)
    return math.sqrt(max(spread, 0.0) + 1.0 / (n * n)) / mean


def weighted_interval(
    draws: Draws, confidence: float, largest_weight: float, cov: float | None = None, ceiling: float = 1.0
) -> Interval:
    """Return the interval of p: log-normal, with t quantiles where few draws carry it.

    With an effective number of failing draws under LOW_ESS its upper end is at least the one
    that `bernstein_bound` guarantees, or `ceiling` where that is less.

    Without a failing draw p <= largest_weight P_q[failure] gives a one-sided interval. Where all
    weights are 1 the draws are plain Monte Carlo and the interval is Clopper-Pearson's.

    Args:
        draws: From one proposal.
        confidence: Nominal coverage.
        largest_weight: Bound of the weights.
        cov: C.o.v. of p; None for that of independent draws.
        ceiling: Upper end of p from elsewhere.

    Example:
        >>> import numpy as np
        >>> draws = Draws(n=1000, f=np.zeros(400), log_weights=np.full(400, np.log(1e-4)))
        >>> low, high = weighted_interval(draws, confidence=0.95, largest_weight=10.0)
        >>> f"{draws.p:.2e} in [{low:.2e}, {high:.2e}]"
        '4.00e-05 in [3.71e-05, 4.32e-05]'
    """
    hits = len(draws.f)
    if hits == 0 or largest_weight == 1.0:
        low, high = clopper_pearson(hits, draws.n, confidence)
        return low, min(1.0, high * largest_weight)
    spread = draws.cov if cov is None else cov
    low, high = log_normal_interval(draws.p, spread, confidence, degrees_of_freedom(draws.ess, independent=True))
    if draws.ess < LOW_ESS:
        high = max(high, min(bernstein_bound(draws, confidence, largest_weight), ceiling))
    return low, high


def bernstein_bound(draws: Draws, confidence: float, largest_weight: float) -> float:
    """Return an upper bound of p that holds whatever the weights, up to `largest_weight`, do.

    The empirical Bernstein bound of Maurer and Pontil, theorem 4, for the mean of n terms in
    [0, largest_weight], at the level (1 - confidence) / 2. It is wide (7 / 3 largest_weight / n
    and more), which is what draws that hardly reach the failures deserve.

    Example:
        >>> import numpy as np
        >>> draws = Draws(n=1000, f=np.zeros(3), log_weights=np.zeros(3))
        >>> f"{bernstein_bound(draws, confidence=0.95, largest_weight=1.0):.3f}"
        '0.018'
    """
    log_term = math.log(4 / (1 - confidence))
    weights, less = np.exp(draws.log_weights), max(draws.n - 1, 1)
    variance = max(float((weights**2).sum()) - draws.n * draws.p**2, 0.0) / less
    slack = 7 * largest_weight * log_term / (3 * less)
    return min(1.0, draws.p + math.sqrt(2 * variance * log_term / draws.n) + slack)


def weight_warnings(draws: Draws) -> list[str]:
    """Return warnings about the weights of the failing draws."""
    if len(draws.f) == 0:
        return [f"None of {draws.n:,} final draws failed: p = 0 with a one-sided interval."]
    return [*describe_low_ess(draws), *heavy_draw_warnings(draws)]


def describe_low_ess(draws: Draws) -> list[str]:
    """Return a sentence where the failing draws, one or more, are worth few independent ones."""
    if draws.ess >= LOW_ESS:
        return []
    return [f"Effective sample size of the failing draws: {draws.ess:.0f}; the estimate is coarse."]


def heavy_draw_warnings(draws: Draws) -> list[str]:
    """Return a warning where one of the failing draws, one or more, carries a large share of p."""
    share = largest_weight_share(draws.log_weights)
    if share <= LARGE_SHARE:
        return []
    return [f"One draw carries {100 * share:.0f} % of p: the proposal barely covers some failures."]
