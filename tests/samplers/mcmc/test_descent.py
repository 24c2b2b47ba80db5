"""Descent: the order of events, what the planner is told, how it ends, and the product of the shares."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from samplers.mcmc import Growth, NextLevel, ScaledKernel, chain_lengths, descend, independent_chains
from samplers.method import Interrupted
from samplers.problem import FunctionProblem
from samplers.trace import Status

PROBLEM = FunctionProblem(lambda u: -u[:, 0], dim=2)
PCN = ScaledKernel("conditional", "unit", 0.6, 0.44, deviations=np.ones(2))


@dataclass(frozen=True)
class Quantiles:
    """All points below the quantile p0 are seeds; levels have as many points as the first."""

    p0: float
    depth: int
    budget: float = math.inf

    def plan_next(self, chains, depth, n_sim, rng):
        f = chains.f[chains.used]
        if depth == self.depth:
            return Status.CONVERGED
        threshold = float(np.quantile(f, self.p0, method="lower"))
        seeds = chains.where(chains.f <= threshold)
        if n_sim + len(f) - len(seeds.f) > self.budget:
            return Status.BUDGET
        return NextLevel(threshold, seeds, chain_lengths(len(f), len(seeds.f), rng))


class Scripted:
    """Goes on with the lowest five points, in chains of three, and keeps what it was told."""

    def __init__(self, levels, end=Status.STALLED):
        self.levels, self.end, self.told = levels, end, []

    def plan_next(self, chains, depth, n_sim, rng):
        self.told.append((depth, n_sim, chains.f.size))
        if depth == self.levels:
            return self.end
        points = chains.by_step()
        lowest = np.argsort(points.f, kind="stable")[:5]
        return NextLevel(float(points.f[lowest[-1]]), points.select(lowest), np.full(5, 3))


def start_from(n, rng):
    u = rng.standard_normal((n, 2))
    return Growth.start(independent_chains(u, PROBLEM.evaluate(u)), PCN)


def reported(drive, planner, rng, n=20):
    """Return what was reported, the status, and the outcomes of all that was simulated."""
    levels = []
    steps = descend(PROBLEM, start_from(n, rng), planner, lambda *level: levels.append(level), rng)
    status, f = drive(steps, PROBLEM)
    return levels, status, f


def test_thresholds_fall_and_points_stay_below_them(drive, rng):
    levels, status, _ = reported(drive, Quantiles(0.1, 4), rng, n=500)
    assert status is Status.CONVERGED
    planned = [level for _, level in levels[:-1]]
    thresholds = [level.threshold for level in planned]
    assert thresholds == sorted(thresholds, reverse=True)
    assert len(set(thresholds)) == len(thresholds) == 4
    for (growth, _), level, (grown, _) in zip(levels, planned, levels[1:], strict=False):
        assert (level.seeds.f <= level.threshold).all()
        assert set(level.seeds.f) <= set(growth.chains.f[growth.chains.used])
        np.testing.assert_array_equal(grown.chains.u[:, 0], level.seeds.u)
        np.testing.assert_array_equal(grown.chains.lengths, level.lengths)
        used = grown.chains.used
        assert (grown.chains.f[used] <= level.threshold).all()
        np.testing.assert_array_equal(grown.chains.f[used], PROBLEM.evaluate(grown.chains.u[used]))


def test_the_planner_is_told_depth_and_simulations(drive, rng):
    """Five chains of three points are ten simulations a level; the independent points do not count."""
    planner = Scripted(levels=3)
    levels, status, f = reported(drive, planner, rng)
    assert planner.told == [(0, 0, 20), (1, 10, 15), (2, 20, 15), (3, 30, 15)]
    assert len(f) == 30
    assert status is Status.STALLED
    assert [isinstance(planned, NextLevel) for _, planned in levels] == [True, True, True, False]
    np.testing.assert_array_equal(f, np.concatenate([growth.f_candidates for growth, _ in levels]))


@pytest.mark.parametrize("end", [Status.CONVERGED, Status.STALLED, Status.BUDGET])
def test_without_a_next_level_nothing_is_simulated(end, rng):
    levels, start = [], start_from(20, rng)
    steps = descend(PROBLEM, start, Scripted(0, end), lambda *level: levels.append(level), rng)
    with pytest.raises(StopIteration) as ended:
        next(steps)
    assert ended.value.value is end
    assert levels == [(start, end)]


def test_levels_are_reported_before_the_next_one_is_simulated(rng):
    depths = []
    planner = Scripted(levels=2)
    steps = descend(
        PROBLEM, start_from(20, rng), planner, lambda growth, _: depths.append(len(growth.f_candidates)), rng
    )
    x = next(steps)
    assert depths == [0]
    x = steps.send(PROBLEM.evaluate(x))
    assert depths == [0]  # two steps a level
    steps.send(PROBLEM.evaluate(x))
    assert depths == [0, 10]


@pytest.mark.parametrize("batch", range(4))
def test_an_interrupted_level_comes_last(batch, drive, rng):
    """Two batches a level: one that is interrupted at its first batch has its seeds only."""
    planner = Scripted(levels=9)
    levels, start = [], start_from(20, rng)
    steps = descend(PROBLEM, start, planner, lambda *level: levels.append(level), rng)
    x = next(steps)
    for _ in range(batch):
        x = steps.send(PROBLEM.evaluate(x))
    with pytest.raises(StopIteration) as ended:
        steps.throw(Interrupted())
    assert ended.value.value is Status.STOPPED
    last, planned = levels[-1]
    assert planned is Status.STOPPED
    assert last.interrupted
    assert last.chains.n_new == 5 * (batch % 2)
    assert last.chains.u.shape == (5, 1 + batch % 2, 2)
    assert len(planner.told) == 1 + batch // 2  # it is not asked about an unfinished level
    assert len(levels) == 2 + batch // 2


def test_a_budget_ends_it_before_the_level_that_does_not_fit(drive, rng):
    """Levels of 101 points from 11 seeds take 90 simulations: 300 are enough for three of them."""
    levels, status, f = reported(drive, Quantiles(0.1, 9, budget=300), rng, n=101)
    assert status is Status.BUDGET
    assert [growth.chains.n_new for growth, _ in levels[1:]] == [90, 90, 90]
    assert len(f) == 270


def test_the_kernel_keeps_what_it_has_learned(drive, rng):
    """Every level moves once, so that its scale is the one before times exp(acceptance - 0.44)."""

    class OneStep(Scripted):
        def plan_next(self, chains, depth, n_sim, rng):
            planned = super().plan_next(chains, depth, n_sim, rng)
            return planned if isinstance(planned, Status) else planned._replace(lengths=np.full(5, 2))

    levels, _, _ = reported(drive, OneStep(levels=3), rng)
    expected = 0.6
    for growth, _ in levels[1:]:
        expected *= math.exp(growth.chains.acceptance - 0.44)
        assert growth.kernel.scale == pytest.approx(min(expected, 1.0))
        expected = growth.kernel.scale


def product_of_shares(drive, beta, rng):
    """Return the product of the shares of three levels of 1000 points with p0 = 0.1, the last one at beta."""
    levels, _, _ = reported(drive, Quantiles(0.1, 2), rng, n=1000)
    p = 1.0
    for growth, planned in levels:
        threshold = planned.threshold if isinstance(planned, NextLevel) else -beta
        p *= float((growth.chains.f[growth.chains.used] <= threshold).mean())
    return p


def test_the_product_of_shares_is_the_probability_of_a_half_space(drive, rng):
    """The mean of 30 runs agrees with Phi(-3) = 1.35e-3 within four of its own standard errors."""
    found = np.array([product_of_shares(drive, 3.0, rng) for _ in range(30)])
    error = found.std(ddof=1) / math.sqrt(len(found))
    assert error < 0.08 * stats.norm.sf(3.0)
    assert abs(found.mean() - stats.norm.sf(3.0)) < 4 * error
