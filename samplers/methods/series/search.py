"""Search by terms: failures of a least over terms, in tens to thousands of dimensions.

f is a least over terms (which car is hit, ahead or behind, early or late), and each term's failures are nearly one
half-space. In standard normal space:

1. *Walks* (`walks.py`): from low base draws of every term that matters downhill along its gradient to its failures.
2. *Rounds* (`fitting.py`): for each term Gaussians in the subspace of its gradients, N(0, I)
   across it; fitted anew after every round to all draws so far, weighted by the balance heuristic.
3. *Estimate*: three final rounds, each from a proposal fitted to what came before, with exact weights
   and shares in p that were fixed beforehand: p = sum_r c_r mean(w_r 1{f <= gamma}) counts failures of any term.

Each p_r is unbiased given the past: subspaces, terms and Gaussians may be wrong and p stays right; only its c.o.v.
suffers. Where the rounds show that they are wrong, adaptive subset simulation takes over, on the order of the terms.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from samplers.importance import Draws, weight_warnings, weighted_interval
from samplers.method import Goal, Interrupted, Outcome, Steps, TermsOffer, no_outcome_share
from samplers.methods.base import RunContext, SimulationSteps
from samplers.methods.monte_carlo import MonteCarlo
from samplers.methods.series.fitting import PursuedTerm, TermHistory, mix_terms, pursue_walked, refit_terms
from samplers.methods.series.settings import DOUBTS, ROUNDS, WALKS
from samplers.methods.series.walks import (
    TermSimulator,
    answer_by_terms,
    choose_starts,
    choose_terms,
    count_walks,
    walk_downhill,
)
from samplers.methods.subset import spend_on_subset_simulation
from samplers.problem import FloatArray, Inputs, Terms
from samplers.sample import (
    DrawWeights,
    Status,
    binomial_cov,
    clopper_pearson,
    effective_number,
    effective_sample_size,
    largest_weight_share,
)

MOST_LEVELS = 6
"""Levels of a tenth to plan for at most, and where nothing is known: with fewer than needed the last are short."""
MIN_STRATUM_DRAWS = 5
"""Of strata with fewer draws the second moment stands in for the variance."""


@dataclass(frozen=True, eq=False)
class FinalRound:
    """Draws of one proposal that p rests on."""

    x: FloatArray
    """Shape (n, d)."""
    terms: Terms
    log_weights: FloatArray
    """log(phi / q), shape (n,)."""
    strata: NDArray[np.int64]
    """Shape (n,)."""
    factor: float
    """Weight of one of its draws in p, relative to other rounds."""
    first: int
    """Simulations that the run had spent before its first draw."""

    def y(self, gamma: float) -> FloatArray:
        """Weight times indicator of failure, shape (n,)."""
        return np.asarray(np.where(self.terms.f <= gamma, np.exp(self.log_weights), 0.0))

    def variance(self, gamma: float) -> float:
        """Return the variance of the mean of y, from the variances within the strata."""
        y = self.y(gamma)
        n, s1, s2 = (np.bincount(self.strata, weights=w) for w in (np.ones(len(y)), y, y * y))
        many = n >= MIN_STRATUM_DRAWS
        within = ((s2[many] - s1[many] ** 2 / n[many]) * n[many] / (n[many] - 1)).sum() + s2[~many].sum()
        return float(max(within, 0.0) + (y.max() ** 2 if len(y) else 0.0)) / len(y) ** 2


@dataclass(frozen=True, eq=False)
class CombinedRounds:
    """Final rounds as one estimate: p = sum_r c_r p_r, c_r proportional to the draws times their factor."""

    rounds: tuple[FinalRound, ...]
    gamma: float

    @cached_property
    def shares(self) -> FloatArray:
        """c_r, adding up to 1."""
        size = np.array([one.factor * len(one.log_weights) for one in self.rounds])
        return np.asarray(size / size.sum())

    @cached_property
    def means(self) -> FloatArray:
        """p_r."""
        return np.array([one.y(self.gamma).mean() for one in self.rounds])

    @cached_property
    def p(self) -> float:
        """The estimate."""
        return float(self.shares @ self.means)

    @cached_property
    def cov(self) -> float:
        """C.o.v. of p, inf where it is 0, from the larger of the variances within the strata and between the rounds."""
        p, c = self.p, self.shares
        if p == 0:
            return math.inf
        within = float(c**2 @ [one.variance(self.gamma) for one in self.rounds])
        between = DOUBTS.between_factor * float(c**2 @ (self.means - p) ** 2)
        return math.sqrt(max(within, between)) / p

    @cached_property
    def draws(self) -> Draws:
        """All draws as those from one proposal, with the same p."""
        n = sum(len(one.log_weights) for one in self.rounds)
        scaled = [
            one.log_weights + math.log(c * n / len(one.log_weights))
            for one, c in zip(self.rounds, self.shares, strict=True)
        ]
        f, x = (np.concatenate(parts) for parts in zip(*((one.terms.f, one.x) for one in self.rounds), strict=True))
        return Draws.from_outcomes(f, np.concatenate(scaled), x, self.gamma)

    @property
    def draw_weights(self) -> tuple[DrawWeights, ...]:
        """Weight of every draw in p."""
        return tuple(
            DrawWeights(first=one.first, log_weights=one.log_weights + math.log(c / len(one.log_weights)))
            for one, c in zip(self.rounds, self.shares, strict=True)
        )

    def interval(self, confidence: float, base_share: float, cov: float, ceiling: float) -> tuple[float, float]:
        """Return the log-normal interval; with t quantiles and Bernstein's bound where few draws carry p."""
        factors = self.shares / np.array([len(one.log_weights) for one in self.rounds])
        largest = float(factors.max() * sum(len(one.log_weights) for one in self.rounds)) / base_share
        return weighted_interval(self.draws, confidence, largest, cov, ceiling)

    def share_of_others(self, pursued: list[int]) -> float:
        """Return the share of p in failures whose least term was not pursued, and in points without an outcome."""
        total = other = 0.0
        for c, one in zip(self.shares, self.rounds, strict=True):
            y = c * one.y(self.gamma) / len(one.log_weights)
            total += float(y.sum())
            other += float(y[~np.isin(one.terms.least, pursued) | np.isneginf(one.terms.f)].sum())
        return other / total if total > 0 else 0.0


def doubt(combined: CombinedRounds, pursued: list[int]) -> list[str]:
    """Return the warnings about an estimate."""
    every = "failing draws of all rounds" if len(combined.rounds) > 1 else "failing draws"
    warnings = [text.replace("failing draws", every) for text in weight_warnings(combined.draws)]
    last = combined.rounds[-1].y(combined.gamma)
    ess = effective_number(last)
    if 0 < ess < DOUBTS.min_ess:
        warnings.append(
            f"Effective sample size of the last round's failing draws: {ess:.0f}; its standard error is unreliable."
        )
    failing = last[last > 0]
    if len(failing) and largest_weight_share(np.log(failing)) > DOUBTS.max_point_share:
        warnings.append(f"One draw carries more than {100 * DOUBTS.max_point_share:.0f} % of the last round.")
    other = combined.share_of_others(pursued)
    if other > DOUBTS.max_other_share:
        warnings.append(f"{100 * other:.0f} % of p comes from terms without a proposal of their own.")
    return warnings


def ordering_values(terms: Terms, gamma: float) -> FloatArray:
    """Return values (n,) that are <= gamma just where f is, and elsewhere in the order of the least term.

    Where f is no better than a flag (a collision is -1, however it happened) the least term tells near from far.
    """
    shifted = terms.lowest - terms.threshold + gamma
    above = float(np.nextafter(gamma, np.inf))
    values = np.where(terms.f <= gamma, np.minimum(shifted, gamma), np.maximum(shifted, above))
    return np.where(np.isneginf(terms.f), -np.inf, values)


def order_by_terms(steps: Steps, gamma: float) -> Steps:
    """Run steps with the least term in place of f; the outcome's points have f again.

    Their layers are left out: they are thresholds of the order, not of f.
    """
    f_of: dict[float, float] = {}

    def read(_: FloatArray, terms: Terms) -> FloatArray:
        answer = ordering_values(terms, gamma)
        f_of.update(zip(answer.tolist(), terms.f.tolist(), strict=True))
        return answer

    outcome = yield from answer_by_terms(steps, read)
    if outcome.sample is None:
        return outcome
    f = np.array([f_of.get(value, value) for value in outcome.sample.f.tolist()])
    return replace(outcome, sample=replace(outcome.sample, f=f, layers=()))


TermSearch = RunContext[TermSimulator]


@dataclass(frozen=True, eq=False)
class SearchState:
    """Draws so far, and the terms that are pursued."""

    history: TermHistory
    pursued: tuple[PursuedTerm, ...] = ()
    finals: tuple[FinalRound, ...] = ()
    base_draws: int = 0
    base_failures: int = 0
    """Base draws that fail."""
    ceiling: float = 1.0
    """Upper end of p by the base draws of the planned rounds, which no proposal has chosen. Batches that go on until a
    target is met are left out: they stop by what they found."""
    last_rate: float = 0.0
    """Effective failures for each draw of the last round."""

    @property
    def base_rate(self) -> float:
        """Share of the base draws that fail."""
        return self.base_failures / max(self.base_draws, 1)


def search_terms(inputs: Inputs, offer: TermsOffer, goal: Goal, budget: int, rng: np.random.Generator) -> Steps:
    """Estimate P[f(X) <= goal.gamma] by terms and their gradients."""
    open_ended = goal.max_sim is None and goal.target_cov is not None
    end = budget + ROUNDS.max_target_batches * ROUNDS.target_batch if open_ended else budget
    search = TermSearch(inputs, TermSimulator(inputs, offer, goal), goal, budget, end, rng)
    if budget < ROUNDS.min_budget:
        outcome = yield from MonteCarlo(n=budget, batch=budget).steps(inputs, replace(goal, max_sim=end), rng)
        return outcome.remark_first(
            f"{budget} simulations are too few for a search ({ROUNDS.min_budget}): base draws only."
        )
    state = yield from _draw_base(search)
    try:
        if state.base_rate >= ROUNDS.common_share:
            return (yield from _run_monte_carlo(search, state))
        state = yield from _walk(search, state)
        state = yield from _run_rounds(search, state)
        if _gives_up(search, state):
            return (yield from _fall_back(search, state))
    except Interrupted:
        return _estimate_early(search, state)
    return (yield from _estimate(search, state))


def _draw_base(search: TermSearch) -> SimulationSteps[SearchState]:
    """Make the base draws."""
    n = min(max(int(ROUNDS.base * search.budget), ROUNDS.min_base), ROUNDS.max_base)
    u = search.rng.standard_normal((n, search.inputs.dim))
    terms = yield from search.simulator.terms(u)
    failures = int((terms.f <= search.goal.gamma).sum())
    share = failures / n
    ceiling = clopper_pearson(failures, n, search.goal.confidence)[1]
    state = SearchState(
        TermHistory(u, terms, np.full(n, np.log(n)), (), n), base_draws=n, base_failures=failures, ceiling=ceiling
    )
    search.simulator.record(share, share, n, binomial_cov(share, n))
    return state


def _walk(search: TermSearch, state: SearchState) -> SimulationSteps[SearchState]:
    """Walk to the failures of main terms and of others; pursue those that are reached."""
    terms, simulator = state.history.terms, search.simulator
    main, others = choose_terms(terms)
    step = simulator.offer.count_gradients(1) + 1
    each, scouted = count_walks(len(main), len(others), search.budget, step)
    planned = ((main, each), (others[:scouted], WALKS.scouts))
    starts = [(j, choose_starts(terms, j, n)) for group, n in planned for j in group]
    rows = np.concatenate([part for _, part in starts] or [np.empty(0, dtype=np.int64)])
    term = np.repeat([j for j, _ in starts], [len(part) for _, part in starts]).astype(np.int64)
    chosen = replace(terms, f=terms.f[rows], values=terms.values[rows], ticks=terms.ticks[rows])
    limit = simulator.n_sim + int(WALKS.budget_share * search.budget)
    walks = yield from walk_downhill(simulator, state.history.u[rows], chosen, term, search.goal.gamma, limit)
    reached = float((walks.values <= terms.threshold).mean()) if len(walks.values) else 0.0
    simulator.record(reached, simulator.trace[-1].estimate, len(rows), math.inf)
    return replace(state, pursued=tuple(pursue_walked(walks, state.history)))


def _run_rounds(search: TermSearch, state: SearchState) -> SimulationSteps[SearchState]:
    """Draw and refit until all terms have been at the threshold twice, or the rest is for the estimate."""
    ready, known, trace = 0, len(search.simulator.trace), search.simulator.trace
    size = int(ROUNDS.size * search.budget)
    reserve = int((ROUNDS.final_share - ROUNDS.refit_share) * search.budget)
    try:
        while (
            state.pursued and ready < ROUNDS.ready_rounds and search.left - size >= ROUNDS.final_share * search.budget
        ):
            state, _ = yield from _draw_round(search, state, size)
            state = yield from _refit(search, state, reserve)
            ready = ready + 1 if all(term.ready for term in state.pursued) else 0
    except Interrupted:
        del trace[known:]  # rounds that are given up are one level
        raise
    return state


def _draw_round(
    search: TermSearch, state: SearchState, n: int, final: bool = False
) -> SimulationSteps[tuple[SearchState, FinalRound]]:
    """Draw n points from the present proposal; they join the history."""
    gamma = search.goal.gamma
    proposal = mix_terms(list(state.pursued), state.history, gamma, final)
    u, strata = proposal.draw(n, search.rng)
    first = search.simulator.n_sim
    terms = yield from search.simulator.terms(u)
    x = search.inputs.base.from_standard_normal(u)
    drawn = FinalRound(x, terms, -proposal.log_ratio(u), strata, factor=1.0, first=first)
    fails = terms.f <= gamma
    ess = effective_sample_size(drawn.log_weights[fails])
    draws = state.base_draws + int((strata == 0).sum())
    failures = state.base_failures + int(fails[strata == 0].sum())
    state = replace(
        state,
        history=state.history.add(u, terms, proposal, first),
        base_draws=draws,
        base_failures=failures,
        ceiling=clopper_pearson(failures, draws, search.goal.confidence)[1],
        last_rate=ess / n,
    )
    p = float(drawn.y(gamma).mean())
    search.simulator.record(float(fails.mean()), p, n, 1 / math.sqrt(ess) if ess else math.inf, ess)
    return state, drawn


def _refit(search: TermSearch, state: SearchState, reserve: int) -> SimulationSteps[SearchState]:
    """Fit the proposals anew, leaving `reserve` simulations."""
    pursued = yield from refit_terms(
        search.simulator, state.history, list(state.pursued), search.goal.gamma, search.budget - reserve, search.rng
    )
    return replace(state, pursued=tuple(pursued))


def _gives_up(search: TermSearch, state: SearchState) -> bool:
    """Return whether the proposals do not describe the failures, and enough is left for subset simulation.

    They do not where a draw is worth less than `fallback_rate` failures, or less than a base draw.
    """
    worthless = state.last_rate < max(DOUBTS.fallback_rate, state.base_rate)
    return worthless and search.left >= DOUBTS.min_fallback_budget


def _estimate(search: TermSearch, state: SearchState) -> Steps:
    """Make the final rounds; with a target c.o.v. end when it is met, or draw further batches until then."""
    goal = search.goal
    room, stopped = search.left - int((len(ROUNDS.final_sizes) - 1) * ROUNDS.refit_share * search.budget), False
    plan = [(int(share * room), factor) for share, factor in zip(ROUNDS.final_sizes, ROUNDS.final_weights, strict=True)]
    ceiling = state.ceiling
    while not stopped:
        number = len(state.finals)
        if number and search.meets_target(_combine(search, state).cov):
            break
        size, factor = plan[number] if number < len(plan) else (ROUNDS.target_batch, 1.0)
        last = number == len(plan) - 1
        if number >= len(plan) and (goal.target_cov is None or search.left_at_all <= 0):
            break
        try:
            if 0 < number < len(plan):
                state = yield from _refit(search, state, sum(n for n, _ in plan[number:]))
            size = search.left if last else min(size, search.left_at_all)
            state, drawn = yield from _draw_round(search, state, size, final=True)
            ceiling = state.ceiling if number < len(plan) else ceiling
            state = replace(state, finals=(*state.finals, replace(drawn, factor=factor)), ceiling=ceiling)
        except Interrupted:
            stopped = True
    return _conclude(search, state, stopped) if state.finals else _estimate_early(search, state)


def _combine(search: TermSearch, state: SearchState) -> CombinedRounds:
    return CombinedRounds(state.finals, search.goal.gamma)


def _conclude(search: TermSearch, state: SearchState, stopped: bool) -> Outcome:
    """Return the outcome of the final rounds."""
    goal, combined = search.goal, _combine(search, state)
    cov, draws = combined.cov, combined.draws
    status = Status.CONVERGED if len(draws.f) else Status.NO_HITS
    return Outcome(
        p=combined.p,
        interval=combined.interval(goal.confidence, ROUNDS.base_share, cov, state.ceiling),
        cov=cov,
        status=Status.STOPPED if stopped else status,
        warnings=tuple(doubt(combined, [one.number for one in state.pursued])),
        trace=search.simulator.close_trace(),
        no_outcome_share=no_outcome_share(draws.f, draws.log_weights),
        sample=draws.sample,
        base_draws=state.base_draws,
        draw_weights=combined.draw_weights,
    )


def _estimate_early(search: TermSearch, state: SearchState) -> Outcome:
    """Return what all draws from known proposals say, for a run that ends before its estimate."""
    history = state.history
    x = search.inputs.base.from_standard_normal(history.u)
    n = len(history.u)
    draws = Draws.from_outcomes(history.terms.f, history.log_weights + np.log(n), x, search.goal.gamma)
    return Outcome(
        p=draws.p,
        interval=weighted_interval(draws, search.goal.confidence, n / history.n_base, draws.cov, state.ceiling),
        cov=draws.cov,
        status=Status.STOPPED,
        warnings=tuple(weight_warnings(draws)),
        trace=search.simulator.close_trace(),
        no_outcome_share=no_outcome_share(draws.f, draws.log_weights),
        sample=draws.sample,
        base_draws=state.base_draws,
        draw_weights=history.draw_weights,
    )


def _run_monte_carlo(search: TermSearch, state: SearchState) -> Steps:
    """Spend the rest on base draws; those made so far decided on this and do not count."""
    left = search.left_at_all
    batch = ROUNDS.monte_carlo_batch if search.goal.target_cov is None else ROUNDS.target_batch
    method = MonteCarlo(n=left, batch=batch)
    outcome = yield from method.steps(search.inputs, replace(search.goal, max_sim=left), search.rng)
    return _after(search, state, outcome)


def _fall_back(search: TermSearch, state: SearchState) -> Steps:
    """Spend the rest on subset simulation in the order of the terms."""
    left, inputs = search.left_at_all, search.inputs
    p = float(np.exp(state.history.log_weights[state.history.failing(search.goal.gamma)]).sum())
    levels = min(math.ceil(-math.log10(min(p, 1.0))), MOST_LEVELS) if p > 0 else MOST_LEVELS
    steps = spend_on_subset_simulation(inputs, replace(search.goal, max_sim=left), levels, left, None, search.rng)
    outcome = yield from order_by_terms(steps, search.goal.gamma)
    return _after(search, state, outcome)


def _after(search: TermSearch, state: SearchState, outcome: Outcome) -> Outcome:
    """Return the outcome of another method that used the rest."""
    earlier = search.simulator.close_trace()
    spent = sum(level.n_sim for level in earlier)
    return replace(
        outcome,
        trace=(*earlier, *outcome.trace),
        base_draws=state.base_draws + outcome.base_draws,
        counts=None,
        draw_weights=tuple(replace(weights, first=weights.first + spent) for weights in outcome.draw_weights),
    )
