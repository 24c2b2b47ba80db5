"""Levels of subset simulation with any kernel, and the estimate from all of them.

References:
    Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
    Probabilistic Engineering Mechanics 16, 2001.
    Lee and Whiteley, "Variance estimation in the particle filter", Biometrika 105, 2018.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc.chains import Chains, chain_lengths, draw_first_level, grow_chains
from samplers.mcmc.kernels import Kernel
from samplers.method import Goal, Outcome, Steps, no_outcome_share
from samplers.problem import FloatArray, Inputs
from samplers.sample import Layer, Sample
from samplers.statistics.intervals import (
    Interval,
    binomial_cov,
    clopper_pearson,
    correlation_factor,
    log_normal_interval,
)
from samplers.statistics.thresholds import next_level
from samplers.trace import Level, Status

ACCEPTANCE_RANGE = (0.15, 0.85)
"""Acceptance without a warning: below it chains hardly move, above it their steps are short."""
LONGEST_CHAIN = 50
"""More steps than this from a handful of seeds cost calls of f and add little."""
FEW_CHAINS = 20
"""Fewer seeds than this make a level coarse: its c.o.v. is 0.2 or more."""
LARGE_COV = 0.5
"""C.o.v. that is worth a warning; the interval then spans a factor of 2.5 to either side."""
FEWEST_SEEDS = 10
"""A level is not made smaller for the sake of the budget than this many seeds allow."""
USUAL_LEVELS = 4
"""Levels that shall fit into a small budget: down to p = p0^4, 1e-4."""


class LevelProduct(NamedTuple):
    """Probability of the last level reached, as a product over the levels."""

    p: float = 1.0
    """Probability of the last level reached."""
    cov: float = 0.0
    """Its coefficient of variation."""


@dataclass(frozen=True, kw_only=True)
class SubsetLevels:
    """The settings that all kinds of subset simulation share."""

    n: int
    """Points per level, N."""
    p0: float
    """Wanted conditional probability of each level."""
    max_levels: int
    """Levels after which the method gives up."""

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator, kernel: Kernel) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more."""
        fitted = replace(self, n=self._points_per_level(goal.budget))
        outcome = yield from fitted._run_levels(inputs, goal, rng, kernel)
        return replace(outcome, warnings=(*self._budget_warnings(fitted.n, goal.budget), *outcome.warnings))

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

    def _run_levels(self, inputs: Inputs, goal: Goal, rng: np.random.Generator, kernel: Kernel) -> Steps:
        """Run with n points per level, as far as the budget goes.

        Every point below the threshold is a seed, with its root, as the estimate of the error needs. The exploration
        of `TwoStage` takes a random part of them and records no levels: it shares `next_level` and `grow_chains`.
        """
        chains = yield from draw_first_level(inputs, min(self.n, goal.budget), rng)
        left, stopped = goal.budget - chains.n_new, False
        passed, trace, levels = LevelProduct(), list[Level](), list[Chains]()
        while True:
            levels.append(chains)
            level = next_level(chains.f[chains.used], self.p0, goal.gamma)
            stop = Status.STOPPED if stopped else self._reason_to_stop(chains, level, goal.gamma, left, len(trace))
            threshold = goal.gamma if stop is not None or level is None else level
            trace.append(level_record(chains, threshold, passed))
            goal.on_level(trace[-1])
            if stop is not None:
                sample = weighted_points(inputs, levels, trace, goal.gamma)
                return replace(summarise(chains, goal, passed, trace, stop), sample=sample)
            passed = include_level(passed, trace[-1])
            seeds = chains.where(chains.f <= threshold)
            lengths = chain_lengths(self._points_of_level(len(seeds.f), left), len(seeds.f), rng)
            growth = yield from grow_chains(inputs, seeds, threshold, lengths, kernel, rng)
            chains, kernel, stopped = growth.chains, growth.kernel, growth.interrupted
            left -= chains.n_new

    def _reason_to_stop(
        self, chains: Chains, level: float | None, gamma: float, left: int, depth: int
    ) -> Status | None:
        """Return how the run ends with these chains, or None if it goes on to `level`."""
        if level == gamma:
            return Status.CONVERGED
        if left == 0 and chains.f.size < self.n:
            return Status.BUDGET  # too few points of level 0 to speak of ties
        if level is None or depth + 1 >= self.max_levels:
            return Status.STALLED
        n_seeds = int(np.count_nonzero(chains.f[chains.used] <= level))
        return Status.BUDGET if left < n_seeds else None  # not one step for every chain

    def _points_of_level(self, n_seeds: int, left: int) -> int:
        """Return how many points the next level shall have, its seeds included."""
        longest = max(LONGEST_CHAIN, math.ceil(1 / self.p0))
        return max(min(self.n, n_seeds + left, n_seeds * longest), n_seeds)


def level_record(chains: Chains, threshold: float, passed: LevelProduct) -> Level:
    """Return the record of a level: the true share of its points with f <= threshold."""
    below = chains.used & (chains.f <= threshold)
    total = int(chains.lengths.sum())
    share = int(below.sum()) / total
    effective = total / (1 + correlation_factor(below, chains.lengths))
    return Level(
        gamma=threshold,
        p=share,
        estimate=passed.p * share,
        n_sim=chains.n_new,
        n_points=total,
        cov=binomial_cov(share, effective),
        acceptance=chains.acceptance,
        ess=effective,
    )


def include_level(passed: LevelProduct, level: Level) -> LevelProduct:
    """Return the product with one more level, taken as independent of the others."""
    square = (1 + passed.cov**2) * (1 + level.cov**2) - 1
    return LevelProduct(p=passed.p * level.p, cov=math.sqrt(square))


def weighted_points(inputs: Inputs, levels: list[Chains], trace: list[Level], gamma: float) -> Sample:
    """Return the points of all levels with their weights.

    A point of level j counts where it lies above the threshold that leads on to level j + 1 (below it, the
    points of level j + 1 speak), with weight P_j / N_j: the probability of its level over its points.
    """
    kept = [c.where(c.f > record.gamma) for c, record in zip(levels[:-1], trace[:-1], strict=True)]
    kept.append(levels[-1].where(levels[-1].used))
    reached = np.cumprod([1.0, *(record.p for record in trace[:-1])])
    weights = reached / [record.n_points for record in trace]
    last = kept[-1]  # every point with f <= gamma is one of these
    return Sample(
        f=np.concatenate([points.f for points in kept]),
        weights=np.repeat(weights, [len(points.f) for points in kept]),
        units=np.concatenate([points.roots for points in kept]),
        n_units=trace[0].n_points,
        x=inputs.base.from_standard_normal(last.u[last.f <= gamma]),
        layers=tuple(_layers(levels, trace, weights)),
    )


def _layers(levels: list[Chains], trace: list[Level], weights: FloatArray) -> Iterator[Layer]:
    """Go through the levels with all their points; level j has thresholds from that of level j + 1 to its own."""
    thresholds = [math.inf, *(record.gamma for record in trace[:-1]), -math.inf]
    for chains, weight, high, low in zip(levels, weights, thresholds, thresholds[1:], strict=False):
        points = chains.where(chains.used)
        yield Layer(f=points.f, weights=np.full(len(points.f), weight), units=points.roots, low=low, high=high)


def summarise(chains: Chains, goal: Goal, passed: LevelProduct, trace: list[Level], status: Status) -> Outcome:
    """Return the outcome: the last of `trace` counted f <= gamma."""
    _, hits, roots = chains.where(chains.f <= goal.gamma)
    cov = max(include_level(passed, trace[-1]).cov, descent_cov(roots, trace[0].n_points))
    return Outcome(
        p=passed.p * trace[-1].p,
        interval=subset_interval(chains, len(hits), goal, passed, trace, cov),
        cov=cov,
        status=status if len(hits) or status is Status.STOPPED else Status.NO_HITS,
        warnings=tuple(_warnings(trace, status, len(hits), cov)),
        trace=tuple(trace),
        no_outcome_share=no_outcome_share(hits),
        base_draws=trace[0].n_points,
    )


def subset_interval(
    chains: Chains, hits: int, goal: Goal, passed: LevelProduct, trace: list[Level], cov: float
) -> Interval:
    """Return the interval of p after a last level with `hits` failing points."""
    if len(trace) == 1:
        return clopper_pearson(hits, trace[0].n_points, goal.confidence)
    if hits == 0:
        # The level reached is as uncertain as its descent, and its share as if each of its roots were one point.
        roots = chains.where(chains.used).roots
        independent = effective_roots(roots)
        cov = max(passed.cov, descent_cov(roots, trace[0].n_points))
        reached = log_normal_interval(passed.p, cov, goal.confidence, df=max(independent - 1, 1.0))[1]
        return 0.0, reached * clopper_pearson(0, max(int(independent), 1), goal.confidence)[1]
    roots = chains.where(chains.f <= goal.gamma).roots
    return log_normal_interval(passed.p * trace[-1].p, cov, goal.confidence, df=max(effective_roots(roots) - 1, 1.0))


def effective_roots(roots: NDArray[np.int64]) -> float:
    """Return how many points of level 0 the failing points (k,) effectively descend from, (sum h)^2 / sum h^2.

    So many independent terms, less one for their mean, are the degrees of freedom of the c.o.v.: as a rule 8 to 15
    with N = 1000 and p = 2e-4, too few for a normal quantile.
    """
    h = np.bincount(roots).astype(np.float64)
    return float(h.sum() ** 2 / (h * h).sum())


def descent_cov(roots: NDArray[np.int64], n: int) -> float:
    """Return the c.o.v. of p-hat that the descent of the failing points shows.

    With h_i failing points descending from point i of n at level 0, p-hat is proportional to the
    mean of the h_i. Were the thresholds fixed, these would be independent, so
    c.o.v.^2 = sum h_i^2 / (sum h_i)^2 - 1/n. Unlike the product over levels this holds the
    correlation between levels: a lucky point at level 0 is lucky at all.

    Args:
        roots: For each failing point the point of level 0 from which it descends, shape (k,).
        n: Points of level 0.
    """
    if roots.size == 0:
        return math.inf
    return math.sqrt(max(1 / effective_roots(roots) - 1 / n, 0.0))


def _warnings(trace: list[Level], status: Status, hits: int, cov: float) -> list[str]:
    found = []
    depth = len(trace) - 1
    if status is Status.STALLED:
        found.append(f"No progress beyond level {depth}: f ties there or the number of levels is used up.")
    if status is Status.BUDGET:
        found.append(f"max_sim was used up at level {depth}; p rests on {hits} failing points.")
    if status is Status.STOPPED:
        found.append(f"Stopped at level {depth}; p rests on {hits} failing points.")
    if hits == 0:
        found.append("No failure was seen: p = 0 with a one-sided interval.")
    elif cov > LARGE_COV:
        found.append(f"The c.o.v. is {cov:.2f}: few independent paths lead to the failures seen.")
    low, high = ACCEPTANCE_RANGE
    for k, level in enumerate(trace):
        if level.acceptance is not None and not low <= level.acceptance <= high:
            found.append(
                f"Acceptance {level.acceptance:.2f} at level {k} is outside [{low}, {high}]: the chains explore badly."
            )
    for k, level in enumerate(trace[:-1], start=1):
        seeds = round(level.p * level.n_points)
        if seeds < FEW_CHAINS:
            found.append(f"Level {k} grew from {seeds} seeds only: the estimate is coarse.")
    return found
