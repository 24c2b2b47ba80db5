"""Importance sampling: weighted draws and their calibration, and the search for a proposal with final draws after it.

Draws u_i of q = sum_k a_k q_k, a fixed number n_k = n a_k from each component (a stratum), estimate the mass of each
component, which is 1, by the mean of h_ij = q_j(u_i) / q(u_i). How far these means are off tells how far p-hat =
mean(y), y = weight times indicator of failure, is off: they are control variates,

    p = mean(y) - b . (mean(h) - 1),    b = (H'H + r n I)^-1 H'y,    H_i = h_i less the mean of h in its stratum

p is linear in y, so that it is also the mean of y with calibrated weights, which serve any threshold,

    p = mean(c y),    c_i = 1 - n H_i . (H'H + r n I)^-1 (mean(h) - 1)

References:
    Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (components as control variates, defensive
    mixtures).
    Deville and Särndal, "Calibration estimators in survey sampling", JASA 87, 1992 (regression as weights).
    Maurer and Pontil, "Empirical Bernstein bounds and sample-variance penalization", COLT 2009.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.method import Goal, Interrupted, Outcome, no_outcome_share
from samplers.problem import FloatArray, Inputs, StandardNormal
from samplers.proposals import Mixture, ProposalDistribution
from samplers.sample import (
    COARSE,
    DrawWeights,
    Interval,
    Level,
    Sample,
    Status,
    binomial_cov,
    clopper_pearson,
    degrees_of_freedom,
    effective_sample_size,
    log_normal_interval,
)

RIDGE = 0.1
"""r: a control whose variance within the strata is well below this explains little, and few draws would decide b."""
LEAST_FACTOR = 0.1
"""Least c of a draw: where one would have less, all go only part of the way from 1. One run in 20 has such draws."""


class Calibration(NamedTuple):
    """Calibrated weights of n draws, as factors c (n,) of their own; m = 0 if the weights stay as they are."""

    factors: FloatArray
    controls: FloatArray  # H (n, m)
    slopes: FloatArray  # S (n, m) with b = S'y
    strata: NDArray[np.int64]  # of each draw, (n,)

    def residuals(self, y: FloatArray) -> FloatArray:
        """Return y (n,) less what the controls explain, by leverage as in the jackknife: p varies as these."""
        if self.controls.shape[1] == 0:
            return y
        mean = _stratum_means(y[:, None], self.strata)[:, 0]
        leverage = (self.controls * self.slopes).sum(axis=1)  # below 1 by the ridge
        return np.asarray(mean + (y - mean - self.controls @ (self.slopes.T @ y)) / (1 - leverage))


def calibrate(ratios: FloatArray, strata: NDArray[np.int64], draws_per_control: int) -> Calibration:
    """Return calibrated weights of draws from q, given h (n, m), densities over q; few keep their own."""
    n, m = ratios.shape
    if n < draws_per_control * m:
        none = np.empty((n, 0))
        return Calibration(np.ones(n), none, none, strata)
    controls = ratios - _stratum_means(ratios, strata)
    normal = controls.T @ controls + RIDGE * n * np.eye(m)
    slopes = np.linalg.solve(normal, controls.T).T
    change = n * (slopes @ (ratios.mean(axis=0) - 1))
    part = min(1.0, (1 - LEAST_FACTOR) / max(float(change.max()), 1.0 - LEAST_FACTOR))
    return Calibration(1 - part * change, controls, part * slopes, strata)


def _stratum_means(values: FloatArray, strata: NDArray[np.int64]) -> FloatArray:
    """Return the mean of values (n, m) over the stratum of each draw, shape (n, m)."""
    counts = np.maximum(np.bincount(strata), 1)
    sums = np.stack([np.bincount(strata, weights=column) for column in values.T], axis=1)
    return np.asarray((sums / counts[:, None])[strata])


LOW_ESS = 30
"""Effective failing draws below which the normal approximation of the interval is not relied on."""
COARSE_ESS = 10
"""Effective failing draws below which there is a warning: at 1,500 simulations 38 of 455 right runs of two-stage had
one, and 45 of 93 that were off by more than 4 errors (67 limit states); from 10 to 20 there were 31 and 7."""


@dataclass(frozen=True, eq=False)
class Draws:
    """n independent draws from one proposal, of which k fail; `log_weights` are log(p0 / q), calibrated or not.

    `fails` says which draws fail, in the order in which they were simulated, (n,); empty if that is not known.
    """

    n: int
    f: FloatArray  # of the failing ones, (k,)
    log_weights: FloatArray  # (k,)
    x: FloatArray = field(default_factory=lambda: np.empty((0, 0)))  # in physical space, (k, d)
    f_safe: FloatArray = field(default_factory=lambda: np.empty(0))  # of the others, (n - k,)
    log_weights_safe: FloatArray = field(default_factory=lambda: np.empty(0))  # (n - k,)
    fails: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))

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
        """Return the weight of each draw in p, in the order of their simulation, of which this many came before."""
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
        """Coefficient of variation of `p`; inf without a failing draw."""
        return weighted_cov(self.n, self.log_weights)

    @property
    def skewness(self) -> float:
        """Skewness of a term, weight times indicator of failure; 0 if all are equal."""
        if len(self.f) == 0:
            return 0.0
        w = np.exp(self.log_weights - self.log_weights.max())
        mean = float(w.sum()) / self.n
        variance = float((w * w).sum()) / self.n - mean**2
        third = (float(((w - mean) ** 3).sum()) - (self.n - len(w)) * mean**3) / self.n
        return third / variance**1.5 if variance > 0 else 0.0

    def outcome(
        self,
        goal: Goal,
        status: Status,
        trace: Sequence[Level],
        largest_weight: float,
        base_draws: int,
        warnings: Sequence[str] = (),
    ) -> Outcome:
        """Return the outcome of a run whose last simulations these are; their largest weight is 1 for plain draws."""
        return Outcome(
            p=self.p,
            interval=weighted_interval(self, goal.confidence, largest_weight),
            cov=binomial_cov(self.p, self.n) if largest_weight == 1 else self.cov,
            status=status if len(self.f) or status is Status.STOPPED else Status.NO_HITS,
            warnings=(*warnings, *weight_warnings(self)),
            trace=tuple(trace),
            no_outcome_share=no_outcome_share(self.f, self.log_weights),
            sample=self.sample,
            base_draws=base_draws,
            draw_weights=self.weights_after(sum(level.n_sim for level in trace) - self.n),
        )


def weighted_cov(n: int, log_weights: FloatArray) -> float:
    """Return the c.o.v. of sum(w) / n, (largest term / n)^2 added to its square; inf without a weight."""
    if log_weights.size == 0:
        return math.inf
    w = np.exp(log_weights - log_weights.max())
    mean = float(w.sum()) / n
    spread = (float((w * w).sum()) / n - mean * mean) / max(n - 1, 1)
    return math.sqrt(max(spread, 0.0) + 1.0 / (n * n)) / mean


def weighted_interval(
    draws: Draws, confidence: float, largest_weight: float, cov: float | None = None, ceiling: float = 1.0
) -> Interval:
    """Return the interval of p: log-normal, with t quantiles for few draws; Clopper-Pearson's for plain ones.

    Below LOW_ESS its upper limit is at least `bernstein_bound`, or `ceiling` where that is less, and its lower limit
    that without the heaviest draw, where it lies above p without this. Without a failing draw
    p <= largest_weight P_q[failure].
    """
    hits = len(draws.f)
    if hits == 0 or largest_weight == 1.0:
        low, high = clopper_pearson(hits, draws.n, confidence)
        return low, min(1.0, high * largest_weight)
    spread = draws.cov if cov is None else cov
    low, high = log_normal_interval(draws.p, spread, confidence, degrees_of_freedom(draws.ess, independent=True))
    if draws.ess < LOW_ESS:
        high = max(high, min(bernstein_bound(draws, confidence, largest_weight), ceiling))
        others = np.sort(draws.log_weights)[:-1]
        df = degrees_of_freedom(effective_sample_size(others), independent=True)
        p = float(np.exp(others).sum()) / draws.n
        if low > p:  # it rests on one draw
            low = log_normal_interval(p, weighted_cov(draws.n, others), confidence, df)[0]
    return low, high


def bernstein_bound(draws: Draws, confidence: float, largest_weight: float) -> float:
    """Return the upper limit of p by Maurer and Pontil, theorem 4, at the level (1 - confidence) / 2."""
    log_term = math.log(4 / (1 - confidence))
    weights, less = np.exp(draws.log_weights), max(draws.n - 1, 1)
    variance = max(float((weights**2).sum()) - draws.n * draws.p**2, 0.0) / less
    slack = 7 * largest_weight * log_term / (3 * less)
    return min(1.0, draws.p + math.sqrt(2 * variance * log_term / draws.n) + slack)


def weight_warnings(draws: Draws) -> list[str]:
    """Return a warning if no draw failed, or if those that failed are worth few independent ones."""
    if len(draws.f) == 0:
        return [f"None of {draws.n:,} final draws failed: p = 0 with a one-sided interval."]
    if draws.ess >= COARSE_ESS:
        return []
    return [f"The failing draws have an effective sample size of {draws.ess:.0f}; {COARSE}."]


def round_record(level: float, n: int, log_weights: FloatArray) -> Level:
    """Return the record of a round of n draws: P[f <= level] by log(p0 / q) (k,) of those with f <= level."""
    return Level(
        gamma=level,
        p=len(log_weights) / n,
        estimate=float(np.exp(log_weights).sum()) / n,
        n_sim=n,
        n_points=n,
        cov=weighted_cov(n, log_weights),
        ess=effective_sample_size(log_weights),
    )


def count_final_draws(goal: Goal, spent: int, n_final: int) -> int:
    """Return how many final draws may be made after a search, in batches of n_final."""
    if goal.max_sim is not None:
        return goal.max_sim - spent
    return n_final * (1 if goal.target_cov is None else 100)


LEAST_SEARCH_BUDGET = 100
"""With a smaller max_sim all draws are base draws: ten rounds of ten draws are the least that can be fitted to."""


class Round(NamedTuple):
    """Simulated draws u (n, d), with outcomes f (n,), from a proposal q in the space where p0 is the base."""

    base: ProposalDistribution
    proposal: ProposalDistribution
    u: FloatArray
    f: FloatArray

    @property
    def log_weights(self) -> FloatArray:
        """log(p0 / q) of the draws, shape (n,)."""
        return self.base.log_prob(self.u) - self.proposal.log_prob(self.u)


class Search:
    """A search for a proposal by rounds of draws, then final draws, which alone p rests on unless the run is stopped.

    It works in the space of the base distribution `base` there, N(0, I) as a rule, which `to_x` maps to physical space.
    `rounds` are those whose draws are kept, the first from the base; `trace` has a record of every round. The status is
    CONVERGED if the search reached gamma.
    """

    def __init__(
        self,
        inputs: Inputs,
        goal: Goal,
        rng: np.random.Generator,
        base: ProposalDistribution | None = None,
        to_x: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        self.goal, self.rng = goal, rng
        self.base = base or StandardNormal(inputs.dim)
        self.to_x = to_x or inputs.base.from_standard_normal
        self.rounds, self.trace = list[Round](), list[Level]()
        self.status = Status.STALLED

    @property
    def n_sim(self) -> int:
        """Simulations made so far."""
        return sum(level.n_sim for level in self.trace)

    def draw(
        self, proposal: ProposalDistribution, n_round: int, max_rounds: int
    ) -> Generator[FloatArray, FloatArray, Round | None]:
        """Simulate n_round draws, fewer if max_sim is small; None if the search is over, its status says why."""
        budget = self.goal.budget
        size = min(n_round, budget // 10)  # about seven rounds fit into the share of the search
        if len(self.trace) == max_rounds:
            return None
        if budget < LEAST_SEARCH_BUDGET or self.n_sim + size > int(2 / 3 * budget):  # a third is for the final draws
            self.status = Status.BUDGET
            return None
        u = proposal.sample(size, self.rng)
        try:
            f = yield self.to_x(u)
        except Interrupted:
            self.status = Status.STOPPED
            return None
        self.rounds.append(Round(self.base, proposal, u, f))
        return self.rounds[-1]

    def record(self, level: float, log_weights: FloatArray) -> None:
        """Record the last round: its level, and log(p0 / q) (k,) of the draws with f <= level."""
        self.trace.append(round_record(level, len(self.rounds[-1].f), log_weights))
        self.goal.on_level(self.trace[-1])

    def failing_points(self) -> FloatArray:
        """Return the failing draws of all rounds kept, in the space of the search, shape (k, d)."""
        return np.concatenate([one.u[one.f <= self.goal.gamma] for one in self.rounds])

    def pool_rounds(self) -> Draws:
        """Return the draws of the rounds kept as if from the mixture of their proposals, weights up to N / n_0.

        These were fitted to earlier draws: p is low by 1 to 4 %, its interval holds in 92 to 100 % of runs.
        """
        n = np.array([len(one.f) for one in self.rounds])
        u, f = (np.concatenate(parts) for parts in zip(*((one.u, one.f) for one in self.rounds), strict=True))
        mixture = Mixture(n / n.sum(), [one.proposal for one in self.rounds])
        return Draws.from_outcomes(f, self.base.log_prob(u) - mixture.log_prob(u), self.to_x(u), self.goal.gamma)

    def warnings(self) -> list[str]:
        """Return the warning about a search that did not reach gamma."""
        if self.status is Status.CONVERGED:
            return []
        if not self.trace:
            return [f"max_sim is under {LEAST_SEARCH_BUDGET}, too little for a search: base draws only."]
        lowest = min(level.gamma for level in self.trace)
        where = f" at f <= {lowest:.4g}," if lowest > self.goal.gamma else ""
        why = {Status.BUDGET: "its share of max_sim was used up", Status.STOPPED: "it was stopped"}
        return [f"The search for a proposal ended{where} before gamma: {why.get(self.status, 'it came no closer')}."]

    def mix(
        self, proposal: Any, base_share: float, wide_share: float = 0.0, wide_factor: float = 1.0
    ) -> ProposalDistribution:
        """Return base_share of the base, wide_share of the widened proposal and the rest of it; the base for None."""
        if proposal is None:
            return self.base
        wide = [proposal.widen(wide_factor)] if wide_share else []
        shares = [base_share, *([wide_share] if wide_share else []), 1 - (base_share + wide_share)]
        return Mixture(np.array(shares), [self.base, *wide, proposal])

    def draw_final(
        self, sampler: ProposalDistribution, limit: int, batch: int, target_cov: float | None
    ) -> Generator[FloatArray, FloatArray, Draws]:
        """Simulate batches of a sampler until there are `limit` draws, or their c.o.v. is met; none after a stop."""
        draws = Draws(0, np.empty(0), np.empty(0))
        while self.status is not Status.STOPPED and draws.n < limit:
            u = sampler.sample(min(batch, limit - draws.n), self.rng)
            x = self.to_x(u)
            try:
                f = yield x
            except Interrupted:
                self.status = Status.STOPPED
                break
            new = Draws.from_outcomes(f, self.base.log_prob(u) - sampler.log_prob(u), x, self.goal.gamma)
            draws = draws.join(new)
            record = round_record(self.goal.gamma, new.n, new.log_weights)
            self.trace.append(replace(record, estimate=draws.p, cov=draws.cov, ess=draws.ess))  # of all so far
            self.goal.on_level(self.trace[-1])
            if target_cov is not None and draws.cov <= target_cov:
                break
        return draws

    def finish(
        self,
        sampler: ProposalDistribution,
        batch: int,
        warnings: Sequence[str],
        limit: int | None = None,
        target_cov: float | None = None,
    ) -> Generator[FloatArray, FloatArray, Outcome]:
        """Simulate the final draws of a sampler that `mix` returned; after a stop take those of the search."""
        limit = count_final_draws(self.goal, self.n_sim, batch) if limit is None else limit
        base_draws = len(self.rounds[0].f) if self.rounds else 0
        draws = yield from self.draw_final(sampler, limit, batch, target_cov or self.goal.target_cov)
        if draws.n:
            base_share = float(sampler.weights[0]) if isinstance(sampler, Mixture) else 1.0
            made = base_draws + int(base_share * draws.n)
            return draws.outcome(self.goal, self.status, self.trace, 1 / base_share, made, warnings)
        draws = self.pool_rounds()
        about = ["Stopped before the final draws: the estimate rests on those of the search."]
        outcome = draws.outcome(self.goal, self.status, self.trace, draws.n / base_draws, base_draws, about)
        rest = draws.n - base_draws
        parts = ((0, base_draws), (self.n_sim - rest, rest))  # the first round and the last ones, others between them
        return replace(outcome, draw_weights=draws.weights_after(0)[0].split(*parts))
