"""Plain Monte Carlo."""

from dataclasses import dataclass

from samplers.method import PlainDraws
from samplers.methods.base import Method


@dataclass(frozen=True, kw_only=True)
class MonteCarlo(PlainDraws, Method):
    """Share of failing points among independent draws from the base distribution.

    p = k / N with the Clopper-Pearson interval. Stops at `goal.target_cov`, looked at after every
    batch, else when the simulations are used up. Tian et al. stop where the 95 % interval reaches
    20 % of p to either side: 1.96 c.o.v. = 0.2, that is target_cov = 0.102. Stopping at a c.o.v. t
    makes the interval approximate, and p on average too high by about t^2 of itself: 1 % at t = 0.1.
    Replicates are pooled: their draws are those of one longer run. Memory does not grow with the draws: from a million
    of them on, `Estimate.curve` and `Estimate.shares` rest on the first ones; p rests on all.

    Args:
        n: Simulations where `max_sim` does not say how many.
        batch: Points per call of f.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda u: 2.0 - u[:, 0], dim=2)  # P = Phi(-2) = 0.0228
        >>> result = samplers.estimate(problem, samplers.MonteCarlo(), seed=0, max_sim=10_000)
        >>> result.interval[0] < 0.02275 < result.interval[1], result.cov < 0.07
        (True, True)
    """
