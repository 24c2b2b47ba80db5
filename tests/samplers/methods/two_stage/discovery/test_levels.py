import numpy as np
import pytest
from scipy import stats

from samplers.mcmc.chains import independent_chains
from samplers.mcmc.descent import NextLevel
from samplers.method import Goal, Interrupted
from samplers.methods.two_stage.discovery.levels import ExplorationPlanner, descend_levels
from samplers.methods.two_stage.exploration import Sizes
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FunctionProblem
from samplers.trace import Status

SIZES = Sizes.within(6000)
FAR = FunctionProblem(lambda u: 5.0 - u[:, 0], 10)
"""p = 2.9e-7."""


def descend(simulator, u, rng):
    return descend_levels(
        simulator, u, FAR.evaluate(u), Goal(gamma=0.0), SIZES.level, SIZES.most, rng, DEFAULT_SETTINGS.exploration
    )


def test_descent_finds_what_plain_draws_cannot(drive):
    """p = 3e-7 in ten dimensions; its points fail, are distinct, and are distributed nearly as failures are."""
    problem, sizes, found, covered = FAR, SIZES, 0, 0
    for seed in range(6):
        rng, simulator = np.random.default_rng(seed), Simulator(problem)
        u = rng.standard_normal((sizes.base, 10))
        descent = drive(descend(simulator, u, rng), problem).value
        assert 1 <= len(descent.roots) <= len(descent.failing) or len(descent.failing) == 0
        assert (np.diff(descent.roots) > 0).all()
        covered += descent.ceiling > stats.norm.sf(5.0)
        assert simulator.n_sim == len(descent.u) == len(descent.f) <= sizes.most
        assert (problem.evaluate(descent.failing) <= 0).all()
        assert len(np.unique(descent.failing, axis=0)) == len(descent.failing)
        np.testing.assert_array_equal(problem.evaluate(descent.u), descent.f)
        found += len(descent.failing) >= 20
    assert found >= 5
    assert covered >= 5  # at 97.5 %, P[4 or fewer of 6] = 0.009


def plan(f, rng, depth=0, n_sim=0, budget=10_000, n=250):
    """Return what follows on independent points with these outcomes."""
    f = np.asarray(f, dtype=float)
    chains = independent_chains(np.arange(len(f))[:, None], f)
    return ExplorationPlanner(0.0, n, budget, DEFAULT_SETTINGS.exploration).plan_next(chains, depth, n_sim, rng)


def test_seeds_are_a_random_part_of_the_points_below_the_threshold(rng):
    """Of 1000 points 100 are below; 250 points a level hold a third as many chains, 83, of four points each."""
    level = plan(np.arange(1000) + 1.0, rng)
    assert level.threshold == 100.0
    assert len(set(level.seeds.f)) == len(level.seeds.f) == 83
    assert (level.seeds.f <= 100.0).all()
    np.testing.assert_array_equal(level.seeds.roots, level.seeds.f - 1)
    np.testing.assert_array_equal(level.lengths, np.full(83, 4))
    assert set(plan(np.arange(1000) + 1.0, rng).seeds.f) != set(level.seeds.f)


def test_few_seeds_have_long_chains(rng):
    level = plan(np.arange(100) + 1.0, rng)
    np.testing.assert_array_equal(level.lengths, np.full(10, 25))


def test_reasons_to_end_the_descent(rng):
    f, most = np.arange(100) + 1.0, DEFAULT_SETTINGS.exploration.max_levels
    assert plan(f - 10, rng) is Status.CONVERGED
    assert plan(np.full(100, 5.0), rng) is Status.STALLED
    assert plan(f, rng, depth=most) is Status.STALLED
    assert isinstance(plan(f, rng, depth=most - 1), NextLevel)
    assert plan(f, rng, n_sim=100, budget=339) is Status.BUDGET  # ten chains of 24 steps
    assert isinstance(plan(f, rng, n_sim=100, budget=340), NextLevel)


def test_an_interrupted_descent_counts_what_it_simulated(rng):
    problem, simulator, u = FAR, Simulator(FAR), rng.standard_normal((SIZES.base, 10))
    steps = descend(simulator, u, rng)
    x, rows = next(steps), 0
    for _ in range(7):
        rows += len(x)
        x = steps.send(problem.evaluate(x))
    with pytest.raises(Interrupted):
        steps.throw(Interrupted())
    assert simulator.n_sim == rows > 0


@pytest.mark.parametrize(("fails", "goes_on"), [(4, True), (5, False)])
def test_common_failures_among_the_base_draws_end_the_descent(rng, fails, goes_on):
    """Of 500 draws 5 fail: 1 %, from which on they are the last level. Further down as few are none."""
    f = np.where(np.arange(500) < fails, -1.0, np.arange(500) + 1.0)
    planned = plan(f, rng)
    assert isinstance(planned, NextLevel) if goes_on else planned is Status.CONVERGED
    assert isinstance(plan(f, rng, depth=1), NextLevel)
