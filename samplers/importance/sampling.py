"""Importance sampling with fresh draws from a fixed proposal.

References:
    Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (defensive mixtures).
    Maurer and Pontil, "Empirical Bernstein bounds and sample-variance penalization", COLT 2009.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np

from samplers.importance.draws import Draws
from samplers.method import Goal, Interrupted
from samplers.problem import FloatArray, Inputs
from samplers.proposals.gaussian import Gaussian
from samplers.proposals.mixture import Mixture, ProposalDistribution
from samplers.trace import Level

MOST_FINAL_BATCHES = 100
"""Batches of final draws after which a target c.o.v. is given up where max_sim does not say."""


@dataclass(frozen=True, eq=False)
class Space:
    """The space of a proposal, and the base distribution there."""

    base: ProposalDistribution
    """p0."""
    to_x: Callable[[FloatArray], FloatArray]
    """Maps points of this space, shape (n, d), to physical space."""

    @classmethod
    def standard_normal(cls, inputs: Inputs) -> "Space":
        """Return standard normal space of some inputs."""
        return cls(Gaussian.standard(inputs.dim), inputs.base.from_standard_normal)

    @classmethod
    def physical(cls, base: ProposalDistribution) -> "Space":
        """Return physical space, where `base` is the distribution of x."""
        return cls(base, np.asarray)


def simulate_draws(
    inputs: Inputs,
    sampler: ProposalDistribution,
    gamma: float,
    n: int,
    rng: np.random.Generator,
    space: Space | None = None,
) -> Generator[FloatArray, FloatArray, Draws]:
    """Simulate n draws from `sampler`, a distribution in `space` (None: standard normal space), in one batch."""
    space = space or Space.standard_normal(inputs)
    u = sampler.sample(n, rng)
    x = space.to_x(u)
    f = yield x
    return Draws.from_outcomes(f, space.base.log_prob(u) - sampler.log_prob(u), x, gamma)


def simulate_until(
    inputs: Inputs,
    sampler: ProposalDistribution,
    goal: Goal,
    limit: int,
    batch: int,
    rng: np.random.Generator,
    space: Space | None = None,
) -> Generator[FloatArray, FloatArray, tuple[Draws, list[Level], bool]]:
    """Simulate batches until `limit` draws are made or goal.target_cov is met.

    Returns the draws, a record of every batch and whether the run was interrupted.
    """
    draws = Draws(0, np.empty(0), np.empty(0))
    trace: list[Level] = []
    while draws.n < limit:
        try:
            new = yield from simulate_draws(inputs, sampler, goal.gamma, min(batch, limit - draws.n), rng, space)
        except Interrupted:
            return draws, trace, True
        draws = draws.join(new)
        trace.append(
            Level(
                gamma=goal.gamma,
                p=len(new.f) / new.n,
                estimate=draws.p,
                n_sim=new.n,
                n_points=new.n,
                cov=draws.cov,
                ess=draws.ess,
            )
        )
        goal.on_level(trace[-1])
        if goal.target_cov is not None and draws.cov <= goal.target_cov:
            break
    return draws, trace, False


def defensive_mixture(
    base: ProposalDistribution,
    wide: ProposalDistribution,
    proposal: ProposalDistribution,
    base_share: float,
    wide_share: float,
) -> Mixture:
    """Return base_share of the base distribution + wide_share (may be 0) of a widened proposal + the rest proposal.

    Its density is at least base_share of the base, so that no weight exceeds 1 / base_share.
    """
    if wide_share == 0:
        return Mixture(np.array([base_share, 1 - base_share]), [base, proposal])
    return Mixture(np.array([base_share, wide_share, 1 - (base_share + wide_share)]), [base, wide, proposal])


def count_final_draws(goal: Goal, spent: int, n_final: int) -> int:
    """Return how many final draws may be made after a search, in batches of n_final."""
    if goal.max_sim is not None:
        return goal.max_sim - spent
    return n_final * (1 if goal.target_cov is None else MOST_FINAL_BATCHES)
