"""Run of the method `Surrogate`: learning, then draws for the estimate."""

import math
from collections.abc import Generator
from dataclasses import replace

import numpy as np

from samplers.importance.draws import (
    Draws,
    describe_low_ess,
    heavy_draw_warnings,
    weight_warnings,
    weighted_interval,
)
from samplers.importance.sampling import count_final_draws, simulate_until
from samplers.importance.search import FinalDraws
from samplers.method import Goal, Interrupted, Outcome, Steps, no_outcome_share
from samplers.methods.surrogate.estimate import BASE, EstimateDraws
from samplers.methods.surrogate.kriging import Kriging, fit_kriging
from samplers.methods.surrogate.learning import choose_batch, design_size, draw_design, learning_size
from samplers.methods.surrogate.pool import (
    PoolProposal,
    build_pool_proposal,
    draw_mixture_pool,
    first_mixture,
    fit_mixture,
)
from samplers.methods.surrogate.settings import SurrogateSettings
from samplers.problem import FloatArray, Inputs, StandardNormal
from samplers.proposals.gaussian import TiltedNormal
from samplers.statistics.intervals import Interval, degrees_of_freedom, log_normal_interval
from samplers.statistics.unseen_share import add_unseen
from samplers.trace import Level, Status


class SurrogateRun:
    """One run: what has been simulated so far.

    Args:
        inputs: Without coordinates that are noise.
        goal: Threshold, confidence, target and budget.
        budget: Simulations to plan for.
        settings: Numbers.
        rng: Source of randomness.
    """

    def __init__(
        self, inputs: Inputs, goal: Goal, budget: int, settings: SurrogateSettings, rng: np.random.Generator
    ) -> None:
        self.inputs, self.goal, self.budget, self.settings, self.rng = inputs, goal, budget, settings, rng
        self.u, self.f = np.empty((0, inputs.dim)), np.empty(0)
        self.trace: list[Level] = []
        self.n_design, self.failing_batches = 0, 0

    def steps(self) -> Steps:
        """Learn; then estimate, or leave it to plain Monte Carlo."""
        learning, scales = self.settings.learning, self.settings.learning.scales
        try:
            self.n_design = design_size(self.budget, self.inputs.dim, learning)
            yield from self._simulate(draw_design(self.n_design, self.inputs.dim, scales, self.rng))
            if (self.f[: self.n_design // len(scales)] <= self.goal.gamma).mean() >= learning.common_share:
                return (yield from self.draw_base())
            kriging = yield from self._learn()
        except Interrupted:
            return self._estimate_early(Status.STOPPED)
        if not (self.f <= self.goal.gamma).any():
            about = f"None of {len(self.f):,} simulations for learning failed: base draws take the rest."
            return (yield from self.draw_base()).remark_first(about)
        return (yield from self._estimate(kriging))

    def draw_base(self) -> Steps:
        """Spend the rest on base draws; those of the design do not count, for they may have decided it."""
        base = TiltedNormal(np.zeros(self.inputs.dim))
        limit, batch = self._count_draws(), max(self.budget - len(self.f), 1)
        draws, trace, stopped = yield from simulate_until(self.inputs, base, self.goal, limit, batch, self.rng)
        if draws.n == 0:
            return self._estimate_early(Status.STOPPED if stopped else Status.BUDGET)
        final = FinalDraws(draws, (*self.trace, *trace), 1.0, draws.n, stopped)
        return final.outcome(self.goal, Status.CONVERGED, ())

    def _simulate(self, u: FloatArray) -> Generator[FloatArray, FloatArray, None]:
        """Simulate u (n, d) to learn from."""
        f = yield self.inputs.base.from_standard_normal(u)
        self.u, self.f = np.concatenate([self.u, u]), np.concatenate([self.f, f])
        failing = float((f <= self.goal.gamma).mean())
        self._record(
            Level(gamma=self.goal.gamma, p=failing, estimate=math.nan, n_sim=len(f), n_points=len(f), cov=math.inf)
        )

    def _record(self, level: Level) -> None:
        """Add a level to the trace."""
        self.trace.append(level)
        self.goal.on_level(level)

    def _learn(self) -> Generator[FloatArray, FloatArray, Kriging]:
        """Simulate batches where the surrogate is in doubt, until it is good enough or has its share of the budget."""
        learning, scales = self.settings.learning, self.settings.learning.scales
        most = learning_size(self.budget, learning)
        size = max((most - self.n_design) // learning.batches, learning.least_batch)
        kriging = fit_kriging(self.u, self.f - self.goal.gamma, None, self.settings.kriging)
        mixture, good = first_mixture(self.inputs.dim, scales), 0
        surprises = list[float]()
        while len(self.f) < most and good < 2:
            pool = draw_mixture_pool(kriging, mixture, self.settings.pool.learning_size, self.rng)
            before = int((self.f <= self.goal.gamma).sum())
            batch = choose_batch(kriging, pool, min(size, most - len(self.f)), learning, self.rng)
            expected = np.exp(kriging.predict(batch).log_fail)
            yield from self._simulate(batch)
            surprises.append(float((self.f[-len(batch) :] <= self.goal.gamma).sum() - expected.sum()))
            allowed = learning.most_surprise * math.sqrt(2 * float((expected * (1 - expected)).sum()) + 1)
            calibrated = abs(sum(surprises[-2:])) <= allowed
            failures = int((self.f <= self.goal.gamma).sum())
            self.failing_batches += failures > before
            forecast = pool.forecast_cov(self.budget - len(self.f))
            good = good + 1 if failures and calibrated and forecast < learning.forecast_cov else 0
            mixture = fit_mixture(pool, scales, self.settings.pool, self.rng)
            kriging = fit_kriging(self.u, self.f - self.goal.gamma, kriging, self.settings.kriging)
        self._mixture = mixture
        return kriging

    def _build_proposal(self, kriging: Kriging) -> PoolProposal:
        """Return the proposal for the estimate."""
        scales, settings = self.settings.learning.scales, self.settings.pool
        for _ in range(settings.final_rounds):
            pool = draw_mixture_pool(kriging, self._mixture, settings.final_size // 4, self.rng)
            self._mixture = fit_mixture(pool, scales, settings, self.rng)
        pool = draw_mixture_pool(kriging, self._mixture, settings.final_size, self.rng)
        return build_pool_proposal(pool, scales, self.settings.proposal)

    def _count_draws(self) -> int:
        """Return the number of draws of the estimate at most."""
        return count_final_draws(self.goal, len(self.f), self.budget - len(self.f))

    def _estimate(self, kriging: Kriging) -> Steps:
        """Draw until the budget is used or the target is met; p rests on these draws alone.

        The surrogate learns from each part before the next one is drawn. Given what was there before it, each part's
        mean is unbiased, and so is that of all draws.
        """
        goal, stopped, made = self.goal, False, EstimateDraws.begin(self._design_log_weights())
        left, proposal = self._count_draws(), self._build_proposal(kriging)
        size = self._part_size(left)
        while left > 0 and not (goal.target_cov is not None and made.draws.n and made.cov <= goal.target_cov):
            new = proposal.draw(min(size, left), self.rng)
            x = self.inputs.base.from_standard_normal(new.u)
            try:
                f = yield x
            except Interrupted:
                stopped = True
                break
            made = made.add(new, f, x, goal.gamma, proposal.pool_variance)
            left -= len(f)
            self._record_draws(f, made)
            if left > 0 and made.draws.n < self.settings.most_learned:
                self.u, self.f = np.concatenate([self.u, new.u]), np.concatenate([self.f, f])
                kriging = fit_kriging(self.u, self.f - goal.gamma, kriging, self.settings.kriging)
                proposal = self._build_proposal(kriging)
        if made.draws.n == 0:
            return self._estimate_early(Status.STOPPED if stopped else Status.BUDGET)
        return self._conclude(made, proposal.largest_weight, Status.STOPPED if stopped else Status.CONVERGED)

    def _part_size(self, left: int) -> int:
        """Return the number of draws of one part."""
        if self.goal.target_cov is not None:
            return max(int(self.settings.target_batch * self.budget), 1)
        return min(self.settings.largest_batch, math.ceil(left / self.settings.parts))

    def _record_draws(self, f: FloatArray, made: EstimateDraws) -> None:
        """Add a part of the estimate, with outcomes f (n,), to the trace."""
        level = Level(
            gamma=self.goal.gamma,
            p=float((f <= self.goal.gamma).mean()),
            estimate=made.draws.p,
            n_sim=len(f),
            n_points=len(f),
            cov=made.cov,
            ess=made.draws.ess,
        )
        self._record(level)

    def _conclude(self, made: EstimateDraws, largest_weight: float, status: Status) -> Outcome:
        """Return what the draws of the estimate say, the upper end raised by what was not found."""
        outcome = self._outcome(made.draws, made.cov, largest_weight, status)
        lineages = made.count_lineages(self.failing_batches)
        high = add_unseen(made.draws.p, outcome.interval[1], lineages, self.goal.confidence)
        return replace(
            outcome,
            interval=(outcome.interval[0], high),
            warnings=(*outcome.warnings, *made.skill_warnings(self.settings.least_skill)),
            base_draws=int(made.kinds[0, BASE]),
            sample=replace(made.draws.sample, lineages=lineages),
        )

    def _design_log_weights(self, *, failing: bool = True) -> FloatArray:
        """Return log(phi / q) of the points of the design, q the equal mixture of its scales; of the failing ones."""
        u, f = self.u[: self.n_design], self.f[: self.n_design]
        u = u[f <= self.goal.gamma] if failing else u
        design = first_mixture(self.inputs.dim, self.settings.learning.scales)
        return StandardNormal(self.inputs.dim).log_prob(u) - design.log_prob(u)

    def _estimate_early(self, status: Status) -> Outcome:
        """Return what the first design says, for a run that ends before its estimate."""
        n = self.n_design
        x = self.inputs.base.from_standard_normal(self.u[:n])
        draws = Draws.from_outcomes(self.f[:n], self._design_log_weights(failing=False), x, self.goal.gamma)
        outcome = self._outcome(draws, draws.cov, float(len(self.settings.learning.scales)), status)
        return replace(outcome, draw_weights=draws.weights_after(0))

    def _interval(self, draws: Draws, cov: float, largest_weight: float) -> Interval:
        """Return the interval of p from weighted draws, for the regions that they know of."""
        if draws.ess < self.settings.least_ess:
            return weighted_interval(draws, self.goal.confidence, largest_weight, cov)
        return log_normal_interval(draws.p, cov, self.goal.confidence, degrees_of_freedom(draws.ess, independent=True))

    def _outcome(self, draws: Draws, cov: float, largest_weight: float, status: Status) -> Outcome:
        """Return what weighted draws say of p; no weight exceeds `largest_weight`.

        That they are few is a remark here, no warning: with a few hundred simulations it is the rule, and the interval
        knows it (12 of the 40 runs in `benchmarks/results/few_simulations.jsonl`, whose intervals all held p).
        """
        none = len(draws.f) == 0
        ended = Status.NO_HITS if status is Status.CONVERGED and none else status
        return Outcome(
            p=min(draws.p, 1.0),
            interval=self._interval(draws, cov, largest_weight),
            cov=cov,
            status=ended,
            warnings=tuple(weight_warnings(draws) if none else heavy_draw_warnings(draws)),
            remarks=() if none else tuple(describe_low_ess(draws)),
            trace=tuple(self.trace),
            no_outcome_share=no_outcome_share(draws.f, draws.log_weights),
            sample=draws.sample,
            draw_weights=draws.weights_after(sum(level.n_sim for level in self.trace) - draws.n),
        )
