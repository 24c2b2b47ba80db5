"""Levels of subset simulation: shares, c.o.v., budgets, warnings."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.limit_states import half_space
from samplers.mcmc.chains import Chains
from samplers.method import Goal
from samplers.methods.subset_levels import (
    LevelProduct,
    descent_cov,
    effective_roots,
    include_level,
    level_record,
    summarise,
)
from samplers.problem import FunctionProblem
from samplers.statistics.intervals import log_normal_interval
from samplers.trace import Status

ADSS = samplers.AdaptiveSubsetSimulation
SS = samplers.SubsetSimulation


def run(problem, seed=1, **settings):
    return samplers.estimate(problem, ADSS(**settings), seed=seed)


def frozen(chains, steps):
    """One chain in ten below the threshold, all of its points."""
    f = np.where(np.arange(chains)[:, None] < chains // 10, -1.0, 1.0) * np.ones((chains, steps))
    u = np.zeros((chains, steps, 1))
    return Chains(u, f, np.full(chains, steps), np.arange(chains), chains * (steps - 1), 0.4)


def test_p_is_the_product_of_true_shares():
    result = run(half_space().problem)
    assert result.p == pytest.approx(math.prod(level.p for level in result.trace))
    assert [level.gamma for level in result.trace] == sorted((level.gamma for level in result.trace), reverse=True)
    assert result.trace[-1].gamma == 0.0


def test_level_zero_is_part_of_the_cov():
    result = run(half_space(2, -stats.norm.ppf(0.03)).problem)
    zero, last = result.trace
    assert zero.cov == pytest.approx(math.sqrt(0.9 / (0.1 * 1000)))
    both = math.sqrt((1 + zero.cov**2) * (1 + last.cov**2) - 1)
    assert result.cov >= both * (1 - 1e-12)
    assert include_level(LevelProduct(), zero).cov == pytest.approx(zero.cov)


def test_chain_correlation_is_in_the_cov_of_a_level():
    """Chains that never leave their side are worth one point each."""
    level = level_record(frozen(100, 10), 0.0, LevelProduct())
    assert level.p == 0.1
    assert level.ess == pytest.approx(100)
    assert level.cov == pytest.approx(math.sqrt(0.9 / (0.1 * 100)))


def test_chains_are_kept_apart_end_to_end():
    """Real chains are correlated: gamma is well above 0; it would vanish with mixed chains."""
    ess = [level.ess for seed in range(20) for level in run(half_space().problem, seed).trace[1:]]
    assert 200 < np.mean(ess) < 600


def test_descent_cov():
    """All descendants of one point: worth one point. One each: binomial."""
    assert descent_cov(np.full(50, 7), 1000) == pytest.approx(math.sqrt(1 - 1 / 1000))
    assert descent_cov(np.arange(100), 1000) == pytest.approx(math.sqrt(0.9 / (0.1 * 1000)))
    assert math.isinf(descent_cov(np.empty(0, dtype=int), 1000))


def test_effective_roots():
    assert effective_roots(np.full(50, 7)) == 1
    assert effective_roots(np.arange(100)) == 100
    assert effective_roots(np.array([1, 1, 4, 9])) == pytest.approx(16 / 6)


def test_cov_is_the_larger_of_chain_correlation_and_descent():
    """100 chains that stay where they are; 10 fail. Either estimate can be the larger one."""
    chains, goal = frozen(100, 10), Goal(gamma=0.0)

    def outcome(roots, passed):
        zero = replace(level_record(frozen(1000, 1), 0.0, LevelProduct()), n_points=1000)
        last = level_record(chains._replace(roots=roots), 0.0, passed)
        return summarise(chains._replace(roots=roots), goal, passed, [zero, last], Status.CONVERGED), last

    one_root, passed = np.zeros(100, dtype=int), LevelProduct(0.1, 0.1)
    by_descent, last = outcome(one_root, passed)
    assert by_descent.cov == descent_cov(np.zeros(100, dtype=int), 1000) > 2 * include_level(passed, last).cov
    assert by_descent.interval == log_normal_interval(by_descent.p, by_descent.cov, 0.95, df=1.0)

    passed = LevelProduct(0.1, 2.0)
    by_levels, last = outcome(np.arange(100), passed)
    assert by_levels.cov == include_level(passed, last).cov > 2 * descent_cov(np.repeat(np.arange(10), 10), 1000)


def test_stalls_honestly_where_everything_ties():
    result = run(FunctionProblem(lambda x: np.full(len(x), 10.0), 2))
    assert result.n_sim == 1000
    assert result.status == "no_hits"
    assert result.interval == samplers.statistics.intervals.clopper_pearson(0, 1000, 0.95)
    assert any("No progress" in text for text in result.warnings)


def test_gives_up_after_max_levels():
    result = run(FunctionProblem(lambda x: 30 - x[:, 0], 2), max_levels=4)
    assert len(result.trace) == 4
    assert result.p == 0
    # three levels passed, 1e-3 give or take, of which no hit in a dozen roots may be a quarter
    assert 1e-4 < result.interval[1] < 1e-3


def test_no_failure_from_one_path_excludes_nothing():
    """One point in 1,000 leads down, to where nothing fails: how likely that is, a single root cannot tell."""

    def f(x):
        return np.where(x[:, 0] > 3.0, 10 - x[:, 0], 20 - 0.01 * x[:, 1])

    for seed in range(3):
        result = samplers.estimate(FunctionProblem(f, 2), ADSS(max_levels=6), seed=seed)
        assert result.p == 0
        assert result.interval[1] > 0.01


@pytest.mark.parametrize("max_sim", [1, 2, 5, 50, 99])
def test_a_budget_under_level_zero_is_named_as_the_reason(max_sim):
    result = samplers.estimate(half_space().problem, ADSS(), seed=1, max_sim=max_sim)
    assert result.n_sim == max_sim
    assert result.warnings[0] == (
        f"max_sim leaves {max_sim} of the 100 simulations that level 0 needs at least: plain draws only."
    )
    assert "max_sim was used up at level 0" in result.warnings[1]
    assert not any("ties" in text for text in result.warnings)
    assert result.interval == samplers.statistics.intervals.clopper_pearson(0, max_sim, 0.95)


def test_a_budget_for_few_points_has_the_status_budget():
    """Two of 50 points fail, less than p0: the run would go on."""
    problem = FunctionProblem(lambda x: np.arange(len(x)) - 1.5, 2)
    result = samplers.estimate(problem, ADSS(), seed=1, max_sim=50)
    assert (result.p, result.status) == (0.04, "budget")


@pytest.mark.parametrize(("max_sim", "n"), [(100, 100), (370, 100), (740, 200), (1000, 270), (3699, 999), (3700, 1000)])
def test_points_per_level_fit_the_budget(max_sim, n):
    result = samplers.estimate(half_space(2, 4.5).problem, ADSS(), seed=1, max_sim=max_sim)
    assert result.trace[0].n_points == n
    assert len(result.trace) == (1 if max_sim == 100 else 4)
    assert any(f"{n} points per level, not 1000" in text for text in result.warnings) == (n < 500)
    assert samplers.estimate(half_space().problem, ADSS(n=50), seed=1, max_sim=80).trace[0].n_points == 50


def test_no_chains_no_acceptance():
    trace = run(half_space().problem).trace
    assert trace[0].acceptance is None
    assert all(0 < level.acceptance < 1 for level in trace[1:])


@pytest.mark.parametrize(
    "bad", [{"scale": 0.99, "target_acceptance": 1e-6}, {"scale": 1e-3, "target_acceptance": 0.999}]
)
def test_warns_of_bad_mixing(bad):
    """Steps so large that nothing is accepted, and so small that everything is."""
    problem = half_space(40).problem
    good = samplers.estimate(problem, ADSS(n=500), seed=1)
    assert not any("Acceptance" in text for text in good.warnings)
    result = samplers.estimate(problem, ADSS(n=500, **bad), seed=1, max_sim=3000)
    assert any("Acceptance" in text for text in result.warnings)
