"""What the search of the cross-entropy method has found so far."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from samplers.importance.draws import Draws, weight_warnings, weighted_cov, weighted_interval
from samplers.importance.sampling import Space
from samplers.method import Goal, Outcome, no_outcome_share
from samplers.methods.cross_entropy.blocks import Product
from samplers.problem import FloatArray
from samplers.proposals.mixture import Mixture
from samplers.statistics.intervals import binomial_cov
from samplers.statistics.weights import effective_sample_size
from samplers.trace import Level, Status


class Iterate(NamedTuple):
    """One proposal of the search and what its draws showed."""

    proposal: Product
    quantile: float
    """The rho-quantile of f under the proposal."""
    level: float
    """gamma_k: the quantile, but not less than gamma."""
    record: Level


class Batch(NamedTuple):
    """The draws of one iteration."""

    proposal: Product
    u: FloatArray
    """Shape (n, d), in the space of the search."""
    f: FloatArray
    """Shape (n,)."""


@dataclass(eq=False)
class Search:
    """The iterates of algorithm 1, and as many of their draws as an estimate needs if the run is stopped."""

    goal: Goal
    rho: float
    iterates: list[Iterate] = field(default_factory=list)
    batches: list[Batch] = field(default_factory=list)
    """The first, from the base law, and the latest."""
    status: Status = Status.STALLED

    @property
    def trace(self) -> list[Level]:
        """The records of all iterates."""
        return [iterate.record for iterate in self.iterates]

    @property
    def n_sim(self) -> int:
        """Simulations made."""
        return sum(level.n_sim for level in self.trace)

    @property
    def base_draws(self) -> int:
        """How many of them are base draws: the first batch."""
        return len(self.batches[0].f) if self.batches else 0

    @property
    def n_reached(self) -> int:
        """How many proposals have reached gamma."""
        return sum(iterate.level == self.goal.gamma for iterate in self.iterates)

    def add(self, batch: Batch, level: float, log_weights: FloatArray) -> None:
        """Note an iteration: its draws, gamma_k and log(p0 / p_theta) of those with f <= gamma_k, shape (k,)."""
        n = len(batch.f)
        record = Level(
            gamma=level,
            p=len(log_weights) / n,
            estimate=float(np.exp(log_weights).sum()) / n,
            n_sim=n,
            n_points=n,
            cov=weighted_cov(n, log_weights),
            ess=effective_sample_size(log_weights),
        )
        rank = int(np.ceil(self.rho * n)) - 1
        quantile = float(np.partition(batch.f, rank)[rank])
        self.iterates.append(Iterate(batch.proposal, quantile, level, record))
        self.batches = [*self.batches[:1], batch]
        self.goal.on_level(record)

    def ended(self, status: Status) -> "Search":
        """Return the search with its ending."""
        self.status = status
        return self

    def best(self, choice: str) -> Iterate | None:
        """Return the iterate to sample from; None before the first.

        The lowest rho-quantile, with choice "cov" not counted below gamma; the smallest c.o.v. among equals.
        """

        def rank(iterate: Iterate) -> tuple[float, float]:
            return (iterate.quantile if choice == "quantile" else iterate.level, iterate.record.cov)

        return min(self.iterates, key=rank, default=None)

    def outcome(self, space: Space) -> Outcome:
        """Return what the draws of the search say, for a run that was stopped.

        The base draws and the latest proposal's count as one sample from the mixture of the two
        laws, so that no weight exceeds the number of draws by that of base draws.
        """
        gamma, sizes = self.goal.gamma, np.array([len(batch.f) for batch in self.batches])
        mixture = Mixture(sizes / sizes.sum(), [batch.proposal for batch in self.batches])
        u = np.concatenate([batch.u for batch in self.batches])
        f = np.concatenate([batch.f for batch in self.batches])
        draws = Draws.from_outcomes(f, space.base.log_prob(u) - mixture.log_prob(u), space.to_x(u), gamma)
        plain = len(self.batches) == 1
        return Outcome(
            p=draws.p,
            interval=weighted_interval(draws, self.goal.confidence, float(sizes.sum() / sizes[0])),
            cov=binomial_cov(draws.p, draws.n) if plain else draws.cov,
            status=Status.STOPPED,
            warnings=("Stopped before the final draws: the estimate is the search's own.", *weight_warnings(draws)),
            trace=tuple(self.trace),
            no_outcome_share=no_outcome_share(draws.f, draws.log_weights),
            sample=draws.sample,
            base_draws=self.base_draws,
        )
