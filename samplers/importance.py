"""Estimating p with fresh draws from a fixed proposal.

References:
    Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (defensive mixtures).
    Maurer and Pontil, "Empirical Bernstein bounds and sample-variance penalization", COLT 2009.
"""

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field

import numpy as np

from samplers.families import Gaussian, Law, Mixture
from samplers.intervals import Interval, clopper_pearson, degrees_of_freedom, log_normal
from samplers.method import Goal, Interrupted, Sample
from samplers.problem import FloatArray, Inputs
from samplers.result import Level
from samplers.weights import effective_sample_size, largest_share

LOW_ESS = 30
MOST_BATCHES = 100
"""Batches of final draws after which a target c.o.v. is given up where max_sim does not say."""
LARGE_SHARE = 0.15


@dataclass(frozen=True, eq=False)
class Space:
    """Where a proposal lives, and the base law there."""

    base: Law
    """p0."""
    to_x: Callable[[FloatArray], FloatArray]
    """Maps points of this space, shape (n, d), to physical space."""

    @classmethod
    def standard_normal(cls, inputs: Inputs) -> "Space":
        """Standard normal space of some inputs."""
        return cls(Gaussian.standard(inputs.dim), inputs.base.from_standard_normal)

    @classmethod
    def physical(cls, base: Law) -> "Space":
        """Physical space, where `base` is the law of x."""
        return cls(base, np.asarray)


@dataclass(frozen=True, eq=False)
class Draws:
    """Independent draws from one proposal; p rests on the failing ones."""

    n: int
    """Number of draws."""
    f: FloatArray
    """Outcomes of the k failing ones, shape (k,)."""
    log_weights: FloatArray
    """log(p0 / q) at the failing ones, shape (k,)."""
    x: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    """The failing ones in physical space, shape (k, d)."""
    f_safe: FloatArray = field(default_factory=lambda: np.empty(0))
    """Outcomes of the others, shape (n - k,)."""
    log_weights_safe: FloatArray = field(default_factory=lambda: np.empty(0))
    """log(p0 / q) at the others, shape (n - k,)."""

    @classmethod
    def weighted(cls, f: FloatArray, log_weights: FloatArray, x: FloatArray, gamma: float) -> "Draws":
        """Return draws with outcomes f (n,), log(p0 / q) (n,) and points x (n, d) in physical space."""
        fails = f <= gamma
        return cls(len(f), f[fails], log_weights[fails], x[fails], f[~fails], log_weights[~fails])

    def joined(self, other: "Draws") -> "Draws":
        """Return these draws and others from the same proposal."""
        if self.n == 0:
            return other
        parts = ("f", "log_weights", "x", "f_safe", "log_weights_safe")
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


def weighted_cov(n: int, log_weights: FloatArray) -> float:
    """Return the c.o.v. of sum(w) / n over n draws whose nonzero terms have these log weights."""
    if log_weights.size == 0:
        return math.inf
    w = np.exp(log_weights - log_weights.max())
    mean = float(w.sum()) / n
    spread = (float((w * w).sum()) / n - mean * mean) / max(n - 1, 1)
    return math.sqrt(max(spread, 0.0) + 1.0 / (n * n)) / mean


def draw(
    inputs: Inputs,
    sampler: Law,
    gamma: float,
    n: int,
    rng: np.random.Generator,
    space: Space | None = None,
) -> Generator[FloatArray, FloatArray, Draws]:
    """Simulate n draws from `sampler`, a law in `space` (None: standard normal space), in one batch."""
    space = space or Space.standard_normal(inputs)
    u = sampler.sample(n, rng)
    x = space.to_x(u)
    f = yield x
    return Draws.weighted(f, space.base.log_prob(u) - sampler.log_prob(u), x, gamma)


def draw_until(
    inputs: Inputs,
    sampler: Law,
    goal: Goal,
    limit: int,
    batch: int,
    rng: np.random.Generator,
    space: Space | None = None,
) -> Generator[FloatArray, FloatArray, tuple[Draws, list[Level], bool]]:
    """Simulate batches until `limit` draws are made or goal.target_cov is met.

    Returns the draws, a record of every batch and whether the run was interrupted.
    """
    draws = Draws(0, np.empty(0), np.empty(0))
    trace: list[Level] = []
    while draws.n < limit:
        try:
            new = yield from draw(inputs, sampler, goal.gamma, min(batch, limit - draws.n), rng, space)
        except Interrupted:
            return draws, trace, True
        draws = draws.joined(new)
        trace.append(
            Level(
                gamma=goal.gamma,
                p=len(new.f) / new.n,
                estimate=draws.p,
                n_sim=new.n,
                n_points=new.n,
                cov=draws.cov,
                ess=draws.ess,
            )
        )
        goal.on_level(trace[-1])
        if goal.target_cov is not None and draws.cov <= goal.target_cov:
            break
    return draws, trace, False


def defensive(base: Law, wide: Law, proposal: Law, base_share: float, wide_share: float) -> Mixture:
    """Return base_share of the base law + wide_share (may be 0) of a widened proposal + the rest proposal.

    Its density is at least base_share of the base, so that no weight exceeds 1 / base_share.
    """
    if wide_share == 0:
        return Mixture(np.array([base_share, 1 - base_share]), [base, proposal])
    return Mixture(np.array([base_share, wide_share, 1 - (base_share + wide_share)]), [base, wide, proposal])


def final_draws(goal: Goal, spent: int, n_final: int) -> int:
    """Return how many final draws may be made after a search, in batches of n_final."""
    if goal.max_sim is not None:
        return goal.max_sim - spent
    return n_final * (1 if goal.target_cov is None else MOST_BATCHES)


def interval_of(draws: Draws, confidence: float, largest_weight: float, cov: float | None = None) -> Interval:
    """Return the interval of p: log-normal, with t quantiles where few draws carry it.

    `cov` is the c.o.v. where it is not that of independent draws (None).

    With an effective number of failing draws under LOW_ESS its upper end is at least the one
    that `bernstein_bound` guarantees.

    Without a failing draw p <= largest_weight P_q[failure] gives a one-sided interval. Where all
    weights are 1 the draws are plain Monte Carlo and the interval is Clopper-Pearson's.
    """
    hits = len(draws.f)
    if hits == 0 or largest_weight == 1.0:
        low, high = clopper_pearson(hits, draws.n, confidence)
        return low, min(1.0, high * largest_weight)
    spread = draws.cov if cov is None else cov
    low, high = log_normal(draws.p, spread, confidence, degrees_of_freedom(draws.ess, alone=True))
    if draws.ess < LOW_ESS:
        high = max(high, bernstein_bound(draws, confidence, largest_weight))
    return low, high


def bernstein_bound(draws: Draws, confidence: float, largest_weight: float) -> float:
    """Return an upper bound of p that holds whatever the weights, up to `largest_weight`, do.

    The empirical Bernstein bound of Maurer and Pontil, theorem 4, for the mean of n terms in
    [0, largest_weight], at the level (1 - confidence) / 2. It is wide (7 / 3 largest_weight / n
    and more), which is what draws that hardly reach the failures deserve.
    """
    log_term = math.log(4 / (1 - confidence))
    weights, less = np.exp(draws.log_weights), max(draws.n - 1, 1)
    variance = max(float((weights**2).sum()) - draws.n * draws.p**2, 0.0) / less
    slack = 7 * largest_weight * log_term / (3 * less)
    return min(1.0, draws.p + math.sqrt(2 * variance * log_term / draws.n) + slack)


def doubts(draws: Draws) -> list[str]:
    """Return warnings about the weights of the failing draws."""
    if len(draws.f) == 0:
        return [f"None of {draws.n:,} final draws failed: p = 0 with a one-sided interval."]
    found = []
    if draws.ess < LOW_ESS:
        found.append(f"The failing draws are worth {draws.ess:.0f} independent ones: the estimate is coarse.")
    share = largest_share(draws.log_weights)
    if share > LARGE_SHARE:
        found.append(f"One draw carries {100 * share:.0f} % of p: failures lie where the proposal hardly reaches.")
    return found
