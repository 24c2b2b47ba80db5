"""Levels of subset simulation with any kernel: how many points each has, and when the run ends.

The loop is `samplers.mcmc.descent`, the estimate from all levels `subset_estimate`.

References:
    Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
    Probabilistic Engineering Mechanics 16, 2001.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from samplers.mcmc.chains import Chains, Growth, RootedPoints, chain_lengths, draw_first_level
from samplers.mcmc.descent import NextLevel, descend
from samplers.mcmc.kernels import Kernel
from samplers.method import Goal, Steps
from samplers.methods.subset_estimate import level_record, multiply_levels, summarise, weighted_points
from samplers.problem import Inputs
from samplers.statistics.thresholds import next_level
from samplers.trace import Level, Status

LONGEST_CHAIN = 50
"""More steps than this from a handful of seeds cost calls of f and add little."""
FEWEST_SEEDS = 10
"""A level is not made smaller for the sake of the budget than this many seeds allow."""
USUAL_LEVELS = 4
"""Levels that shall fit into a small budget: down to p = p0^4, 1e-4."""


@dataclass(frozen=True, kw_only=True)
class SubsetPlanner:
    """Levels of n points whose seeds are all points below the threshold, as the estimate of the error needs them."""

    n: int
    """Points per level, N."""
    p0: float
    """Wanted conditional probability of each level."""
    max_levels: int
    """Levels after which the method gives up, level 0 included."""
    gamma: float
    """Threshold of failure."""
    budget: int
    """Simulations for the levels after level 0."""

    def plan_next(self, chains: Chains, depth: int, n_sim: int, rng: np.random.Generator) -> NextLevel | Status:
        """Return the next level, or how the run ends: converged once p0 of the present points fail."""
        left = self.budget - n_sim
        threshold = next_level(chains.f[chains.used], self.p0, self.gamma)
        if threshold == self.gamma:
            return Status.CONVERGED
        if left == 0 and chains.f.size < self.n:
            return Status.BUDGET  # too few points of level 0 to speak of ties
        if threshold is None or depth + 1 >= self.max_levels:
            return Status.STALLED
        seeds = chains.where(chains.f <= threshold)
        n_seeds = len(seeds.f)
        if left < n_seeds:
            return Status.BUDGET  # not one step for every chain
        return NextLevel(threshold, seeds, chain_lengths(self._points_of_level(n_seeds, left), n_seeds, rng))

    def _points_of_level(self, n_seeds: int, left: int) -> int:
        """Return how many points the next level shall have, its seeds included."""
        longest = max(LONGEST_CHAIN, math.ceil(1 / self.p0))
        return max(min(self.n, n_seeds + left, n_seeds * longest), n_seeds)


@dataclass(frozen=True, kw_only=True)
class SubsetLevels:
    """The settings that all kinds of subset simulation share."""

    n: int
    """Points per level, N."""
    p0: float
    """Wanted conditional probability of each level."""
    max_levels: int
    """Levels after which the method gives up."""

    def steps(
        self,
        inputs: Inputs,
        goal: Goal,
        rng: np.random.Generator,
        kernel: Kernel,
        known: RootedPoints | None = None,
    ) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more.

        Args:
            inputs: Of the problem.
            goal: Threshold and budget.
            rng: Source of randomness.
            kernel: Of the first chains.
            known: Base draws whose outcomes are known, fewer than n: level 0 begins with them.
        """
        n_known = 0 if known is None else len(known.f)
        n, gamma = self._points_per_level(goal.budget + n_known), goal.gamma
        levels, trace = list[Chains](), list[Level]()

        def record(growth: Growth, planned: NextLevel | Status) -> None:
            threshold = planned.threshold if isinstance(planned, NextLevel) else gamma
            levels.append(growth.chains)
            trace.append(level_record(growth.chains, threshold, multiply_levels(trace)))
            goal.on_level(trace[-1])

        first = yield from draw_first_level(inputs, max(min(n, goal.budget + n_known), n_known), rng, known)
        left = goal.budget - first.n_new
        planner = SubsetPlanner(n=n, p0=self.p0, max_levels=self.max_levels, gamma=gamma, budget=left)
        status = yield from descend(inputs, Growth.start(first, kernel), planner, record, rng)
        outcome = summarise(levels[-1], goal, trace, status)
        return replace(
            outcome,
            warnings=(*self._budget_warnings(n, goal.budget + n_known), *outcome.warnings),
            sample=weighted_points(inputs, levels, trace, gamma),
        )

    def _points_per_level(self, budget: int) -> int:
        """Return the points per level: fewer than n where the budget does not hold the usual levels."""
        fitting = int(budget / (1 + (USUAL_LEVELS - 1) * (1 - self.p0)))  # seeds are not simulated again
        return min(self.n, max(math.ceil(FEWEST_SEEDS / self.p0), fitting))

    def _budget_warnings(self, n: int, budget: int) -> list[str]:
        """Return the warning about a budget that is too small for n points per level."""
        if budget < n:
            return [f"max_sim leaves {budget} of the {n} simulations that level 0 needs at least: plain draws only."]
        coarse = n < self.n / 2
        return [f"max_sim leaves {budget} simulations: {n} points per level, not {self.n}."] if coarse else []
