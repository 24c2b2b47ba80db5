"""Estimate of subset simulation: p, c.o.v., interval and weighted points from the levels of a descent.

References:
    Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
    Probabilistic Engineering Mechanics 16, 2001.
    Lee and Whiteley, "Variance estimation in the particle filter", Biometrika 105, 2018.
"""

import math
from collections.abc import Iterator, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc.chains import Chains
from samplers.method import Goal, Outcome, no_outcome_share
from samplers.problem import FloatArray, Inputs
from samplers.sample import Layer, Sample
from samplers.statistics.intervals import (
    Interval,
    binomial_cov,
    clopper_pearson,
    correlation_factor,
    log_normal_interval,
)
from samplers.trace import Level, Status

ACCEPTANCE_RANGE = (0.15, 0.85)
"""Acceptance without a warning: below it chains hardly move, above it their steps are short."""
FEW_CHAINS = 20
"""Fewer seeds than this make a level coarse: its c.o.v. is 0.2 or more."""
LARGE_COV = 0.5
"""C.o.v. that is worth a warning; the interval then spans a factor of 2.5 to either side."""


class LevelProduct(NamedTuple):
    """Probability of the last level reached, as a product over the levels."""

    p: float = 1.0
    """Probability of the last level reached."""
    cov: float = 0.0
    """Its coefficient of variation."""


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


def multiply_levels(trace: Sequence[Level]) -> LevelProduct:
    """Return the product over the levels; 1 of none."""
    return reduce(include_level, trace, LevelProduct())


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


def summarise(chains: Chains, goal: Goal, trace: list[Level], status: Status) -> Outcome:
    """Return the outcome after a last level `chains`, of which the last of `trace` counted f <= gamma."""
    _, hits, roots = chains.where(chains.f <= goal.gamma)
    product = multiply_levels(trace)
    cov = max(product.cov, descent_cov(roots, trace[0].n_points))
    return Outcome(
        p=product.p,
        interval=subset_interval(chains, goal, trace, cov),
        cov=cov,
        status=status if len(hits) or status is Status.STOPPED else Status.NO_HITS,
        warnings=(*_end_warnings(len(trace) - 1, status, len(hits), cov), *_chain_warnings(trace)),
        trace=tuple(trace),
        no_outcome_share=no_outcome_share(hits),
        base_draws=trace[0].n_points,
    )


def subset_interval(chains: Chains, goal: Goal, trace: list[Level], cov: float) -> Interval:
    """Return the interval of p = prod of the shares in `trace`, whose c.o.v. is `cov`, after a last level `chains`."""
    roots = chains.where(chains.f <= goal.gamma).roots
    if len(trace) == 1:
        return clopper_pearson(len(roots), trace[0].n_points, goal.confidence)
    if len(roots) == 0:
        return _interval_without_hits(chains, goal, trace)
    p = multiply_levels(trace).p
    return log_normal_interval(p, cov, goal.confidence, df=max(effective_roots(roots) - 1, 1.0))


def _interval_without_hits(chains: Chains, goal: Goal, trace: list[Level]) -> Interval:
    """Return the interval of p where no point of the last level fails.

    The level reached is as uncertain as its descent, and its share as if each of its roots were one point.
    """
    passed, roots = multiply_levels(trace[:-1]), chains.where(chains.used).roots
    independent = effective_roots(roots)
    cov = max(passed.cov, descent_cov(roots, trace[0].n_points))
    reached = log_normal_interval(passed.p, cov, goal.confidence, df=max(independent - 1, 1.0))[1]
    return 0.0, reached * clopper_pearson(0, max(int(independent), 1), goal.confidence)[1]


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


def _end_warnings(depth: int, status: Status, hits: int, cov: float) -> list[str]:
    """Return what the end of the run at level `depth` and its failures leave doubtful."""
    found, failing = [], f"{hits} failing point{'' if hits == 1 else 's'}"
    if status is Status.STALLED:
        found.append(f"No progress beyond level {depth}: f is constant there, or the limit on levels was reached.")
    if status is Status.BUDGET:
        found.append(f"max_sim was used up at level {depth}; p rests on {failing}.")
    if status is Status.STOPPED:
        found.append(f"Stopped at level {depth}; p rests on {failing}.")
    if hits == 0:
        found.append("No failure was seen: p = 0 with a one-sided interval.")
    elif cov > LARGE_COV:
        found.append(f"The c.o.v. is {cov:.2f}: few independent paths lead to the failures seen.")
    return found


def _chain_warnings(trace: list[Level]) -> list[str]:
    """Return which levels have chains that mix badly, or few of them."""
    low, high = ACCEPTANCE_RANGE
    found = [
        f"Acceptance {level.acceptance:.2f} at level {k} is outside [{low}, {high}]: the chains explore badly."
        for k, level in enumerate(trace)
        if level.acceptance is not None and not low <= level.acceptance <= high
    ]
    for k, level in enumerate(trace[:-1], start=1):
        seeds = round(level.p * level.n_points)
        if seeds < FEW_CHAINS:
            found.append(f"Level {k} grew from {seeds} seeds only: the estimate is coarse.")
    return found
