"""Rounds of a search by terms: terms pursued from the ends of walks, proposals refitted, final rounds combined."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from samplers.importance import Draws, weight_warnings, weighted_interval
from samplers.methods.two_stage.settings import DOUBTS, LAW, ROUNDS, WALKS
from samplers.methods.two_stage.simulator import SimulationSteps
from samplers.methods.two_stage.terms.fitting import (
    NearPoints,
    PursuedTerm,
    TermHistory,
    TermProposal,
    choose_guards,
    find_axes,
    first_law,
    fit_law,
    near_points,
    temper_weights,
)
from samplers.methods.two_stage.terms.walks import Directions, TermSimulator, Walks, describe_half_spaces
from samplers.problem import FloatArray, Terms
from samplers.sample import DrawWeights
from samplers.statistics import effective_number, largest_weight_share, normalise_weights


def pursue_walked(walks: Walks, history: TermHistory) -> list[PursuedTerm]:
    """Return the terms that walks came near, with proposals around their ends; those that hardly fail are left out."""
    found, tails = list[PursuedTerm](), list[float]()
    for term in np.unique(np.concatenate([walks.term, walks.failing_terms])):
        directions, ends = walks.directions.of(term), _ends(walks, history, int(term))
        if len(ends) and len(directions.term):
            found.append(start_term(int(term), directions, ends))
            arrived = walks.distance[(walks.term == term) & (walks.values <= history.terms.threshold)]
            arrived = arrived[np.isfinite(arrived)]
            tails.append(float(ndtr(-np.median(arrived))) if len(arrived) else math.nan)
    least = WALKS.negligible * max((tail for tail in tails if tail > 0), default=0.0)
    return [one for one, tail in zip(found, tails, strict=True) if not tail < least]


def start_term(number: int, directions: Directions, ends: FloatArray) -> PursuedTerm:
    """Return a term with a proposal around ends (m, d), from its gradients."""
    weights = np.ones(len(directions.term))
    law = first_law(find_axes(directions.values, weights), ends, choose_guards(directions))
    return PursuedTerm(number, directions, weights, ends, law)


def _ends(walks: Walks, history: TermHistory, term: int) -> FloatArray:
    """Return the ends of a term's walks: those that fail, else the lower half if one came half way."""
    mine = (walks.term == term) & ~(walks.distance > WALKS.max_distance)
    failing = mine & (walks.values <= history.terms.threshold)
    on_the_way = walks.failures[walks.failing_terms == term]
    ends = np.concatenate([walks.u[failing], on_the_way])[: LAW.max_ends]
    if len(ends) or not mine.any():
        return ends
    values, threshold = walks.values[mine], history.terms.threshold
    half_way = 0.5 * (float(np.median(walks.start_values[mine])) + threshold)
    lower = values <= np.median(values)
    return walks.u[mine][lower] if values.min() <= half_way else ends


def mix_terms(pursued: list[PursuedTerm], history: TermHistory, gamma: float, final: bool = False) -> TermProposal:
    """Return the mixture over the terms.

    With all of them at the threshold pi_j is proportional to sqrt(sum_j W^2), the sum over failures that the term is
    the least of, with tempered weights, and at least `min_term_share`; until then those that are not come first. In
    the `final` rounds a term that has not been reached waits no longer.
    """
    k = len(pursued)
    if final or all(one.ready for one in pursued):
        failing = history.failing(gamma)
        w, least = temper_weights(history.log_weights[failing], ROUNDS.share_ess), history.terms.least[failing]
        size = np.array([np.sqrt((w[least == one.number] ** 2).sum()) for one in pursued])
        shares = size / size.sum() if size.sum() > 0 else np.full(k, 1 / k)
        shares = np.maximum(shares, min(ROUNDS.min_term_share, 0.7 / k))
    else:
        shares = np.array([ROUNDS.waiting_share if one.ready else 1.0 for one in pursued])
    return TermProposal(history.u.shape[1], ROUNDS.base_share, tuple(one.law for one in pursued), shares / shares.sum())


def refit_terms(
    simulator: TermSimulator,
    history: TermHistory,
    pursued: list[PursuedTerm],
    gamma: float,
    limit: int,
    rng: np.random.Generator,
) -> SimulationSteps[list[PursuedTerm]]:
    """Return the terms with proposals fitted to all draws, after a few more gradients of each at likely points.

    Terms that failures showed and nobody pursued join them.
    """
    known = {one.number for one in pursued}
    new = [int(j) for j in np.unique(history.terms.least[history.failing(gamma)]) if j not in known]
    numbers = [one.number for one in pursued] + new
    near = [near_points(history, j, gamma) for j in numbers]
    each = max(min(ROUNDS.gradients, ROUNDS.max_gradients // max(len(numbers), 1)), 1)
    chosen = [_draw_rows(points.rows[points.likely], history.log_weights, each, rng) for points in near]
    while chosen and simulator.n_sim + simulator.offer.count_gradients(sum(map(len, chosen))) > limit:
        chosen = [rows[: len(rows) // 2] for rows in chosen]  # count_gradients(0) is 0
    rows, term = np.concatenate(chosen), np.repeat(numbers, [len(part) for part in chosen])
    slopes = yield from simulator.gradients(history.u[rows], term, history.terms.ticks[rows, term])
    excess = history.terms.values[rows, term] - history.terms.threshold
    found = describe_half_spaces(term, history.u[rows], slopes, excess)
    result = []
    for number, points in zip(numbers, near, strict=True):
        directions = found.of(number)
        old = next((one for one in pursued if one.number == number), None)
        if old is not None:
            result.append(_refit_term(old, history, directions, points, rng))
        elif len(directions.term):
            ends = history.u[points.rows[points.likely][: LAW.max_ends]]
            result.append(start_term(number, directions, ends))
    return result


def _refit_term(
    term: PursuedTerm, history: TermHistory, directions: Directions, points: NearPoints, rng: np.random.Generator
) -> PursuedTerm:
    """Return a term with further gradients, fitted to some points of the history."""
    later = float(term.direction_weights.max()) * ROUNDS.later_weight
    weights = np.concatenate([term.direction_weights, np.full(len(directions.term), later)])
    directions = term.directions.join(directions)
    axes = find_axes(directions.values, weights)
    guards = choose_guards(directions)
    rows, likely, ready = points
    law = fit_law(axes, history.u[rows], history.log_weights[rows], term.ends, guards, rng, likely)
    return replace(term, directions=directions, direction_weights=weights, law=law, ready=term.ready or ready)


def _draw_rows(rows: NDArray[np.int64], log_weights: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return at most n different ones of some rows, drawn by weight."""
    if len(rows) <= n:
        return rows
    weights = normalise_weights(log_weights[rows])
    possible = min(n, int(np.count_nonzero(weights)))
    return np.asarray(rng.choice(rows, possible, replace=False, p=weights))


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

    def cov(self, between_factor: float) -> float:
        """Return the c.o.v. of p; inf where it is 0.

        The variance is the larger of that within the strata and of `between_factor` sum c_r^2 (p_r - p)^2.
        """
        p, c = self.p, self.shares
        if p == 0:
            return math.inf
        within = float(c**2 @ [one.variance(self.gamma) for one in self.rounds])
        between = between_factor * float(c**2 @ (self.means - p) ** 2)
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
