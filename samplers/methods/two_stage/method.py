"""TwoStage: find every failure region, then estimate from a sample of mixtures made for them."""

import math
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import ClassVar

import numpy as np

from samplers.importance import Draws, weighted_interval
from samplers.mcmc import RootedPoints
from samplers.method import Goal, Interrupted, KeptDraws, Outcome, Steps
from samplers.methods.base import (
    ComponentDraws,
    Method,
    SearchRun,
    SimulationSteps,
    Simulator,
    marginalise_noise,
)
from samplers.methods.subset import FEWEST_LEVELS, spend_on_subset_simulation
from samplers.methods.two_stage.exploration import Sizes, draw_isotropic, find_regions, find_slopes
from samplers.methods.two_stage.mixture import MixtureProposal
from samplers.methods.two_stage.refinement import (
    RefinementState,
    build_proposal,
    least_described,
    refine_once,
    start_refinement,
    typical_weights,
)
from samplers.methods.two_stage.regions import ExplorationResult, Region, is_noisy, sampling_interval
from samplers.methods.two_stage.settings import BUDGET, EXPLORATION, FALLBACK, PROPOSAL
from samplers.methods.two_stage.stratified import (
    MultipleImportanceSample,
    StratifiedSample,
    check_base_draws,
    check_regions,
    check_rounds,
    describe_discovery,
)
from samplers.problem import Inputs, check_settings
from samplers.sample import Interval, Status, add_unseen, binomial_cov, effective_sample_size


@dataclass(frozen=True, kw_only=True)
class TwoStage(Method):
    """Explore, then estimate from draws that had no part in it; few simulations for any number of failure regions.

    1. *Exploration* (`exploration.py`, `regions.py`): base draws; wide draws from N(0, s^2 I); subset simulation from
       the base draws and, in the same batches, lines of descent, points that walk downhill each alone; chains inside
       the failure region from all of these. Two failing points are of one region if the point half way between them
       fails.
    2. *Refinement* (`refinement.py`): each region is described by Gaussians, by a hyperplane from linear regression of
       f (if f is linear there), by a corner of several where f is the greatest of linear functions, and by a radius.
       Three rounds of draws follow, each from a mixture of these, and up to two more while the draws of some region
       have very uneven weights. The weights of the mixture minimise the estimated variance (`mixture.py`), with lower
       limits for the base distribution, for tempered Gaussians (which bound weights where a Gaussian is a bad
       description) and for each region.
    3. *Estimate* (`stratified.py`): fresh draws from the last mixture, stratified by component, together with those of
       the rounds from the third on, each weighted as a draw of its own mixture.

    p-hat is unbiased, as the estimate from each mixture is given what came before it, with two exceptions. Whether
    another method takes over after the third round or later depends on draws that count. With a target c.o.v., the
    draws decide themselves when they end, which costs a bias of the order of its square (`docs/two_stage.md`).

    All stages work in standard normal space, so that wide draws stay within the support of the parameters. A run
    yields 45 to 90 batches, half of them steps of the levels and the lines of descent. Regression of f, subset
    simulation and lines of descent use its values, everything else only its sign.

    *Noise.* f may have noise of its own that is no part of x: p is then the marginal probability. No stored outcome
    is simulated again. A noisy f is recognised by points right beside failing ones, where the chains end and beside
    the failures that weigh most after the first round. Regions are then not separated, and half of the draws come from
    tempered Gaussians. Coordinates of x that the base distribution calls noise are not searched (`methods/base.py`).

    *Interval* (`regions.py`). Log-normal, with t quantiles where few draws carry the weight and Bernstein's
    bound where very few do. The upper limit is at least Hall's, which knows the skewness of the weights, and holds the
    share M of p in regions that were not found:

        upper limit = 97.5 % point of  p-hat exp(s Z) / (1 - M),    Z ~ N(0, 1),   M ~ Beta(1/10, nu)
        nu = 2 (distinct base draws whose line or path failed + max(ESS, hits / 4) of the wide draws) / (1 + regions)

    Independent searches all led to known regions; a region of share M would be missed by one with probability 1 - M,
    and the more regions were met, the more are to be expected. The 97.5 % point of M is 0.24 for nu = 4, 0.04 for 25,
    0.005 for 200. The c.o.v. is that of the sampling alone.

    *Warnings* (`stratified.py`): uneven weights, base draws that fail more often than p
    allows, rounds that contradict the estimate and regions that the last draws hardly reach. A region that neither f
    announces nor any draw has hit gives no warning; `Estimate.unseen` bounds it. A remark says where the interval is
    mostly M.

    *Other methods take over*, with a remark, where a tenth of the base draws fails, or no failure is found (plain Monte
    Carlo), and if no mixture describes the failures (adaptive subset simulation in all coordinates): dozens of
    regions in many dimensions without a direction that matters, before the first round; after a round, where its draws
    are worth too little.

    Args:
        n: Simulations where `max_sim` does not say how many; with a target c.o.v. final batches of a tenth of it
            are added until it is met.

    Example:
        A half-space in 100 dimensions, p = Phi(-3.5) = 2.33e-4:

        >>> import samplers
        >>> from samplers.limit_states import half_space
        >>> result = samplers.estimate(half_space(100).problem, samplers.TwoStage(n=2000), seed=0)
        >>> result.n_sim, f"{result.p:.1e}", result.cov < 0.05
        (2000, '2.3e-04', True)

    References:
        Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (defensive mixtures).
        Cappé, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes",
        Statistics and Computing 18, 2008 (mixtures adapted in rounds).
        Hall, "On the removal of skewness by transformation", Journal of the Royal Statistical Society B 54, 1992.
        Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
        Probabilistic Engineering Mechanics 16, 2001.
    """

    n: int = 6000

    name: ClassVar[str] = "two-stage"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=BUDGET.least)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Explore, refine, estimate."""
        budget = self.n if goal.max_sim is None else goal.max_sim
        open_ended = goal.max_sim is None and goal.target_cov is not None
        end = budget + MOST_BATCHES * (budget // TARGET_BATCHES) if open_ended else budget
        simulator = Simulator(marginalise_noise(inputs, rng), goal)  # noise that is part of x is left to chance
        return TwoStageRun(inputs, simulator, goal, budget, end, rng).steps()


TARGET_BATCHES, MOST_BATCHES = 10, 100
"""With a target c.o.v. the budget over the first is a batch of the estimate; the second is the most of them."""
LEAST_FALLBACK = 300
"""Simulations under which subset simulation is not worth it."""


@dataclass(eq=False)
class TwoStageRun(SearchRun):
    """A run with its draws so far, what is known of the regions, and the proposal for the next draws."""

    refinement: RefinementState = field(init=False)
    proposal: MixtureProposal = field(init=False)
    base_draws: int = 0
    """Base draws in all: of a proposal those of its first component."""
    rounds: tuple[Draws, ...] = ()
    """Draws of the rounds, each weighted as draws of its own proposal."""
    counted: tuple[tuple[StratifiedSample, int], ...] = ()
    """Those of the rounds that count in p, and the simulations before them."""

    def __post_init__(self) -> None:
        """Begin without draws."""
        dim = self.simulator.inputs.dim
        self.history = MultipleImportanceSample.empty(dim)  # all draws from known components
        self.base_u, self.base_f = np.empty((0, dim)), np.empty(0)  # base draws of the exploration
        self.last_u = np.empty((0, dim))  # failing draws of the last round

    @property
    def base_share(self) -> float:
        """Share of the base draws with f <= gamma."""
        return float((self.base_f <= self.goal.gamma).mean())

    def steps(self) -> Steps:
        """Explore, refine, estimate."""
        if self.budget < BUDGET.least:
            about = f"max_sim leaves {self.budget} simulations, too few for an exploration ({BUDGET.least})"
            return (yield from self._run_monte_carlo()).remark_first(f"{about}: base draws only.")
        try:
            yield from self._draw_first()
            if self.base_share >= BUDGET.common_share:
                return (yield from self._run_monte_carlo(counted=False))
            exploration = yield from self._explore()
            if not exploration.regions:
                return (yield from self._run_monte_carlo())
            if exploration.is_shell and self.left_at_all >= LEAST_FALLBACK:
                return (yield from self._fall_back(exploration.levels))
            self.refinement = start_refinement(exploration, self.goal.gamma, self.rng)
            self.proposal = build_proposal(self.refinement, self.history)
            room, number, final = self.left, 0, False
            while not final:
                number += 1
                final = yield from self._refine(number, room)
                if self._gives_up(number, final=final):
                    return (yield from self._fall_back(exploration.levels))
        except Interrupted:
            if not self.history.batches:  # nothing is known yet
                raise
            return self._estimate_early()
        outcome = yield from self._estimate()
        if self.budget >= BUDGET.sufficient:
            return outcome
        about = f"A search of {self.budget:,} simulations misses one of two equal regions in up to 30 % of runs"
        return outcome.remark_first(f"{about}; {BUDGET.sufficient:,} are recommended.")

    def _draw_first(self) -> SimulationSteps[None]:
        """Make the base draws and the wide draws of the exploration."""
        sizes = Sizes.within(self.budget)
        first = yield from draw_isotropic(self.simulator, ((1.0, sizes.base), *sizes.wide), self.rng)
        self.history = self.history.add(first, self.goal.gamma)
        self.base_u, self.base_f, self.base_draws = first.u[: sizes.base], first.f[: sizes.base], sizes.base
        self.simulator.record(self.base_share, self.base_share, len(first.f), binomial_cov(self.base_share, sizes.base))

    def _explore(self) -> SimulationSteps[ExplorationResult]:
        """Find the failure regions, starting from the first draws; there are none if nothing fails."""
        gamma, first = self.goal.gamma, self.history.batches[0]
        exploration = yield from find_regions(self.simulator, first, self.goal, Sizes.within(self.budget), self.rng)
        slopes = yield from find_slopes(self.simulator, exploration, gamma, self.left, self.rng)
        n = sum(len(region.f) for region in exploration.regions)
        fails = sum(int((region.f <= gamma).sum()) for region in exploration.regions)
        self.simulator.record(fails / max(n, 1), self.base_share, n, math.inf)
        return exploration._replace(slopes=slopes)

    def _refine(self, number: int, room: int) -> SimulationSteps[bool]:
        """Make one round of refinement, and the proposal that follows from it; return whether that is the last one."""
        shares = (*PROPOSAL.round_shares, *PROPOSAL.further_shares)
        n = int(shares[number - 1] * room)
        if n > 0:
            yield from self._draw_round(n)
        if number == 1 and n > 0 and not self.refinement.exploration.noisy:
            yield from self._look_for_noise()
        described = 1.0
        if self.rounds:
            described = least_described(self.refinement, self.last_u, self.rounds[-1].log_weights)
        enough = number >= len(PROPOSAL.round_shares) and described >= PROPOSAL.described
        final = number == len(shares) or enough
        self.proposal = build_proposal(self.refinement, self.history, final=final)
        return final

    def _draw_round(self, n: int) -> SimulationSteps[None]:
        """Draw n points from the proposal and learn from them."""
        proposal, gamma, inputs = self.proposal, self.goal.gamma, self.simulator.inputs
        batch = yield from self._draw(n)
        # The proposals of the first two rounds may not describe the failures; base draws that fail do not count in p.
        common = np.count_nonzero(self.base_f <= gamma) >= EXPLORATION.common_failures
        if len(self.rounds) >= 2 - int(common):
            empty = StratifiedSample.empty(len(proposal.weights), inputs.dim, np.empty(0))
            self.counted += ((empty.add(batch, proposal, inputs, gamma), batch.first),)
        self.rounds += (Draws.from_outcomes(batch.f, proposal.log_weights(batch.u), batch.u, gamma),)
        self.history = self.history.add(batch._replace(x=None), gamma)
        self.refinement = refine_once(self.refinement, self.history, proposal, batch, self.rng)
        self.last_u = batch.u[batch.f <= gamma]
        ess = effective_sample_size(self.history.log_weights)
        p = float(np.exp(self.history.log_weights).sum())
        self._record_draws(batch, p, 1 / math.sqrt(ess) if ess else math.inf, ess)

    def _look_for_noise(self) -> SimulationSteps[None]:
        """Look for noise beside the failures that weigh most; with noise, begin anew with all regions as one.

        Noise matters where failures are likely, near the origin; chains may be deep inside the failure region.
        """
        heaviest = np.argsort(-self.history.log_weights, kind="stable")[:20]
        if len(heaviest) < 20:
            return
        if (yield from is_noisy(self.simulator, self.history.u[heaviest], self.goal.gamma, self.rng)):
            known = self.refinement.exploration
            whole = Region(*(np.concatenate(parts) for parts in zip(*known.regions, strict=True)))
            discovery = known.discovery._replace(regions=1)
            found = ExplorationResult([whole], noisy=True, levels=known.levels, discovery=discovery)
            self.refinement = start_refinement(found, self.goal.gamma, self.rng)

    def _gives_up(self, number: int, *, final: bool) -> bool:
        """Return whether subset simulation does better with the rest, after a round of draws; `final`: after the last.

        It does if the draws meet too few failures, or if the proposal is far from most of the regions found.
        """
        refinement = self.refinement
        if self.left_at_all < LEAST_FALLBACK or not self.rounds:
            return False
        if refinement.exploration.noisy and not (final and self.simulator.inputs is not self.inputs):
            return False  # a tempered mixture meets few failures but does not miss any: nothing else is better
        last, early = self.rounds[-1], FALLBACK.early_rates
        late = FALLBACK.late_rate / max(refinement.exploration.levels, FEWEST_LEVELS)
        rate = early[number - 1] if number <= len(early) else late
        # One heavy draw leaves a round few effective failures; all rounds together may have many.
        worth = max(last.ess, effective_sample_size(self.history.log_weights))
        # Draws within the span of slopes leave few places out: the weights met are about as uneven as all of them.
        if worth < (0.25 if refinement.within is not None else 1.0) * rate * last.n:
            return True
        # Ends of lines in a ring are no typical failures.
        described = refinement.exploration.noisy or refinement.within is not None
        if not final or described or last.ess >= PROPOSAL.good_rate * last.n:
            return False
        typical = typical_weights(refinement, self.proposal, self.history)
        return float(np.median(typical)) > FALLBACK.max_typical * last.p

    def _fall_back(self, levels: int) -> Steps:
        """Spend the rest on subset simulation in all coordinates, which needs no proposal."""
        known: RootedPoints | None = RootedPoints(self.base_u, self.base_f, np.arange(len(self.base_f)))
        if self.simulator.inputs is not self.inputs:  # the base draws lack the coordinates of noise
            known = None
        trace, before = self.simulator.close_trace(), self._estimate_early()
        steps = spend_on_subset_simulation(self.inputs, self.goal, levels, self.left_at_all, known, self.rng)
        whole = outcome = yield from steps
        if outcome.status is Status.STOPPED and outcome.p == 0:  # no estimate, then
            whole = before
        elif before.interval[0] > outcome.p:  # wide draws also find regions that f does not announce: it holds both
            (low, high), (other_low, other_high) = before.interval, outcome.interval
            missed = "Subset simulation, which took over, missed failure regions found before"
            whole = replace(
                before,
                interval=(min(low, other_low), max(high, other_high)),
                status=outcome.status,
                warnings=(*before.warnings, *outcome.warnings, f"{missed}; it gives {outcome.p:.1e}."),
                remarks=(*before.remarks, *outcome.remarks),
            )
        drawn = self.base_draws + outcome.base_draws
        return replace(whole, trace=trace + outcome.trace, base_draws=drawn)

    def _estimate(self) -> Steps:
        """Draw from the last proposal until the budget is used or the target is met.

        p rests on these draws and on those of the rounds that count, each weighted as a draw of its own proposal.
        """
        goal, inputs, proposal, stopped = self.goal, self.simulator.inputs, self.proposal, False
        typical = typical_weights(self.refinement, proposal, self.history)
        whole = sample = StratifiedSample.empty(len(proposal.weights), inputs.dim, typical)
        size = self.left if goal.target_cov is None else self._target_batch
        while self.left_at_all > 0:
            try:
                batch = yield from self._draw(min(size, self.left_at_all))
            except Interrupted:
                stopped = True
                break
            sample = sample.add(batch, proposal, inputs, goal.gamma)
            whole = reduce(StratifiedSample.join, (each for each, _ in self.counted), sample)
            self._record_draws(batch, whole.p, whole.cov, whole.draws.ess)
            if self.meets_target(whole.cov):
                break
        if sample.draws.n == 0:
            early = self._estimate_early()
            return early if stopped else replace(early, status=Status.BUDGET)
        outcome = self._conclude(sample, whole)
        return replace(outcome, status=Status.STOPPED) if stopped else outcome

    def _conclude(self, sample: StratifiedSample, whole: StratifiedSample) -> Outcome:
        """Return what the draws of the last proposal, and all that count, say."""
        discovery, confidence, gamma = self.refinement.exploration.discovery, self.goal.confidence, self.goal.gamma
        low, high = sampling_interval(whole.draws, whole.cov, confidence, whole.largest_weight, discovery)
        raised = add_unseen(whole.p, high, discovery.lineages, confidence)
        outcome = self._outcome(whole.draws, whole.cov, (low, raised))
        points = sample.to_sample(self.proposal, self.base_f, self.base_u, gamma, whole.draws)
        parts = (*self.counted, (sample, self.simulator.n_sim - sample.draws.n))
        hits = int((self.base_f <= gamma).sum())
        doubts = (*check_base_draws(whole.p, hits, len(self.base_f)), *check_rounds(sample, self.rounds))
        return replace(
            outcome,
            warnings=(*outcome.warnings, *doubts, *check_regions(whole)),
            remarks=(*outcome.remarks, *describe_discovery(whole.p, high, raised, discovery, confidence)),
            sample=replace(points, lineages=discovery.lineages),
            draw_weights=tuple(w for part, first in parts for w in part.draws.weights_after(first, whole.draws.n)),
        )

    def _estimate_early(self) -> Outcome:
        """Return what all draws from known components say, for a run that ends before its estimate."""
        u, f, log_weights = self.history.all_draws()
        x = self.simulator.inputs.base.from_standard_normal(u)
        draws = Draws.from_outcomes(f, log_weights + math.log(len(f)), x, self.goal.gamma)
        largest_weight = draws.n / max(len(self.base_f), 1)
        interval = weighted_interval(draws, self.goal.confidence, largest_weight, draws.cov)
        outcome = self._outcome(draws, draws.cov, interval)
        parts = [(batch.first, len(batch.f)) for batch in self.history.batches]
        weights = tuple(part for each in draws.weights_after(0) for part in each.split(*parts))
        return replace(outcome, draw_weights=weights, status=Status.STOPPED)

    def _run_monte_carlo(self, *, counted: bool = True) -> Steps:
        """Spend the rest on base draws."""
        goal, simulator, first, stopped = self.goal, self.simulator, self.simulator.n_sim, False
        size, base = 10_000 if goal.target_cov is None else self._target_batch, simulator.inputs.base
        draws, explored = KeptDraws(goal.gamma, self.inputs.dim), base.from_standard_normal(self.base_u)
        if counted:
            draws.add(explored, self.base_f)
        while self.left_at_all > 0:
            u = self.rng.standard_normal((min(self.left_at_all, size), simulator.inputs.dim))
            x = base.from_standard_normal(u)
            try:
                f = yield from simulator.simulate(x)
            except Interrupted:
                stopped = True
                break
            draws.add(x, f)
            hits, n = draws.counts
            simulator.record(float((f <= goal.gamma).mean()), hits / n, len(f), binomial_cov(hits / n, n))
            if self.meets_target(binomial_cov(hits / n, n)):
                break
        if draws.counts[1] == 0:
            draws.add(explored, self.base_f)
        n_new = simulator.n_sim - first
        n_before = draws.counts[1] - n_new  # base draws of the exploration, its first simulations
        outcome = draws.outcome(goal, simulator.close_trace())
        parts = [(start, n) for start, n in ((0, n_before), (first, n_new)) if n]
        # A share of draws, but only in runs that came to this: it must not be pooled with others.
        outcome = replace(outcome, counts=None, draw_weights=outcome.draw_weights[0].split(*parts))
        return replace(outcome, status=Status.STOPPED) if stopped else outcome

    def _draw(self, n: int) -> SimulationSteps[ComponentDraws]:
        """Make n > 0 draws of the proposal; those from its first component, the base distribution, are counted."""
        u, counts = self.proposal.draw(n, self.rng)
        x, first = self.simulator.inputs.base.from_standard_normal(u), self.simulator.n_sim
        f = yield from self.simulator.simulate(x)
        self.base_draws += int(counts[0])
        return ComponentDraws(self.proposal.components, counts, u, f, first, x)

    @property
    def _target_batch(self) -> int:
        """Draws after which a target c.o.v. is looked at."""
        return max(self.budget // TARGET_BATCHES, 100)

    def _record_draws(self, batch: ComponentDraws, estimate: float, cov: float, ess: float) -> None:
        """Add draws of a proposal to the trace."""
        self.simulator.record(float((batch.f <= self.goal.gamma).mean()), estimate, len(batch.f), cov, ess)

    def _outcome(self, draws: Draws, cov: float, interval: Interval) -> Outcome:
        """Return what weighted draws say of p."""
        outcome = draws.outcome(self.goal, Status.CONVERGED, self.simulator.close_trace(), 1.0, self.base_draws)
        return replace(outcome, cov=cov, interval=interval)
