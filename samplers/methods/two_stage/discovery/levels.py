"""Levels of the exploration: subset simulation from the base draws, for regions that wide draws are too few to hit."""

import math
from dataclasses import dataclass

import numpy as np

from samplers.mcmc.chains import Chains, Growth, independent_chains
from samplers.mcmc.descent import NextLevel, descend
from samplers.mcmc.kernels import ScaledKernel
from samplers.method import Goal, Interrupted
from samplers.methods.subset_estimate import descent_cov, level_record, multiply_levels, subset_interval
from samplers.methods.two_stage.regions import SubsetPoints
from samplers.methods.two_stage.settings import ExplorationSettings
from samplers.methods.two_stage.simulator import SimulationSteps, Simulator
from samplers.problem import FloatArray
from samplers.statistics.thresholds import next_level
from samplers.trace import Level, Status


@dataclass(frozen=True)
class ExplorationPlanner:
    """Levels whose seeds are a random part of the points below the threshold, in chains of equal length."""

    gamma: float
    """Threshold of failure."""
    n: int
    """Points per level, a few more where the chains do not divide them."""
    budget: int
    """Simulations for all levels."""
    settings: ExplorationSettings

    def plan_next(self, chains: Chains, depth: int, n_sim: int, rng: np.random.Generator) -> NextLevel | Status:
        """Return the next level, or how the descent ends: converged once `level_fraction` of the points fail."""
        points = chains.by_step()
        if depth == 0 and np.count_nonzero(points.f <= self.gamma) >= self.settings.common_failures:
            return Status.CONVERGED
        threshold = next_level(points.f, self.settings.level_fraction, self.gamma)
        if threshold == self.gamma:
            return Status.CONVERGED
        if threshold is None or depth >= self.settings.max_levels:
            return Status.STALLED
        seeds = rng.permutation(np.flatnonzero(points.f <= threshold))[: self.n // self.settings.points_per_seed]
        steps = max(1, math.ceil(self.n / len(seeds)) - 1)
        if n_sim + steps * len(seeds) > self.budget:
            return Status.BUDGET
        return NextLevel(threshold, points.select(seeds), np.full(len(seeds), steps + 1))


def descend_levels(
    simulator: Simulator,
    u: FloatArray,
    f: FloatArray,
    goal: Goal,
    n: int,
    most: int,
    rng: np.random.Generator,
    explore: ExplorationSettings,
) -> SimulationSteps[SubsetPoints]:
    """Run subset simulation from base draws u (n, d), f (n,), until a tenth of a level fails or the budget is used.

    Where failures are common among the base draws, they are the last level.

    All candidates are kept, for the regressions around the regions; there is no estimate, so no level is recorded.
    """
    kernel = ScaledKernel(
        "conditional", "unit", explore.initial_scale, explore.level_acceptance, deviations=np.ones(u.shape[1])
    )
    gamma = goal.gamma
    planner = ExplorationPlanner(gamma, n, most - simulator.n_sim, explore)
    levels, thresholds = list[Growth](), list[float]()

    def record(growth: Growth, planned: NextLevel | Status) -> None:
        levels.append(growth)
        thresholds.append(planned.threshold if isinstance(planned, NextLevel) else gamma)

    start = Growth.start(independent_chains(u, f), kernel)
    status = yield from descend(simulator.inputs, start, planner, record, rng)
    outcomes = np.concatenate([level.f_candidates for level in levels])
    simulator.n_sim += len(outcomes)
    if status is Status.STOPPED:
        raise Interrupted
    last = levels[-1].chains
    failing = last.where(last.f <= gamma)
    return SubsetPoints(
        np.unique(failing.u, axis=0),
        np.concatenate([level.candidates for level in levels]),
        outcomes,
        len(levels) - 1,
        np.unique(failing.roots),
        _upper_end([level.chains for level in levels], thresholds, goal),
    )


def _upper_end(levels: list[Chains], thresholds: list[float], goal: Goal) -> float:
    """Return the upper end of p by subset simulation."""
    trace = list[Level]()
    for chains, threshold in zip(levels, thresholds, strict=True):
        trace.append(level_record(chains, threshold, multiply_levels(trace)))
    roots = levels[-1].where(levels[-1].f <= goal.gamma).roots
    cov = max(multiply_levels(trace).cov, descent_cov(roots, trace[0].n_points))
    return subset_interval(levels[-1], goal, trace, cov)[1]
