"""Surrogate: kriging learns where f fails from few simulations; a third of them or more make the estimate."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from samplers.method import Goal, Steps
from samplers.methods.base import Method
from samplers.methods.noise_coordinates import marginalise_noise
from samplers.methods.surrogate.run import SurrogateRun
from samplers.methods.surrogate.settings import DEFAULT_SURROGATE_SETTINGS
from samplers.methods.two_stage.method import run_two_stage
from samplers.problem import Inputs
from samplers.validation import check_count


@dataclass(frozen=True, kw_only=True)
class Surrogate(Method):
    """Kriging as a guide and importance sampling on the simulator: for 100 to 1,500 simulations in few dimensions.

    1. *Learning* (`learning.py`, `kriging.py`): a first design of Latin hypercubes of N(0, s^2 I), s = 1 to 3, then
       batches where phi sqrt(P[fail] P[safe]) is large, P by kriging; three in ten points are drawn where the surrogate
       would see doubt if its standard deviations were four times as large. It takes two thirds of the budget at most,
       and ends earlier where the rest is forecast to give a c.o.v. of 2 %.
    2. *Estimate* (`pool.py`, `estimate.py`): fresh draws from 70 % q ~ phi sqrt(P[fail]), 15 % the same with these
       larger standard deviations, 10 % base distribution, 5 % wide distributions, weighted by phi over the density of
       this mixture, and nothing else. The surrogate only says where to simulate, and learns from the first half of the
       draws before the second is made. Given the learning p-hat is unbiased; its c.o.v. includes the error of the
       density's constant, which is a mean over a pool of 20,000 draws that are not simulated.

    *Interval.* Log-normal with t quantiles, Bernstein's bound where under 10 effective draws failed. The upper end also
    holds what no draw can have met (`two_stage/discovery/unseen.py`, a batch of learning with failures as a lineage).
    With a few hundred simulations that is a large part of it.

    *Noise.* Coordinates that the base distribution calls noise are drawn, not learned; kriging takes what they do to f,
    and noise that is no part of x, as a nugget.

    *Other methods take over*, with a remark: in more than 20 dimensions `TwoStage`, where learning meets no failure
    and below 60 simulations plain Monte Carlo; without one where a tenth of the first base draws fails.

    Where Dubourg, Sudret and Deheeger and this implementation differ: they draw from P[fail] phi by Markov chains, we
    choose from weighted draws of a mixture, which gives independent draws; they have no base and wide draws, so that
    failures that the surrogate denies have unbounded weights; f is taken as capped, floored and noisy (`kriging.py`).

    Args:
        n: Simulations where `max_sim` does not say how many.

    References:
        Dubourg, Sudret and Deheeger, "Metamodel-based importance sampling for structural reliability analysis",
        Probabilistic Engineering Mechanics 33, 2013.
        Echard, Gayton and Lemaire, "AK-MCS: an active learning reliability method combining kriging and Monte Carlo
        simulation", Structural Safety 33, 2011 (what to learn from).

    Example:
        Two regions of failure, p = 2 Phi(-3.5) = 4.65e-4:

        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda u: 3.5 - np.abs(u[:, 0]), dim=2)
        >>> result = samplers.estimate(problem, samplers.Surrogate(), seed=0, max_sim=150)
        >>> result.n_sim, result.interval[0] < 4.65e-4 < result.interval[1], result.cov < 0.2
        (150, True, True)
    """

    n: int = 1000

    name: ClassVar[str] = "surrogate"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_count("Surrogate", "n", self.n, DEFAULT_SURROGATE_SETTINGS.least_budget)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Learn, then estimate."""
        settings, budget = DEFAULT_SURROGATE_SETTINGS, self.n if goal.max_sim is None else goal.max_sim
        searched = marginalise_noise(inputs, rng)
        if searched.dim > settings.most_dims:
            about = f"Kriging serves up to {settings.most_dims} dimensions, not {searched.dim:,}: two-stage takes over."
            return (yield from run_two_stage(inputs, goal, budget, rng)).remark_first(about)
        run = SurrogateRun(searched, goal, budget, settings, rng)
        if budget < settings.least_budget:
            about = f"max_sim leaves {budget} simulations, too few to learn from ({settings.least_budget}): "
            return (yield from run.draw_base()).remark_first(about + "base draws only.")
        return (yield from run.steps())
