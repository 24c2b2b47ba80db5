"""Series: failures of a least over terms, by walks along their gradients."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from samplers.importance import Draws, weighted_interval
from samplers.method import Goal, Interrupted, Outcome, PlainDraws, Steps, offer_of, request_terms
from samplers.methods.base import Method, SearchRun, SimulationSteps
from samplers.methods.series import ROUNDS, WALKS
from samplers.methods.series.fitting import PursuedTerm, TermHistory, mix_terms, pursue_walked, refit_terms
from samplers.methods.series.walks import TermSimulator, plan_walks, walk_downhill
from samplers.methods.subset import spend_on_subset_simulation
from samplers.problem import FloatArray, Inputs, check_settings
from samplers.proposals import IsotropicNormal, draw_components, draw_counts, log_ratios, mixture_log_ratio
from samplers.sample import DrawWeights, Status, binomial_cov, clopper_pearson


@dataclass(frozen=True, kw_only=True)
class Series(Method):
    """Search by terms: series systems in tens to thousands of dimensions whose terms have gradients.

    f is the least of terms (which car is hit, ahead or behind), and each term's failures are nearly a half-space. In
    standard normal space:

    1. *Walks* lead from low base draws of every term that matters down its gradient to its failures.
    2. *Rounds.* Term j is drawn from Gaussians q_j in the subspace V_j of its gradients and N(0, I) across it, fitted
       after every round to all draws so far. The weight of a draw is exact:

           phi / q = 1 / (a_0 + (1 - a_0) sum_j pi_j q_j(V_j' u) / phi_r(V_j' u))

    3. *Estimate.* p = sum_r c_r mean(w_r 1{f <= gamma}) over three final rounds whose shares c_r are fixed beforehand.

    Each p_r is unbiased given what came before it: wrong terms or gradients cost accuracy, not truth. Failures of terms
    without a proposal of their own that carry more than 5 % of p give a warning. If a tenth of the base draws fails,
    plain Monte Carlo takes over, and if no proposal describes the failures, adaptive subset simulation in the order
    of the terms; a remark says so. Gradients count as simulations at what they cost. Coordinates of noise are searched
    like the rest of x.

    Args:
        n: Simulations where `max_sim` does not say how many; with a target c.o.v. final batches are added until it is
            met.

    Example:
        Two half-spaces in 100 dimensions, p = 1 - (1 - Phi(-3.5))^2 = 4.65e-4:

        >>> import numpy as np, samplers
        >>> terms, gradient = (lambda x: 3.5 - x[:, :2]), (lambda x, term: -np.eye(100)[term])
        >>> problem = samplers.FunctionProblem(dim=100, terms=terms, gradient=gradient)
        >>> result = samplers.estimate(problem, samplers.Series(n=2000), seed=0)
        >>> result.n_sim, f"{result.p:.0e}", result.cov < 0.05
        (2000, '5e-04', True)

    References:
        Cappé, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes", Statistics
        and Computing 18, 2008 (mixtures adapted in rounds).
        Uribe, Papaioannou, Marzouk and Straub, "Cross-entropy-based importance sampling with failure-informed dimension
        reduction for rare event simulation", SIAM/ASA Journal on Uncertainty Quantification 9, 2021 (subspaces of
        gradients).
    """

    n: int = 6000

    name: ClassVar[str] = "series"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=ROUNDS.min_budget)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Walk, draw and refit, estimate; a ValueError if the problem offers no terms with gradients."""
        offer = offer_of(inputs)
        if offer is None or offer.gradient_cost is None:
            raise ValueError(
                "Series needs `terms` and `gradient` of the problem (see `samplers.Problem`); 'auto' does not."
            )
        budget = self.n if goal.max_sim is None else goal.max_sim
        open_ended = goal.max_sim is None and goal.target_cov is not None
        end = budget + 100 * ROUNDS.target_batch if open_ended else budget
        return SeriesRun(inputs, TermSimulator(inputs, offer, goal), goal, budget, end, rng).steps()


@dataclass(frozen=True, eq=False)
class FinalRound:
    """Draws of one proposal that p rests on."""

    draws: Draws  # weighted as draws of their own proposal
    variance: float  # of their p
    other: float  # their p in failures whose least term was not pursued, and in points without an outcome
    first: int  # simulations that the run had spent before the first of them
    factor: float = 1.0  # weight of one of them in p, relative to other rounds


def stratified_variance(y: FloatArray, counts: NDArray[np.int64]) -> float:
    """Return the variance of the mean of y (n,), of which the first counts_0 are from one stratum, and so on.

    Of fewer than 5 draws the second moment stands in for it. The square of the largest y is added for draws as heavy.
    """
    parts = np.split(y, np.cumsum(counts)[:-1])
    within = sum(len(part) * part.var(ddof=1) if len(part) >= 5 else (part**2).sum() for part in parts)
    return float(within + y.max(initial=0.0) ** 2) / len(y) ** 2


class CombinedRounds(NamedTuple):
    """Final rounds as one estimate: p = sum_r c_r p_r, c_r proportional to the draws times their factor."""

    shares: FloatArray  # c_r
    parts: list[Draws]  # of the rounds, weighted so that all of them are as draws from one proposal, with the same p
    draws: Draws  # all of these
    cov: float  # of p, inf where it is 0, from the larger of the variances within the rounds and between them


def combine_rounds(rounds: tuple[FinalRound, ...]) -> CombinedRounds:
    """Return the estimate of some final rounds, at least one."""
    n, size = np.array([one.draws.n for one in rounds]), np.array([one.draws.n * one.factor for one in rounds])
    c = size / size.sum()
    parts = []
    for one, by in zip(rounds, np.log(c * n.sum() / n), strict=True):
        failing, safe = one.draws.log_weights + by, one.draws.log_weights_safe + by
        parts.append(replace(one.draws, log_weights=failing, log_weights_safe=safe))
    draws = reduce(Draws.join, parts)
    within = float(c**2 @ [one.variance for one in rounds])
    between = ROUNDS.between_factor * float(c**2 @ (np.array([one.draws.p for one in rounds]) - draws.p) ** 2)
    return CombinedRounds(c, parts, draws, math.sqrt(max(within, between)) / draws.p if draws.p > 0 else math.inf)


def order_by_terms(steps: Steps, gamma: float) -> Steps:
    """Run steps with the least term in place of f; the outcome's points have f again.

    Values are <= gamma just where f is. If f is no better than a flag (a collision is -1, however it happened) the
    least term tells near from far. Layers are left out: they are thresholds of the order, not of f.
    """
    f_of: dict[float, float] = {}
    above = float(np.nextafter(gamma, np.inf))
    send, answer = cast(Callable[[Any], FloatArray], steps.send), cast(Any, None)
    while True:
        try:
            x = send(answer)
        except StopIteration as end:
            outcome: Outcome = end.value
            break
        send = steps.send
        try:
            terms = yield from request_terms(x)
        except Interrupted as interruption:
            send, answer = steps.throw, interruption
            continue
        shifted = terms.lowest - terms.threshold + gamma
        answer = np.where(terms.f <= gamma, np.minimum(shifted, gamma), np.maximum(shifted, above))
        answer[np.isneginf(terms.f)] = -np.inf
        f_of.update(zip(answer.tolist(), terms.f.tolist(), strict=True))
    if outcome.sample is None:
        return outcome
    f = np.array([f_of.get(value, value) for value in outcome.sample.f.tolist()])
    return replace(outcome, sample=replace(outcome.sample, f=f, layers=()))


@dataclass(eq=False)
class SeriesRun(SearchRun):
    """A run with its draws so far, and the terms that are pursued."""

    simulator: TermSimulator
    history: TermHistory = field(init=False)
    n_base: int = 0  # base draws before the walks, and ...
    base_failures: int = 0  # ... those of them that fail
    base_draws: int = 0  # in all
    pursued: tuple[PursuedTerm, ...] = ()
    finals: tuple[FinalRound, ...] = ()
    last_rate: float = 0.0  # effective failures for each draw of the last round

    def steps(self) -> Steps:
        """Walk, draw and refit, estimate."""
        budget = self.budget
        if budget < ROUNDS.min_budget:
            goal = replace(self.goal, max_sim=self.end)
            outcome = yield from PlainDraws(n=budget, batch=budget).steps(self.inputs, goal, self.rng)
            about = f"{budget} simulations are too few for a search ({ROUNDS.min_budget}): base draws only."
            return outcome.remark_first(about)
        yield from self._draw_base()
        try:
            base_rate = self.base_failures / self.n_base
            if base_rate >= 0.1:  # plain Monte Carlo is as good as anything; those made so far decided on it
                left, batch = self.left_at_all, 10_000 if self.goal.target_cov is None else ROUNDS.target_batch
                goal = replace(self.goal, max_sim=left)
                plain = PlainDraws(n=left, batch=batch).steps(self.inputs, goal, self.rng)
                return (yield from self._leave_rest(plain))
            yield from self._walk()
            # draw and refit until the failures of all terms are known, or the rest is for the estimate
            size, kept = int(ROUNDS.size * budget), ROUNDS.final_share * budget
            while not all(term.ready for term in self.pursued) and self.left - size >= kept:
                yield from self._draw_round(size)
                yield from self._refit(int((ROUNDS.final_share - ROUNDS.refit_share) * budget))
            worthless = self.last_rate < max(ROUNDS.fallback_rate, base_rate)
            if worthless and self.left >= 300:  # with fewer subset simulation is not worth it
                return (yield from self._leave_rest(self._descend()))
        except Interrupted:
            return self._estimate_early()
        return (yield from self._estimate())

    def _draw_base(self) -> SimulationSteps[None]:
        """Make the base draws."""
        n, dim = min(max(int(ROUNDS.size * self.budget), 100), 2000), self.inputs.dim
        u = self.rng.standard_normal((n, dim))
        terms, components = (yield from self.simulator.terms(u)), (IsotropicNormal(dim),)
        self.history = TermHistory(u, terms, np.full(n, np.log(n)), components, np.array([float(n)]), ((0, n),))
        self.n_base = self.base_draws = n
        self.base_failures = int(self.history.failing(self.goal.gamma).sum())
        share = self.base_failures / n
        self.simulator.record(share, share, n, binomial_cov(share, n))

    def _walk(self) -> SimulationSteps[None]:
        """Walk to the failures of main terms and of others; pursue those that are reached."""
        terms, simulator = self.history.terms, self.simulator
        term, rows = plan_walks(terms, self.budget, simulator.offer.count_gradients(1) + 1)
        limit = simulator.n_sim + int(WALKS.budget_share * self.budget)
        chosen = replace(terms, f=terms.f[rows], values=terms.values[rows], ticks=terms.ticks[rows])
        walks = yield from walk_downhill(simulator, self.history.u[rows], chosen, term, self.goal.gamma, limit)
        reached = float((walks.fallen >= 1).mean()) if len(rows) else 0.0
        simulator.record(reached, simulator.trace[-1].estimate, len(rows), math.inf)
        self.pursued = tuple(pursue_walked(walks))

    def _draw_round(self, n: int, final: bool = False) -> SimulationSteps[FinalRound]:
        """Draw n points from the present proposal; they join the history."""
        gamma, simulator, first = self.goal.gamma, self.simulator, self.simulator.n_sim
        components, shares = mix_terms(self.pursued, self.history, gamma, final)
        counts = draw_counts(shares, n, self.rng)
        u = draw_components(components, counts, self.rng)
        terms = yield from simulator.terms(u)
        log_weights = -mixture_log_ratio(log_ratios(components, u), shares)
        draws = Draws.from_outcomes(terms.f, log_weights, self.inputs.base.from_standard_normal(u), gamma)
        lost = ~np.isin(terms.least[draws.fails], [one.number for one in self.pursued]) | np.isneginf(draws.f)
        other = float(np.exp(draws.log_weights[lost]).sum()) / n
        y, ess = np.zeros(n), draws.ess
        y[draws.fails] = np.exp(draws.log_weights)
        self.history = self.history.add(u, terms, components, counts.astype(np.float64), first)
        simulator.record(len(draws.f) / n, draws.p, n, 1 / math.sqrt(ess) if ess else math.inf, ess)
        self.base_draws, self.last_rate = self.base_draws + int(counts[0]), ess / n
        return FinalRound(draws, stratified_variance(y, counts), other, first)

    def _refit(self, reserve: int) -> SimulationSteps[None]:
        """Fit the proposals anew, leaving `reserve` simulations."""
        limit, gamma = self.budget - reserve, self.goal.gamma
        self.pursued = yield from refit_terms(self.simulator, self.history, self.pursued, gamma, limit, self.rng)

    def _estimate(self) -> Steps:
        """Make the final rounds; with a target c.o.v. end when it is met, or draw further batches until then."""
        stopped, number, planned = False, 0, len(ROUNDS.final_sizes)
        room = self.left - int((planned - 1) * ROUNDS.refit_share * self.budget)
        sizes = [int(share * room) for share in ROUNDS.final_sizes[:-1]]
        last = int(ROUNDS.final_sizes[-1] * room)
        while number < planned or (self.goal.target_cov is not None and self.left_at_all > 0):
            if number and self.meets_target(combine_rounds(self.finals).cov):
                break
            try:
                if 0 < number < planned:
                    yield from self._refit(sum(sizes[number:]) + last)
                further = self.left if number == planned - 1 else ROUNDS.target_batch
                size = sizes[number] if number < planned - 1 else further
                drawn = yield from self._draw_round(min(size, self.left_at_all), final=True)
            except Interrupted:
                stopped = True
                break
            self.finals += (replace(drawn, factor=ROUNDS.final_weights[min(number, planned - 1)]),)
            number += 1
        return self._conclude(stopped) if self.finals else self._estimate_early()

    def _conclude(self, stopped: bool) -> Outcome:
        """Return the outcome of the final rounds."""
        rounds, confidence = self.finals, self.goal.confidence
        c, parts, draws, cov = combine_rounds(rounds)
        status = Status.STOPPED if stopped else Status.CONVERGED
        largest = float((c * draws.n / [part.n for part in parts]).max()) / ROUNDS.base_share
        outcome = draws.outcome(self.goal, status, self.simulator.close_trace(), largest, self.base_draws)
        ceiling = clopper_pearson(self.base_failures, self.n_base, confidence)[1]  # no proposal has chosen these draws
        other = float(c @ [one.other for one in rounds]) / max(draws.p, np.finfo(np.float64).tiny)
        about = [f"{100 * other:.0f} % of p comes from terms without a proposal of their own."] * (other > 0.05)
        weights = [part.weights_after(one.first, draws.n) for part, one in zip(parts, rounds, strict=True)]
        return replace(
            outcome,
            cov=cov,
            interval=weighted_interval(draws, confidence, largest, cov, ceiling),
            warnings=(*outcome.warnings, *about),
            draw_weights=sum(weights, ()),
        )

    def _estimate_early(self) -> Outcome:
        """Return what all draws from known proposals say, for a run that ends before its estimate."""
        history, largest = self.history, len(self.history.u) / self.n_base
        x = self.inputs.base.from_standard_normal(history.u)
        draws = Draws.from_outcomes(history.terms.f, history.log_weights + math.log(len(x)), x, self.goal.gamma)
        outcome = draws.outcome(self.goal, Status.STOPPED, self.simulator.close_trace(), largest, self.base_draws)
        weights = DrawWeights(first=0, log_weights=history.log_weights)
        return replace(outcome, draw_weights=weights.split(*history.batches))

    def _descend(self) -> Steps:
        """Run subset simulation in the order of the terms, with six levels if nothing is known."""
        left, gamma = self.left_at_all, self.goal.gamma
        p = min(float(np.exp(self.history.log_weights[self.history.failing(gamma)]).sum()), 1.0)
        levels = min(math.ceil(-math.log10(p)), 6) if p > 0 else 6
        goal = replace(self.goal, max_sim=left)
        return order_by_terms(spend_on_subset_simulation(self.inputs, goal, levels, left, None, self.rng), gamma)

    def _leave_rest(self, steps: Steps) -> Steps:
        """Leave the rest to another method; return its outcome as that of the whole run."""
        outcome = yield from steps
        earlier = self.simulator.close_trace()
        spent = sum(level.n_sim for level in earlier)
        return replace(
            outcome,
            trace=(*earlier, *outcome.trace),
            base_draws=self.base_draws + outcome.base_draws,
            counts=None,
            draw_weights=tuple(replace(weights, first=weights.first + spent) for weights in outcome.draw_weights),
        )
