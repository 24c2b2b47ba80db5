"""The estimate from levels: p, its c.o.v. by chains and by descent."""

import math
from dataclasses import replace

import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space
from samplers.mcmc import Chains
from samplers.method import Goal
from samplers.methods.subset import LevelProduct, descent_cov, level_record, multiply_levels, summarise
from samplers.problem import FunctionProblem
from samplers.sample import Status, log_normal_interval

ADSS = samplers.AdaptiveSubsetSimulation


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


def test_chain_correlation_is_in_the_cov_of_a_level():
    """Chains that never leave their side are worth one point each."""
    level = level_record(frozen(100, 10), 0.0, LevelProduct())
    assert level.p == 0.1
    assert level.ess == pytest.approx(100)
    assert level.cov == pytest.approx(math.sqrt(0.9 / (0.1 * 100)))


def test_cov_is_the_larger_of_chain_correlation_and_descent():
    """100 chains that stay where they are; 10 fail. Either estimate can be the larger one."""
    chains, goal = frozen(100, 10), Goal(gamma=0.0)

    def outcome(roots, zero):
        last = level_record(chains._replace(roots=roots), 0.0, multiply_levels([zero]))
        return summarise(chains._replace(roots=roots), goal, [zero, last], Status.CONVERGED), last

    zero = level_record(frozen(1000, 1), 0.0, LevelProduct())
    assert (zero.p, zero.n_points) == (0.1, 1000)
    by_descent, last = outcome(np.zeros(100, dtype=int), zero)
    assert by_descent.cov == descent_cov(np.zeros(100, dtype=int), 1000) > 2 * multiply_levels([zero, last]).cov
    assert by_descent.interval == log_normal_interval(by_descent.p, by_descent.cov, 0.95, df=1.0)

    zero = replace(zero, cov=2.0)
    by_levels, last = outcome(np.arange(100), zero)
    assert by_levels.cov == multiply_levels([zero, last]).cov > 2 * descent_cov(np.repeat(np.arange(10), 10), 1000)


def test_a_product_of_levels_by_hand():
    """Shares multiply, and so do 1 + c.o.v.^2 of independent factors: 1.04 x 1.09 = 1.1336."""
    assert multiply_levels([]) == LevelProduct(1.0, 0.0)
    zero = level_record(frozen(1000, 1), 0.0, LevelProduct())
    product = multiply_levels([replace(zero, p=0.1, cov=0.2), replace(zero, p=0.3, cov=0.3)])
    assert product.p == pytest.approx(0.03)
    assert product.cov == pytest.approx(math.sqrt(0.1336))


def test_no_failure_from_one_path_excludes_nothing():
    """One point in 1,000 leads down, to where nothing fails: how likely that is, a single root cannot tell."""

    def f(x):
        return np.where(x[:, 0] > 3.0, 10 - x[:, 0], 20 - 0.01 * x[:, 1])

    for seed in range(3):
        result = samplers.estimate(FunctionProblem(f, 2), ADSS(max_levels=6), seed=seed)
        assert result.p == 0
        assert result.interval[1] > 0.01
