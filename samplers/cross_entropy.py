"""The cross-entropy method (O'Kelly et al. 2018, algorithm 1)."""

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from samplers.families import Gaussian, Mixture, Moments, weighted_moments
from samplers.importance import doubts, draw_until, interval_of, weighted_cov
from samplers.intervals import binomial_cov
from samplers.levels import next_level
from samplers.method import (
    Goal,
    Interrupted,
    Method,
    Outcome,
    Steps,
    check_choice,
    check_count,
    check_setting,
    no_outcome_share,
)
from samplers.problem import FloatArray, Inputs
from samplers.result import Level, Status
from samplers.weights import effective_sample_size, normalised

MOST_BATCHES = 100
"""Batches of final draws after which a target c.o.v. is given up where max_sim does not say."""
LEAST_BUDGET = 100
"""With less than this a search is not worth its draws."""
SEARCH_SHARE = 2 / 3
"""Largest share of max_sim that the search may use."""


class Iterate(NamedTuple):
    """One proposal of the search and what its draws showed."""

    proposal: Gaussian
    level: float
    """max(gamma, rho-quantile of f under the proposal)."""
    record: Level


@dataclass(frozen=True, kw_only=True)
class CrossEntropy(Method):
    """Importance sampling from a Gaussian found by the cross-entropy method.

    Search (algorithm 1): draw N_k points from the proposal theta_k, take as gamma_k the
    rho-quantile of f, but not less than gamma, and move theta to the Kullback-Leibler projection
    of alpha Q_k + (1 - alpha) P_theta, where Q_k is the base law given f <= gamma_k (equation 2).
    For a Gaussian family that is matching E[u] and E[u u']; expectations under Q_k come from the
    elite points with the joint likelihood ratio p0 / p_theta (equation 3), in logarithms.
    Estimate: fresh draws, independent of the search given the proposal, from
    base_share N(0, I) + wide_share widened proposal + the rest proposal, so that p-hat is
    unbiased and no weight exceeds 1 / base_share.

    Works in standard normal space. Where the paper, its released code and this implementation
    differ:

    - *gamma_k.* The algorithm box says "minimum of gamma and the quantile", the text
      gamma_k >= gamma; the latter is meant and done here.
    - *Equation 3* divides by N_k; we divide by the sum of the weights, so that Q_k has mass 1.
      The code uses each block's own likelihood ratio and divides by N rho.
    - *Family.* The paper has Beta blocks and Normal blocks with fixed covariance and bounded
      mean. Ours is one Gaussian with mean and covariance ("gaussian"), which covers curved and
      two-lobed regions better, or with the mean only ("mean"). The covariance is drawn
      towards the present one, which counts as (d + 1) max(1, d / 10) elite points: without
      that, in many dimensions, the noise of its d (d + 1) / 2 entries ruins the weights.
    - *End.* The paper runs K = 100 iterations of 5000; ours ends the search when two
      proposals have reached gamma. Search simulations are part of n_sim.
    - *Choice.* Both choose the iterate with the lowest rho-quantile, here not counted below
      gamma; among equals (f = -1 for every collision) the smallest c.o.v. decides.
    - *Ties.* gamma_k is an outcome that occurred; if most outcomes tie, the largest below.
    - *Weights.* The paper samples from the proposal alone, whose weights are unbounded.

    In some hundred dimensions the covariance cannot be learned from a thousand draws and the
    weights degenerate: the result then carries warnings and a very wide interval.

    The interval is log-normal; where the base draws already fail with a share of rho or more,
    plain Monte Carlo draws and Clopper-Pearson take over.

    Args:
        family: Which parameters of the Gaussian the search moves.
        rho: Elite fraction. (The paper has 0.01 with N_k = 5000.)
        alpha: Step size, in (0, 1].
        n_iteration: Draws per iteration, N_k; at most a tenth of max_sim.
        max_iterations: Iterations at most, K.
        n_final: Final draws; with max_sim all that is left, with target_cov batches of this.
        base_share: Share of base draws in the final sample.
        wide_share: Share of draws from the widened proposal.
        wide_factor: By how much its standard deviations are wider.

    References:
        O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle
        testing via rare-event simulation", NeurIPS 2018.
        Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000.
    """

    family: Literal["gaussian", "mean"] = "gaussian"
    rho: float = 0.1
    alpha: float = 0.8
    n_iteration: int = 1000
    max_iterations: int = 20
    n_final: int = 4000
    base_share: float = 0.1
    wide_share: float = 0.2
    wide_factor: float = 1.5

    name: ClassVar[str] = "ce"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        who = "CrossEntropy"
        check_count(who, "n_iteration", self.n_iteration, 10)
        check_count(who, "max_iterations", self.max_iterations, 1)
        check_count(who, "n_final", self.n_final, 10)
        check_setting(who, "rho", self.rho, 0.0, 0.5)
        check_setting(who, "alpha", self.alpha, 0.0, 1.0, or_equal_high=True)
        check_setting(who, "base_share", self.base_share, 0.0, 1.0)
        check_setting(who, "wide_share", self.wide_share, 0.0, 1.0 - self.base_share)
        check_setting(who, "wide_factor", self.wide_factor, 1.0, math.inf)
        check_choice(who, "family", self.family, ("gaussian", "mean"))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Search for a proposal, then estimate with fresh draws."""
        iterates, ended = yield from self._search(inputs, goal, rng)
        trace = [iterate.record for iterate in iterates]
        common = len(iterates) < 2  # the base draws fail often enough, or there is no way on
        best = min(iterates, key=lambda i: (i.level, i.record.cov)) if iterates else None
        sampler = plain(inputs.dim) if common or best is None else self._defensive(best.proposal)
        limit = self._limit(goal, sum(level.n_sim for level in trace))
        draws, final, stopped = yield from draw_until(inputs, sampler, goal, limit, self.n_final, rng)
        cov = binomial_cov(draws.p, draws.n) if common else draws.cov
        reached = best is not None and best.level == goal.gamma
        return Outcome(
            p=draws.p,
            interval=interval_of(draws, goal.confidence, 1.0 if common else 1 / self.base_share),
            cov=cov,
            status=ended if len(draws.f) else Status.NO_HITS,
            warnings=tuple(([] if reached else [search_ended(best, ended)]) + doubts(draws)),
            trace=(*trace, *final),
            no_outcome_share=no_outcome_share(draws.f, np.exp(draws.log_weights)),
        )

    def _limit(self, goal: Goal, spent: int) -> int:
        """Return how many final draws may be made."""
        if goal.max_sim is not None:
            return goal.max_sim - spent
        return self.n_final * (1 if goal.target_cov is None else MOST_BATCHES)

    def _search(
        self, inputs: Inputs, goal: Goal, rng: np.random.Generator
    ) -> Generator[FloatArray, FloatArray, tuple[list[Iterate], Status]]:
        """Run algorithm 1 until two proposals have reached gamma; return iterates and ending."""
        if goal.budget < LEAST_BUDGET:
            return [], Status.BUDGET
        size = min(self.n_iteration, goal.budget // 10)
        affordable = int(SEARCH_SHARE * goal.budget) // size
        proposal = Gaussian.standard(inputs.dim)
        iterates: list[Iterate] = []
        for _ in range(min(self.max_iterations, affordable)):
            u = proposal.sample(size, rng)
            f = yield inputs.base.from_standard_normal(u)
            log_weights = Gaussian.standard(inputs.dim).log_prob(u) - proposal.log_prob(u)
            level = next_level(f, self.rho, goal.gamma)
            iterates.append(described(proposal, f, log_weights, float(f.min()) if level is None else level))
            goal.on_level(iterates[-1].record)
            if level is None:
                return iterates, Status.STALLED
            reached = sum(iterate.level == goal.gamma for iterate in iterates)
            if reached == 2 or (reached == 1 and len(iterates) == 1):
                return iterates, Status.CONVERGED
            elite = f <= level
            proposal = self._moved(proposal, u[elite], log_weights[elite])
        if iterates[-1].level == goal.gamma:
            return iterates, Status.CONVERGED
        return iterates, Status.BUDGET if affordable < self.max_iterations else Status.STALLED

    def _moved(self, proposal: Gaussian, elite: FloatArray, log_weights: FloatArray) -> Gaussian:
        """Return the proposal after one step of equation 2 towards the elite points (n, d)."""
        target = weighted_moments(elite, normalised(log_weights))
        now = proposal.moments
        mixed = Moments(*(self.alpha * new + (1 - self.alpha) * old for new, old in zip(target, now, strict=True)))
        if self.family == "mean":
            return Gaussian(mixed.first, proposal.cholesky)
        dim = len(mixed.first)
        prior = (dim + 1) * max(1.0, dim / 10)  # worth this many elite points
        pull = prior / (prior + effective_sample_size(log_weights))
        covariance = (1 - pull) * mixed.covariance + pull * proposal.covariance
        return Gaussian.from_covariance(mixed.first, covariance)

    def _defensive(self, proposal: Gaussian) -> Mixture:
        """Return the law of the final draws; its density is at least base_share of the base."""
        shares = [self.base_share, self.wide_share]
        return Mixture(
            np.array([*shares, 1 - sum(shares)]),
            [
                Gaussian.standard(len(proposal.mean)),
                proposal.widened(self.wide_factor),
                proposal,
            ],
        )


def plain(dim: int) -> Mixture:
    """N(0, I) as a mixture of one component."""
    return Mixture(np.ones(1), [Gaussian.standard(dim)])


def described(proposal: Gaussian, f: FloatArray, log_weights: FloatArray, level: float) -> Iterate:
    """Return an iterate with its record: what its draws f (n,) say about P[f <= level]."""
    elite = f <= level
    record = Level(
        gamma=level,
        p=float(elite.mean()),
        estimate=float(np.exp(log_weights[elite]).sum()) / len(f),
        n_sim=len(f),
        n_points=len(f),
        cov=weighted_cov(len(f), log_weights[elite]),
        ess=effective_sample_size(log_weights[elite]),
    )
    return Iterate(proposal, level, record)


def search_ended(best: Iterate | None, ended: Status) -> str:
    """Return the warning about a search that did not reach gamma."""
    if best is None:
        return f"max_sim is under {LEAST_BUDGET}, too little for a search: plain draws only."
    why = "max_sim was used up" if ended is Status.BUDGET else "no lower threshold was found"
    return f"The search ended at f <= {best.level:.4g}, before gamma: {why}."
