"""The flagship: find every region of failure, then estimate by a fresh sample from what was learned."""

import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from samplers.importance.draws import Draws, weight_warnings, weighted_interval
from samplers.method import Goal, Interrupted, Outcome, Steps, no_outcome_share
from samplers.methods.base import Method
from samplers.methods.two_stage import fallback
from samplers.methods.two_stage.diagnostics import check_base_draws, check_efficiency, check_regions, check_rounds
from samplers.methods.two_stage.exploration import Sizes, find_regions, first_draws
from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.noise_coordinates import marginalise_noise
from samplers.methods.two_stage.refinement import BASE_FLOOR, Refinement
from samplers.methods.two_stage.simulator import ComponentDraws, Simulator
from samplers.methods.two_stage.stratified import StratifiedSample
from samplers.problem import FloatArray, Inputs
from samplers.sample import Sample
from samplers.statistics.intervals import binomial_cov
from samplers.statistics.weights import effective_sample_size
from samplers.trace import Level, Status
from samplers.validation import check_count

MIN_EXPLORATION_BUDGET = 400
"""With less than this an exploration is not worth its draws."""
FEW = 1500
"""With less than this one of two like regions is missed in 3 to 30 % of runs, and nothing tells."""
COMMON = 0.1
"""Where this share of the base draws fails, plain Monte Carlo is as good as anything."""
ROUNDS = (0.09, 0.12, 0.14)
"""Shares of what the exploration leaves; the rest is for the estimate."""
AFRESH = 2
"""New bumps are fitted after the last rounds, this many of them, when there are failures enough."""
PLAIN_BATCH = 10_000
MOST_BATCHES = 100
"""Final batches after which a target c.o.v. is given up where max_sim does not say."""


@dataclass(frozen=True, kw_only=True)
class TwoStage(Method):
    """Explore, then estimate from a fresh sample; few simulations for any number of failure regions.

    1. *Exploration* (`exploration.py`): base draws, wide draws from N(0, s^2 I), subset simulation from the base
       draws, chains inside the region of failure from both, sorted into regions by whether the point half way
       between two of them fails.
    2. *Refinement* (`refinement.py`): each region is described by Gaussian bumps, by a plane from linear regression
       of f where it is linear, by slices of N(0, I) beyond a plane and by a shell. Three rounds of draws follow, each
       from a mixture of these whose weights minimise the estimated variance (`second_moment.py`), with lower limits
       for the base law, for tempered bumps (which bound weights where a bump is a bad description) and for each
       region. In up to 40 dimensions a classifier then thins the last mixture where it sees no failure (`gate.py`).
    3. *Estimate* (`stratified.py`): fresh draws from the last mixture, stratified by component, and nothing else:
       given the first two stages p-hat is unbiased, but for two things. Behind a classifier the weights rest on the
       shares of draws that it lets through; these are found by draws that are not simulated, and their error, some
       tenths of a per cent, is the same for all weights of a component (it is part of the c.o.v.).
       And with a target c.o.v. the draws end where they say so. (Reusing the draws of earlier rounds, as adaptive
       multiple importance sampling does, biases p by some per cent and makes its intervals too short.)

    Everything happens in standard normal space, so that wide draws stay within the support of the parameters.
    f is asked for in 35 to 60 batches. Regression of f and subset simulation apart, f is used by its sign only.

    *Noise.* f may have noise of its own that is no part of x: p is then the marginal probability. No stored outcome
    is simulated again. That f is noisy is noticed by 30 points right beside failing ones; regions are then not told
    apart, and half of the draws come from tempered bumps, which are best where failure is a matter of chance.
    Coordinates of x that the base law calls noise are left as they are (`untilted.py`).

    *Interval.* Log-normal; it widens by t quantiles where few draws carry the weight and by Bernstein's bound where
    very few do. *Warnings* (`cross_checks.py`) tell of uneven weights, of base draws that fail more often than p
    allows, of rounds that disagree, and of regions that the last draws hardly reach. What nothing tells of is a
    region that neither f announces nor any draw has hit; `Estimate.unseen` bounds its probability.

    Where a tenth of the base draws fails, or nothing is found at all, the rest is plain Monte Carlo. Where no mixture
    describes the failures (dozens of regions, hundreds of dimensions without a plane, failures that the noise alone
    decides on), the rounds show it, and what is left goes into adaptive subset simulation in all coordinates
    (`fallback.py`), with a warning.

    Args:
        n: Simulations where `max_sim` does not say how many; with a target c.o.v. final batches of a tenth of it
            are added until it is met.

    References:
        Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (defensive mixtures).
        Cappé, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes",
        Statistics and Computing 18, 2008 (mixtures adapted in rounds).
        Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
        Probabilistic Engineering Mechanics 16, 2001.
    """

    n: int = 6000

    name: ClassVar[str] = "two-stage"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_count("TwoStage", "n", self.n, MIN_EXPLORATION_BUDGET)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Explore, refine, estimate."""
        budget = self.n if goal.max_sim is None else goal.max_sim
        run = _Run(inputs, goal, budget, rng)
        if budget < MIN_EXPLORATION_BUDGET:
            outcome = yield from run.plain()
            least = MIN_EXPLORATION_BUDGET
            warning = f"max_sim leaves {budget} simulations, too few for an exploration ({least}): base draws only."
            return replace(outcome, warnings=(warning, *outcome.warnings))
        try:
            refinement = yield from run.explored()
            if refinement is None:
                return (yield from run.plain())
            proposal = yield from run.refined(refinement)
            if proposal is None:
                return (yield from run.descended(refinement.levels))
        except Interrupted:
            return run.interrupted()
        outcome = yield from run.estimated(refinement, proposal)
        if budget < FEW:
            few = f"An exploration within {budget:,} simulations may miss regions without notice ({FEW:,} are enough)."
            outcome = replace(outcome, warnings=(*outcome.warnings, few))
        return outcome


class _Run:
    """One run of the method: what has been simulated so far, and its record."""

    def __init__(self, inputs: Inputs, goal: Goal, budget: int, rng: np.random.Generator) -> None:
        self._goal = goal
        self._budget = budget
        goes_on = goal.max_sim is None and goal.target_cov is not None
        self._end = budget + MOST_BATCHES * (budget // 10) if goes_on else budget
        self._rng = rng
        self._all = inputs
        tilted = marginalise_noise(inputs, rng)
        self._untilted = tilted is not inputs
        self._simulator = Simulator(tilted)
        self._history = MultipleImportanceSample(tilted.dim)
        self._base_u = np.empty((0, tilted.dim))
        self._base_f = np.empty(0)
        self._set_aside = self._base_u, self._base_f
        self._n_base = 0
        self._rounds: list[Draws] = []
        self._trace: list[Level] = []

    @property
    def _left(self) -> int:
        return self._budget - self._simulator.n_sim

    def explored(self) -> Generator[FloatArray, FloatArray, Refinement | None]:
        """Run the exploration; None where plain Monte Carlo shall follow."""
        gamma, sizes = self._goal.gamma, Sizes.within(self._budget)
        first = yield from first_draws(self._simulator, sizes, self._rng)
        self._base_u, self._base_f = first.u[: sizes.base], first.f[: sizes.base]
        self._n_base = sizes.base
        share = float((self._base_f <= gamma).mean())
        self._note(share, share, len(first.f), binomial_cov(share, sizes.base))
        if share >= COMMON:
            # These draws have decided that plain Monte Carlo follows: counted in p they would bias it.
            self._set_aside = self._base_u, self._base_f
            self._base_u, self._base_f = self._base_u[:0], self._base_f[:0]
            return None
        self._history.add(first, gamma)
        found = yield from find_regions(self._simulator, first, gamma, sizes, self._rng)
        chains = sum(len(region.f) for region in found.regions)
        fails = sum(int((region.f <= gamma).sum()) for region in found.regions)
        self._note(fails / max(chains, 1), share, chains, math.inf)
        return Refinement(found, self._history, gamma, self._rng) if found.regions else None

    def refined(self, refinement: Refinement) -> Generator[FloatArray, FloatArray, MixtureProposal | None]:
        """Draw and learn in rounds; return the mixture for the estimate, None if it would not serve."""
        room = self._left
        proposal = refinement.proposal()
        for number, share in enumerate(ROUNDS, start=1):
            n = int(share * room)
            if n > 0:
                batch = yield from self._drawn(proposal, n)
                self._rounds.append(
                    Draws.from_outcomes(batch.f, proposal.log_weights(batch.u), batch.u, self._goal.gamma)
                )
                refinement.learn(proposal, batch, afresh=number > len(ROUNDS) - AFRESH)
                log_w = self._history.log_weights
                ess = effective_sample_size(log_w)
                self._note_draws(batch, float(np.exp(log_w).sum()), 1 / math.sqrt(ess) if ess else math.inf, ess)
            proposal = refinement.proposal(last=number == len(ROUNDS))
        return proposal if self._serves(refinement, proposal) else None

    def _serves(self, refinement: Refinement, proposal: MixtureProposal) -> bool:
        """Tell whether to go on with a proposal; where f is noisy by itself there is nothing better."""
        if self._end - self._simulator.n_sim < fallback.MIN_FALLBACK_BUDGET or not self._rounds:
            return True
        if refinement.noisy:
            return not self._untilted or fallback.meets_failures(self._rounds[-1])
        return fallback.describes_failures(self._rounds[-1], refinement.typical_weights(proposal))

    def descended(self, levels: int) -> Steps:
        """Spend the rest on subset simulation in all coordinates, which needs no proposal."""
        left = self._end - self._simulator.n_sim
        outcome = yield from fallback.run_subset_simulation(self._all, self._goal, levels, left, self._rng)
        trace, base_draws = self._closed_trace() + outcome.trace, self._n_base + outcome.base_draws
        before = self.interrupted()
        on_its_way = outcome.status is Status.STOPPED and outcome.p == 0  # no estimate, then
        whole = before if on_its_way else fallback.reconcile(outcome, before)
        return replace(whole, trace=trace, base_draws=base_draws)

    def estimated(self, refinement: Refinement, proposal: MixtureProposal) -> Steps:
        """Draw from the last mixture until the budget is used or the target is met."""
        goal, inputs, stopped = self._goal, self._simulator.inputs, False
        strata = StratifiedSample.empty(len(proposal.weights), inputs.dim, refinement.typical_weights(proposal))
        size = self._left if goal.target_cov is None else max(self._budget // 10, 100)
        while self._simulator.n_sim < self._end:
            try:
                batch = yield from self._drawn(proposal, min(size, self._end - self._simulator.n_sim))
            except Interrupted:
                stopped = True
                break
            strata = strata.add(batch, proposal, inputs, goal.gamma)
            self._note_draws(batch, strata.p, strata.cov, strata.draws.ess)
            if goal.target_cov is not None and strata.cov <= goal.target_cov:
                break
        if strata.draws.n == 0:
            outcome = self.interrupted()
            return outcome if stopped else replace(outcome, status=Status.BUDGET)
        outcome = self._outcome(strata.draws, strata.cov, 1 / BASE_FLOOR)
        base_hits = int((self._base_f <= goal.gamma).sum())
        checks = (
            *check_base_draws(strata.p, base_hits, len(self._base_f)),
            *check_rounds(strata, self._rounds),
            *check_regions(strata),
            *(() if refinement.noisy else check_efficiency(strata)),
        )
        sample = strata.sample(proposal, self._base_f, self._base_u, goal.gamma)
        status = Status.STOPPED if stopped else outcome.status
        return replace(outcome, warnings=(*outcome.warnings, *checks), sample=sample, status=status)

    def interrupted(self) -> Outcome:
        """Return what all draws from known components say."""
        draws = self._history.draws(self._simulator.inputs, self._goal.gamma)
        outcome = self._outcome(draws, draws.cov, draws.n / max(len(self._base_f), 1))
        return replace(outcome, sample=draws.sample, status=Status.STOPPED)

    def plain(self) -> Steps:
        """Spend the rest on base draws; those made so far count too."""
        goal, inputs, stopped = self._goal, self._simulator.inputs, False
        size = PLAIN_BATCH if goal.target_cov is None else max(self._budget // 10, 100)
        while self._simulator.n_sim < self._end:
            u = self._rng.standard_normal((min(self._end - self._simulator.n_sim, size), inputs.dim))
            try:
                f = yield from self._simulator.evaluate(u)
            except Interrupted:
                stopped = True
                break
            self._base_f, self._base_u = np.concatenate([self._base_f, f]), np.concatenate([self._base_u, u])
            share = float((self._base_f <= goal.gamma).mean())
            self._note(float((f <= goal.gamma).mean()), share, len(f), binomial_cov(share, len(self._base_f)))
            if goal.target_cov is not None and binomial_cov(share, len(self._base_f)) <= goal.target_cov:
                break
        if len(self._base_f) == 0:  # stopped at once: better those than nothing
            self._base_u, self._base_f = self._set_aside
        fails = self._base_f <= goal.gamma
        without = no_outcome_share(self._base_f[fails])
        outcome = Outcome.of_counts(int(fails.sum()), len(fails), goal.confidence, self._closed_trace(), without)
        sample = Sample.of_equal_draws(self._base_f, inputs.base.from_standard_normal(self._base_u[fails]))
        # A share of draws, but only in runs that came to this: it must not be pooled with others.
        outcome = replace(outcome, sample=sample, counts=None)
        return replace(outcome, status=Status.STOPPED) if stopped else outcome

    def _outcome(self, draws: Draws, cov: float, largest_weight: float) -> Outcome:
        return Outcome(
            p=draws.p,
            interval=weighted_interval(draws, self._goal.confidence, largest_weight, cov),
            cov=cov,
            status=Status.CONVERGED if len(draws.f) else Status.NO_HITS,
            warnings=tuple(weight_warnings(draws)),
            trace=self._closed_trace(),
            no_outcome_share=no_outcome_share(draws.f, draws.log_weights),
            base_draws=self._n_base,
        )

    def _drawn(self, proposal: MixtureProposal, n: int) -> Generator[FloatArray, FloatArray, ComponentDraws]:
        u, counts = proposal.draw(n, self._rng)
        f = yield from self._simulator.evaluate(u)
        self._n_base += int(counts[0])  # of a proposal the first component is the base law
        return ComponentDraws(proposal.components, counts, u, f)

    def _note_draws(self, batch: ComponentDraws, estimate: float, cov: float, ess: float) -> None:
        self._note(float((batch.f <= self._goal.gamma).mean()), estimate, len(batch.f), cov, ess)

    def _note(self, p: float, estimate: float, n: int, cov: float, ess: float | None = None) -> None:
        """Record what the last n_sim simulations were for: all that no earlier record has."""
        n_sim = self._simulator.n_sim - sum(level.n_sim for level in self._trace)
        level = Level(gamma=self._goal.gamma, p=p, estimate=estimate, n_sim=n_sim, n_points=n, cov=cov, ess=ess)
        self._trace.append(level)
        self._goal.on_level(level)

    def _closed_trace(self) -> tuple[Level, ...]:
        """Return the record; simulations of a part that was interrupted are a level of their own."""
        loose = self._simulator.n_sim - sum(level.n_sim for level in self._trace)
        if loose:
            self._note(math.nan, math.nan, loose, math.inf)
        return tuple(self._trace)
