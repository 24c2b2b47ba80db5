"""Improved cross-entropy method (Papaioannou, Geyer and Straub 2019)."""

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from scipy.special import log_ndtr

from samplers.importance import Search
from samplers.method import Goal, Steps
from samplers.methods.base import Method
from samplers.problem import FloatArray, Inputs, check_settings
from samplers.proposals import (
    Mixture,
    ProposalDistribution,
    VonMisesFisherNakagami,
    fit_proposal_mixture,
    fit_shrunk_gaussian,
)
from samplers.sample import Status, normalise_weights

HUGE = 1e300
"""Outcomes from there on stand for infinite ones and say nothing about the scale of f."""


@dataclass(frozen=True, kw_only=True)
class ImprovedCrossEntropy(Method):
    """Cross-entropy whose targets are smooth, so that all points count and not only the lowest ones.

    Target k is p0(u) Phi(-(f(u) - gamma) / sigma_k), which becomes p0 given failure as sigma falls to 0.
    Search, in standard normal space: of draws from the proposal q_k fitted to target k, sigma_(k+1) is the
    width, at most sigma_k, at which the weights Phi(-(f - gamma) / sigma) p0 / q_k have the c.o.v.
    weight_cov, and q_(k+1) is fitted to all draws with these weights. It ends when the
    c.o.v. of I[f <= gamma] / Phi(-(f - gamma) / sigma_k) falls to weight_cov.
    Estimate: fresh draws from base_share p0 + wide_share (q widened) + the rest q, with q fitted to the failing
    draws of all rounds (`pool_rounds`). Given the search, p-hat is unbiased and no weight exceeds 1 / base_share.

    Families: one Gaussian ("gaussian"); a mixture of Gaussians ("mixture"); a mixture of
    von Mises-Fisher-Nakagami distributions ("vmfn"), a direction and a radius, for many dimensions and failure
    around the origin. Mixtures by expectation-maximisation of weighted points.

    Where the authors' released code (the ERA group's iCE scripts) and this implementation differ:

    - *Estimate.* The code estimates from the last draws of the search, whose proposal was stopped by looking at them.
      Fresh draws, base draws among them, are right with any search; their proposal is fitted to the failures of
      all rounds, as the last round may have lost a region.
    - *Wide draws* are ours: a Gaussian fitted to failures beyond a plane falls off as fast as they do or faster.
    - *sigma* is sought by bisection between 1e-15 and 10 times the median of |f - gamma|; the code's first width,
      `10*mean(geval)`, is spoilt by an outlier or a negative mean. f may be infinite.
    - *Components.* The number with the best Bayesian information criterion; the code starts with one and drops some.
    - *Covariances* are shrunk towards I but for the direction of the mean (`fit_shrunk_gaussian`), so that a hundred
      dimensions can be had.

    A region that the search did not see or lost in fitting is seen by base draws only, as a rare heavy
    weight (then warned of) or not at all. The interval is log-normal (`weighted_interval`); if the base draws
    themselves fail often enough, plain draws and Clopper-Pearson take over.

    Args:
        family: Family of the proposal.
        components: Components of a mixture at most.
        weight_cov: C.o.v. of the weights that sets the next width. (The code's CV_target.)
        n_round: Draws per round of the search; at most a tenth of max_sim.
        max_rounds: Rounds of the search at most.
        n_final: Final draws; with max_sim all that is left, with a target c.o.v. batches of this.
        base_share: Share of base draws in the final sample.
        wide_share: Share of draws from the widened proposal.
        wide_factor: By how much its components are wider.

    References:
        Papaioannou, Geyer and Straub, "Improved cross entropy-based importance sampling with a flexible
        mixture model", Reliability Engineering and System Safety 191, 2019.
        Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (the base draws).

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda u: 4.0 - np.abs(u[:, 0]), dim=2)  # two regions, P = 6.33e-5
        >>> result = samplers.estimate(problem, samplers.ImprovedCrossEntropy(), seed=0, max_sim=5000)
        >>> result.interval[0] < 6.334e-5 < result.interval[1], result.cov < 0.1
        (True, True)
    """

    family: Literal["gaussian", "mixture", "vmfn"] = "mixture"
    components: int = 4
    weight_cov: float = 1.5
    n_round: int = 1000
    max_rounds: int = 20
    n_final: int = 4000
    base_share: float = 0.1
    wide_share: float = 0.2
    wide_factor: float = 1.5

    name: ClassVar[str] = "ice"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, family=("gaussian", "mixture", "vmfn"), components=1, n_round=10, max_rounds=1, n_final=10)
        check_settings(self, weight_cov=(0.0, math.inf), base_share=(0.0, 1.0), wide_factor=(1.0, math.inf))
        check_settings(self, wide_share=(0.0, 1.0 - self.base_share))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Search for a proposal, then estimate with fresh draws."""
        search = Search(inputs, goal, rng)
        proposal = yield from self._search(search)
        sampler = search.mix(proposal, self.base_share, self.wide_share, self.wide_factor)
        return (yield from search.finish(sampler, self.n_final, search.warnings()))

    def _search(self, search: Search) -> Generator[FloatArray, FloatArray, Mixture | None]:
        """Narrow the target down to failure; return the proposal fitted last, None if base draws serve."""
        gamma, rng = search.goal.gamma, search.rng
        sampler: ProposalDistribution = search.base
        proposal: Mixture | None = None
        width, narrowest = math.inf, 0.0
        while last := (yield from search.draw(sampler, self.n_round, self.max_rounds)):
            log_ratio = last.log_weights
            search.record(gamma, log_ratio[last.f <= gamma])
            g = np.clip(last.f - gamma, -HUGE, HUGE)
            reached = weights_cov(np.where(g <= 0, -log_smooth_indicator(g, width), -np.inf)) <= self.weight_cov
            if proposal is None:
                if reached:
                    search.status = Status.CONVERGED
                    return None
                sizes = np.abs(g[(np.abs(g) < HUGE) & (g != 0)])
                scale = float(np.median(sizes)) if len(sizes) else 1.0
                # at the widest the indicator is nearly constant, at the narrowest itself in double precision
                width, narrowest = 10 * scale, 1e-15 * scale
            width = next_width(g, log_ratio, self.weight_cov, narrowest, width)
            if reached or (width == narrowest and (g <= 0).any()):
                search.status = Status.CONVERGED
                return self._fit(search.failing_points(), search.pool_rounds().log_weights, rng)
            log_weights = log_smooth_indicator(g, width) + log_ratio
            if width == narrowest or not np.isfinite(log_weights).any():  # all outcomes alike
                return proposal
            sampler = proposal = self._fit(last.u, log_weights, rng)
        return proposal

    def _fit(self, u: FloatArray, log_weights: FloatArray, rng: np.random.Generator) -> Mixture:
        """Return the member of the family nearest to points u (n, d) with these weights (n,)."""
        used = np.isfinite(log_weights)
        u, weights = u[used], normalise_weights(log_weights[used])
        dim = u.shape[1]
        if self.family == "gaussian":
            return fit_proposal_mixture(fit_shrunk_gaussian, u, weights, 1, 1, rng)
        if self.family == "mixture":
            size = dim + min(dim * (dim + 1) // 2, 2 * dim)  # shrinking leaves about so many
            return fit_proposal_mixture(fit_shrunk_gaussian, u, weights, self.components, size, rng)
        return fit_proposal_mixture(VonMisesFisherNakagami.fit, u, weights, self.components, dim + 2, rng)


def log_smooth_indicator(g: FloatArray, width: float) -> FloatArray:
    """Return log Phi(-g / width) of g = f - gamma (n,), a smooth indicator of g <= 0."""
    with np.errstate(over="ignore"):
        return np.asarray(log_ndtr(-g / width))


def weights_cov(log_weights: FloatArray) -> float:
    """Return the c.o.v. of weights given as logarithms (n,); inf if all are 0."""
    highest = float(log_weights.max())
    if highest == -math.inf:
        return math.inf
    weights = np.exp(log_weights - highest)
    return float(weights.std() / weights.mean())


def next_width(g: FloatArray, log_ratio: FloatArray, target: float, low: float, high: float) -> float:
    """Return the width in [low, high] at which Phi(-g / width) p0 / q has the target c.o.v., or an end."""
    if weights_cov(log_smooth_indicator(g, low) + log_ratio) <= target:
        return low
    if weights_cov(log_smooth_indicator(g, high) + log_ratio) >= target:
        return high
    for _ in range(60):  # 36 / 2^60, of the logarithm, is rounding
        middle = math.sqrt(low) * math.sqrt(high)
        if weights_cov(log_smooth_indicator(g, middle) + log_ratio) > target:
            low = middle
        else:
            high = middle
    return high
