"""Subset simulation: points kept, ties, budgets, spread and coverage."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.limit_states import half_space, plateau, shell
from samplers.mcmc import descent_cov
from samplers.method import Goal
from samplers.problem import FunctionProblem

ADSS, SS = samplers.AdaptiveSubsetSimulation, samplers.SubsetSimulation
BOTH = [SS(), ADSS(), ADSS(proposal="metropolis"), SS(distribution="normal")]
IDS = ["ss", "adss", "adss metropolis", "ss normal"]


def test_seeds_are_never_simulated_again(recorder):
    f = recorder(half_space().problem.f)
    result = samplers.estimate(FunctionProblem(f, 2), ADSS(), seed=1)
    assert len(np.unique(f.points, axis=0)) == f.rows == result.n_sim
    for before, level in itertools.pairwise(result.trace):
        assert level.n_points == 1000 == level.n_sim + round(before.p * before.n_points)


@pytest.mark.parametrize(("p", "levels"), [(0.3, [True]), (0.03, [False, True])])
def test_no_level_after_the_answer_is_known(p, levels):
    result = samplers.estimate(half_space(2, -stats.norm.ppf(p)).problem, ADSS(), seed=1)
    assert [level.gamma == 0.0 for level in result.trace] == levels
    if len(levels) == 1:
        assert result.interval == samplers.sample.clopper_pearson(round(1000 * result.p), 1000, 0.95)


@pytest.mark.parametrize("tied", [0.9, pytest.param(0.95, marks=pytest.mark.slow)])
def test_ties_at_a_cap(study, tied):
    found = study(plateau(3, 3.0, tied), ADSS(), 40)
    assert all(result.status == "converged" for result in found.results)
    assert abs(found.ratios.mean() - 1) < 4 * found.error + 0.05
    if tied > 0.9:  # the first share is the true one, about 5 %
        shares = [result.trace[0].p for result in found.results]
        assert np.mean(shares) == pytest.approx(0.05, abs=0.005)
        assert len(set(shares)) > 10


@pytest.mark.slow
def test_noise_of_f_is_kept_with_the_point(study):
    """Fresh noise at every call: simulating the seeds again would bias p by -20 % and more."""
    noise = np.random.default_rng(3)

    def f(x):
        return 3.0 - x.sum(axis=1) / math.sqrt(6) + 0.4 * noise.standard_normal(len(x))

    reference = half_space(6)._replace(problem=FunctionProblem(f, 6), p=float(stats.norm.sf(3.0 / math.hypot(1, 0.4))))
    found = study(reference, ADSS(), 150)
    assert abs(found.ratios.mean() - 1) < 4 * found.error + 0.04


@pytest.mark.parametrize("method", BOTH, ids=IDS)
def test_the_weighted_points_give_p_at_every_threshold(drive, method):
    reference = half_space(3)
    outcome = drive(method.steps(reference.problem, Goal(gamma=0.0), np.random.default_rng(4)), reference.problem).value
    sample = outcome.sample
    assert sample.weights.sum() == pytest.approx(1)
    assert sample.weights[sample.f <= 0].sum() == pytest.approx(outcome.p)
    for level in outcome.trace:
        assert sample.weights[sample.f <= level.gamma].sum() == pytest.approx(level.estimate)
    np.testing.assert_allclose(reference.problem.evaluate(sample.x), sample.f[sample.f <= 0])
    assert sample.n_units == 1000
    assert outcome.cov >= descent_cov(sample.units[sample.f <= 0], 1000)
    median = reference.problem.evaluate(np.zeros((1, 3)))[0]
    assert sample.weights[sample.f <= median].sum() == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("method", BOTH, ids=IDS)
@pytest.mark.parametrize(
    "reference", [half_space(1, 3.0), pytest.param(half_space(30, 3.0), marks=pytest.mark.slow)], ids=["d1", "d30"]
)
def test_every_kernel_gives_p(study, method, reference):
    study(reference, method, 20).check(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("reference", [half_space(2), half_space(100), shell(20)], ids=lambda r: r.name)
@pytest.mark.parametrize("method", [SS(), ADSS()], ids=["ss", "adss"])
def test_coverage_of_a_single_run(study, reference, method):
    found = study(reference, method, 600)
    assert found.covered >= stats.binom.ppf(1e-3, 600, 0.92)
    least = 0.85 if isinstance(method, ADSS) else 0.72  # some runs of Metropolis chains are far too high, none says so
    assert least < found.own_cov / found.ratios.std(ddof=1) < 1.15


def test_a_budget_under_level_zero_is_named_as_the_reason():
    result = samplers.estimate(half_space().problem, ADSS(), seed=1, max_sim=99)
    assert result.remarks[0].startswith("max_sim leaves 99 of the 100 simulations that level 0 needs at least")
    assert "max_sim was used up at level 0" in result.warnings[0]
    assert not any("ties" in text for text in result.warnings)
    assert result.interval == samplers.sample.clopper_pearson(0, 99, 0.95)


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


def test_no_failure_from_one_path_excludes_no_more_than_its_base_draws():
    """One point in 1,000 leads down, to where nothing fails: how likely that is, a single root cannot tell."""

    def f(x):
        return np.where(x[:, 0] > 3.0, 10 - x[:, 0], 20 - 0.01 * x[:, 1])

    for seed in range(3):
        result = samplers.estimate(FunctionProblem(f, 2), ADSS(max_levels=6), seed=seed)
        assert result.p == 0
        assert result.interval[1] == samplers.sample.clopper_pearson(0, 1000, 0.95)[1]
