"""Plain Monte Carlo, against which the other methods are measured."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from samplers.method import Goal, Interrupted, Outcome, Steps
from samplers.methods.base import Method
from samplers.methods.kept_draws import KeptDraws
from samplers.problem import Inputs
from samplers.sample import DrawWeights
from samplers.statistics.intervals import binomial_cov
from samplers.trace import Level, Status
from samplers.validation import check_count


@dataclass(frozen=True, kw_only=True)
class MonteCarlo(Method):
    """Share of failing points among independent draws from the base distribution.

    p = k / N with the Clopper-Pearson interval. Stops at `goal.target_cov`, looked at after every
    batch, else when the simulations are used up. Tian et al. stop where the 95 % interval reaches
    20 % of p to either side: 1.96 c.o.v. = 0.2, that is target_cov = 0.102. Stopping at a c.o.v. t
    makes the interval approximate, and p on average too high by about t^2 of itself: 1 % at t = 0.1.
    Replicates are pooled: their draws are those of one longer run. Memory does not grow with the draws: from a million
    of them on, `Estimate.curve` and `Estimate.shares` rest on some of them, evenly spaced; p rests on all.

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

    n: int = 100_000
    batch: int = 10_000

    name: ClassVar[str] = "mc"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_count("MonteCarlo", "n", self.n, 1)
        check_count("MonteCarlo", "batch", self.batch, 1)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Draw batches until the target or the end of the budget."""
        budget = self.n if goal.max_sim is None else goal.max_sim
        n, hits, met, stopped = 0, 0, False, False
        draws = KeptDraws(goal.gamma, inputs.dim)
        trace: list[Level] = []
        while n < budget and not met:
            size = min(self.batch, budget - n)
            x = inputs.base.sample(size, rng)
            try:
                f = yield x
            except Interrupted:
                if n == 0:  # the caller, who has simulated before, has the outcome
                    raise
                stopped = True
                break
            failing = draws.add(x, f)
            n, hits = n + size, hits + failing
            cov = binomial_cov(hits / n, n)
            met = goal.target_cov is not None and hits > 0 and cov <= goal.target_cov
            trace.append(
                Level(
                    gamma=goal.gamma,
                    p=failing / size,
                    estimate=hits / n,
                    n_sim=size,
                    n_points=size,
                    cov=cov,
                )
            )
            goal.on_level(trace[-1])
        outcome = Outcome.of_counts(hits, n, goal.confidence, trace, draws.no_outcome_share)
        return replace(
            outcome,
            sample=draws.to_sample(),
            status=Status.STOPPED if stopped else outcome.status,
            draw_weights=(DrawWeights.of_equal_draws(n, 0, n),),
        )
