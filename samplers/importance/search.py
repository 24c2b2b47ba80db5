"""Search for a proposal: its rounds of draws, its end, and the final draws that follow it.

Shared by the methods that search a proposal by iteration: `ImportanceSampling`, `CrossEntropy` and
`ImprovedCrossEntropy`. Only the final draws count, unless the run is stopped before them: then the draws of the
search are weighted as draws from the mixture of its proposals.
"""

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import numpy as np

from samplers.importance.draws import Draws, weight_warnings, weighted_cov, weighted_interval
from samplers.importance.sampling import Space, simulate_until
from samplers.method import Goal, Outcome, no_outcome_share
from samplers.problem import FloatArray, Inputs
from samplers.proposals.mixture import Mixture, ProposalDistribution, SupportsLogProb
from samplers.sample import DrawWeights
from samplers.statistics.intervals import binomial_cov
from samplers.statistics.weights import effective_sample_size
from samplers.trace import Level, Status

LEAST_SEARCH_BUDGET = 100
"""With a smaller max_sim all draws are base draws: ten rounds of ten draws are the least that can be fitted to."""
SEARCH_SHARE = 2 / 3
"""Largest share of max_sim that a search may use; a third at least is left for the final draws."""
LEAST_ROUNDS = 10
"""A round is at most max_sim / LEAST_ROUNDS, so that about seven of them fit into the share of the search."""


class Round(NamedTuple):
    """Simulated draws from one proposal."""

    base: SupportsLogProb
    """The base distribution p0 in the space of the search."""
    proposal: ProposalDistribution
    """q, in the same space."""
    u: FloatArray
    """Draws, shape (n, d)."""
    f: FloatArray
    """Their outcomes, shape (n,)."""

    @property
    def log_weights(self) -> FloatArray:
        """log(p0 / q) of the draws, shape (n,)."""
        return self.base.log_prob(self.u) - self.proposal.log_prob(self.u)


class Search(NamedTuple):
    """The rounds of a finished search."""

    rounds: Sequence[Round]
    """Those whose draws are kept; the first is from the base distribution."""
    trace: Sequence[Level]
    """A record of every round."""
    status: Status
    """CONVERGED: it reached gamma."""

    @property
    def n_sim(self) -> int:
        """Simulations made."""
        return sum(level.n_sim for level in self.trace)

    @property
    def base_draws(self) -> int:
        """Draws from the base distribution: the first round."""
        return len(self.rounds[0].f) if self.rounds else 0

    @property
    def largest_weight(self) -> float:
        """Upper bound of the weights of `pool_rounds`: all draws over base draws."""
        return sum(len(one.f) for one in self.rounds) / self.base_draws


class FinalDraws(NamedTuple):
    """The draws that p rests on, after a search."""

    draws: Draws
    trace: tuple[Level, ...]
    """Records of the search and of the final batches."""
    largest_weight: float
    """Upper bound of the weights; 1 for draws from the base distribution."""
    base_draws: int
    """Draws from the base distribution among all simulations, see `Outcome.base_draws`."""
    stopped: bool
    """Whether the run was interrupted."""
    n_first: int = 0
    """Where there are none but those of the search: draws of its first round, which other rounds may follow before the
    rest of these; otherwise 0."""

    @property
    def cov(self) -> float:
        """Coefficient of variation of p."""
        return binomial_cov(self.draws.p, self.draws.n) if self.largest_weight == 1 else self.draws.cov

    def outcome(self, goal: Goal, status: Status, warnings: Sequence[str]) -> Outcome:
        """Return the outcome of a run with these draws.

        Args:
            goal: Has the confidence of the interval.
            status: How the run ended if it was not interrupted and some draw failed.
            warnings: About the search; those about the draws are added.
        """
        ended = status if len(self.draws.f) else Status.NO_HITS
        from_search = self.n_first > 0
        early = ["Stopped before the final draws: the estimate rests on those of the search."]
        return Outcome(
            p=self.draws.p,
            interval=weighted_interval(self.draws, goal.confidence, self.largest_weight),
            cov=self.cov,
            status=Status.STOPPED if self.stopped else ended,
            warnings=(*(early if from_search else warnings), *weight_warnings(self.draws)),
            trace=self.trace,
            no_outcome_share=no_outcome_share(self.draws.f, self.draws.log_weights),
            sample=self.draws.sample,
            base_draws=self.base_draws,
            draw_weights=self._draw_weights,
        )

    @property
    def _draw_weights(self) -> tuple[DrawWeights, ...]:
        """Weight of every draw in p."""
        spent = sum(level.n_sim for level in self.trace)
        if not self.n_first:
            return self.draws.weights_after(spent - self.draws.n)
        rest = self.draws.n - self.n_first
        return tuple(
            part for each in self.draws.weights_after(0) for part in each.split((0, self.n_first), (spent - rest, rest))
        )


def plan_rounds(goal: Goal, n_round: int, max_rounds: int) -> tuple[int, int]:
    """Return the draws per round and the number of rounds that the budget allows; no rounds if it is too small."""
    if goal.budget < LEAST_SEARCH_BUDGET:
        return 0, 0
    size = min(n_round, goal.budget // LEAST_ROUNDS)
    return size, min(max_rounds, int(SEARCH_SHARE * goal.budget) // size)


def round_record(level: float, n: int, log_weights: FloatArray) -> Level:
    """Return the record of a round: the estimate of P[f <= level] by its draws.

    Args:
        level: Threshold.
        n: Draws of the round.
        log_weights: log(p0 / q) of those with f <= level, shape (k,).
    """
    return Level(
        gamma=level,
        p=len(log_weights) / n,
        estimate=float(np.exp(log_weights).sum()) / n,
        n_sim=n,
        n_points=n,
        cov=weighted_cov(n, log_weights),
        ess=effective_sample_size(log_weights),
    )


def pool_rounds(rounds: Sequence[Round], to_x: Callable[[FloatArray], FloatArray], gamma: float) -> Draws:
    """Return the draws of some rounds as if drawn from the mixture of their proposals.

    For a run that is stopped during its search. The first round being base draws, no weight exceeds N / n_0.
    Later proposals were fitted to earlier draws, so that this is not unbiased as fresh draws would be: low by 1 to
    4 %, by 9 % after two rounds of a mixture with several regions; its interval covers p in 92 to 100 % of runs.

    Args:
        rounds: One or more.
        to_x: Maps points of their space, shape (n, d), to physical space.
        gamma: Threshold of failure.
    """
    n = np.array([len(one.f) for one in rounds])
    u, f = (np.concatenate(parts) for parts in zip(*((one.u, one.f) for one in rounds), strict=True))
    mixture = Mixture(n / n.sum(), [one.proposal for one in rounds])
    return Draws.from_outcomes(f, rounds[0].base.log_prob(u) - mixture.log_prob(u), to_x(u), gamma)


def draw_after_search(
    inputs: Inputs,
    goal: Goal,
    search: Search,
    sampler: ProposalDistribution,
    base_share: float,
    limit: int,
    batch: int,
    rng: np.random.Generator,
    space: Space | None = None,
) -> Generator[FloatArray, FloatArray, FinalDraws]:
    """Simulate the final draws; without any, as the run was stopped, take those of the search.

    Args:
        inputs: Of the problem.
        goal: Threshold and target.
        search: The finished search.
        sampler: What to draw from, in `space`.
        base_share: Share of the base distribution in `sampler`, in (0, 1]; no weight exceeds 1 / base_share.
        limit: Final draws at most.
        batch: Draws per call of f.
        rng: Source of randomness.
        space: Space of the search; None for standard normal space.
    """
    limit = 0 if search.status is Status.STOPPED else limit
    draws, trace, stopped = yield from simulate_until(inputs, sampler, goal, limit, batch, rng, space)
    largest, n_base = 1 / base_share, search.base_draws + int(base_share * draws.n)
    n_first = 0
    if draws.n == 0:
        n_first = search.base_draws
        to_x = inputs.base.from_standard_normal if space is None else space.to_x
        draws, largest = pool_rounds(search.rounds, to_x, goal.gamma), search.largest_weight
    stopped = stopped or search.status is Status.STOPPED
    return FinalDraws(draws, (*search.trace, *trace), largest, n_base, stopped, n_first)


def search_warnings(search: Search, gamma: float) -> list[str]:
    """Return the warning about a search that did not reach gamma."""
    if search.status is Status.CONVERGED:
        return []
    if not search.trace:
        return [f"max_sim is under {LEAST_SEARCH_BUDGET}, too little for a search: base draws only."]
    lowest = min(level.gamma for level in search.trace)
    where = f" at f <= {lowest:.4g}," if lowest > gamma else ""
    why = {Status.BUDGET: "its share of max_sim was used up", Status.STOPPED: "it was stopped"}
    reason = why.get(search.status, "it came no closer")
    return [f"The search for a proposal ended{where} before gamma: {reason}."]
