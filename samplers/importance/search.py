"""What searches for a proposal share: the draws they made, and an estimate from these alone."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from samplers.importance.draws import Draws, weighted_cov
from samplers.problem import FloatArray, Inputs, StandardNormal
from samplers.proposals.mixture import Mixture, ProposalDistribution
from samplers.statistics.weights import effective_sample_size
from samplers.trace import Level, Status

LEAST_SEARCH_BUDGET = 100
"""With less than this a search is not worth its draws."""
SEARCH_SHARE = 2 / 3
"""Largest share of max_sim that a search may use."""


class Round(NamedTuple):
    """Simulated draws from one proposal."""

    law: ProposalDistribution
    """The proposal, in standard normal space."""
    u: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Shape (n,)."""

    @property
    def log_weights(self) -> FloatArray:
        """log(p0 / q) of the draws, shape (n,)."""
        return StandardNormal(self.u.shape[1]).log_prob(self.u) - self.law.log_prob(self.u)


class Search(NamedTuple):
    """What a search did and how it ended."""

    rounds: Sequence[Round]
    trace: Sequence[Level]
    status: Status
    """CONVERGED: it came down to gamma."""

    @property
    def n_sim(self) -> int:
        """Simulations made."""
        return sum(level.n_sim for level in self.trace)

    @property
    def base_draws(self) -> int:
        """How many of them are base draws: the first round."""
        return len(self.rounds[0].f) if self.rounds else 0


def round_record(found: Round, level: float) -> Level:
    """Return the record of a round: what its draws say about P[f <= level]."""
    inside = found.f <= level
    log_weights = found.log_weights[inside]
    return Level(
        gamma=level,
        p=float(inside.mean()),
        estimate=float(np.exp(log_weights).sum()) / len(inside),
        n_sim=len(inside),
        n_points=len(inside),
        cov=weighted_cov(len(inside), log_weights),
        ess=effective_sample_size(log_weights),
    )


def pool_rounds(rounds: Sequence[Round], inputs: Inputs, gamma: float) -> Draws:
    """Return the draws of all rounds as if from the mixture of their proposals.

    For a run that is stopped during its search. The first round being base draws, no weight exceeds N / n_0.
    Later proposals were fitted to earlier draws, so that this is not unbiased as fresh draws would be: low by 1 to
    4 %, by 9 % after two rounds of a mixture with several regions, its interval covers p in 92 to 100 % of runs.
    """
    n = np.array([len(found.f) for found in rounds])
    u, f = (np.concatenate(parts) for parts in zip(*((found.u, found.f) for found in rounds), strict=True))
    mixture = Mixture(n / n.sum(), [found.law for found in rounds])
    log_weights = StandardNormal(inputs.dim).log_prob(u) - mixture.log_prob(u)
    return Draws.from_outcomes(f, log_weights, inputs.base.from_standard_normal(u), gamma)


def search_ended(status: Status) -> list[str]:
    """Return the warning about a search that did not reach gamma."""
    why = {
        Status.BUDGET: "max_sim was used up",
        Status.STALLED: "it came no closer",
        Status.STOPPED: "it was stopped",
    }
    return [f"The search for a proposal ended before gamma: {why[status]}."] if status in why else []
