"""Levels of subset simulation: seeds, lengths, budgets, how a run ends."""

import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space
from samplers.mcmc import independent_chains
from samplers.methods.subset import SubsetPlanner
from samplers.problem import FunctionProblem
from samplers.trace import Status

ADSS = samplers.AdaptiveSubsetSimulation


def run(problem, seed=1, **settings):
    return samplers.estimate(problem, ADSS(**settings), seed=seed)


def plan(f, rng, depth=0, n_sim=0, **settings):
    """Return what follows on independent points with these outcomes."""
    planner = SubsetPlanner(**{"n": 100, "p0": 0.1, "max_levels": 30, "gamma": 0.0, "budget": 10_000} | settings)
    f = np.asarray(f, dtype=float)
    return planner.plan_next(independent_chains(np.arange(len(f))[:, None], f), depth, n_sim, rng)


def test_every_point_below_the_threshold_is_a_seed(rng):
    level = plan(rng.permutation(100) + 1.0, rng)
    assert level.threshold == 10.0
    assert sorted(level.seeds.f) == list(range(1, 11))
    np.testing.assert_array_equal(level.seeds.roots, level.seeds.u[:, 0])
    np.testing.assert_array_equal(level.lengths, np.full(10, 10))


def test_ten_percent_of_failures_end_the_run(rng):
    assert plan(np.arange(100) - 9.0, rng) is Status.CONVERGED  # -9 ... 0 fail
    assert plan(np.arange(100) - 8.0, rng).threshold == 1.0


@pytest.mark.parametrize(
    ("settings", "status"),
    [
        ({"budget": 9}, Status.BUDGET),  # ten seeds
        ({"budget": 500, "n_sim": 491}, Status.BUDGET),
        ({"max_levels": 3, "depth": 2}, Status.STALLED),
        ({"max_levels": 3, "depth": 2, "budget": 0}, Status.STALLED),
        ({"n": 101, "budget": 0}, Status.BUDGET),  # level 0 is not whole
    ],
)
def test_reasons_to_stop(settings, status, rng):
    assert plan(np.arange(100) + 1.0, rng, **settings) is status


def test_ties_leave_no_level_to_go_to(rng):
    assert plan(np.full(100, 5.0), rng) is Status.STALLED
    assert plan(np.full(50, 5.0), rng, budget=0) is Status.BUDGET  # 50 of 100 points do not tell


@pytest.mark.parametrize(
    ("settings", "points"),
    [
        ({}, 100),
        ({"budget": 34}, 44),  # ten seeds and 34 more
        ({"budget": 500, "n_sim": 490}, 20),
        ({"n": 700}, 500),  # 50 points a chain at most
        ({"n": 5}, 10),  # one for each seed at least
    ],
)
def test_points_of_the_next_level(settings, points, rng):
    lengths = plan(np.arange(100) + 1.0, rng, **settings).lengths
    assert lengths.sum() == points
    assert lengths.max() - lengths.min() <= 1


def test_stalls_honestly_where_everything_ties():
    result = run(FunctionProblem(lambda x: np.full(len(x), 10.0), 2))
    assert result.n_sim == 1000
    assert result.status == "no_hits"
    assert result.interval == samplers.statistics.clopper_pearson(0, 1000, 0.95)
    assert any("No progress" in text for text in result.warnings)


def test_gives_up_after_max_levels():
    result = run(FunctionProblem(lambda x: 30 - x[:, 0], 2), max_levels=4)
    assert len(result.trace) == 4
    assert result.p == 0
    # three levels passed, 1e-3 give or take, of which no hit in a dozen roots may be a quarter
    assert 1e-4 < result.interval[1] < 1e-3


@pytest.mark.parametrize("max_sim", [1, 2, 5, 50, 99])
def test_a_budget_under_level_zero_is_named_as_the_reason(max_sim):
    result = samplers.estimate(half_space().problem, ADSS(), seed=1, max_sim=max_sim)
    assert result.n_sim == max_sim
    assert result.warnings[0] == (
        f"max_sim leaves {max_sim} of the 100 simulations that level 0 needs at least: plain draws only."
    )
    assert "max_sim was used up at level 0" in result.warnings[1]
    assert not any("ties" in text for text in result.warnings)
    assert result.interval == samplers.statistics.clopper_pearson(0, max_sim, 0.95)


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
