"""Improved cross-entropy: gain, widths, bounded weights."""

import math

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.limit_states import four_branches, half_space, parabola, plateau, shell
from samplers.method import Goal
from samplers.problem import FunctionProblem

ICE = samplers.ImprovedCrossEntropy


@pytest.mark.parametrize(
    ("reference", "family", "least"),
    [
        pytest.param(half_space(), "gaussian", 700, marks=pytest.mark.slow),
        pytest.param(parabola(), "mixture", 700, marks=pytest.mark.slow),
        (four_branches(), "mixture", 10),
        pytest.param(plateau(), "mixture", 1000, marks=pytest.mark.slow),
        pytest.param(shell(), "vmfn", 1000, marks=pytest.mark.slow),
        pytest.param(half_space(100), "vmfn", 80, marks=pytest.mark.slow),
    ],
    ids=lambda v: getattr(v, "name", v),
)
def test_gain_over_monte_carlo(study, reference, family, least):
    found = study(reference, ICE(family=family), 10, max_sim=6000)
    found.check(bias=found.error)  # of ten runs the error itself is known to a quarter
    n = np.mean([result.n_sim for result in found.results])
    assert (1 - found.p) / found.p / (n * np.mean((found.ratios - 1) ** 2)) > least


def test_a_family_that_does_not_fit_says_so():
    """A Gaussian cannot lie around the origin."""
    results = [samplers.estimate(shell().problem, ICE(family="gaussian"), seed=s, max_sim=6000) for s in range(5)]
    assert all(result.warnings for result in results)
    assert sum(r.interval[0] <= shell().p <= r.interval[1] for r in results) >= 4


@pytest.mark.parametrize("far", [np.inf, 1e12])
def test_outcomes_that_stand_for_nothing(far):
    """Half of the scenarios have no meaningful outcome."""
    reference = half_space(2, 3.0)
    problem = FunctionProblem(lambda x: np.where(x[:, 0] < 0, far, reference.problem.f(x)), 2)
    s = math.sqrt(0.5)  # less P[(u1 + u2) / sqrt(2) > 3, u1 < 0]
    exact = reference.p - float(stats.multivariate_normal([0, 0], [[1, -s], [-s, 1]]).cdf([-3.0, 0.0]))
    found = np.mean([samplers.estimate(problem, ICE(), seed=seed).p for seed in range(5)])
    assert found == pytest.approx(exact, rel=0.06)


def test_final_weights_are_bounded_by_the_base_draws(drive):
    problem = four_branches().problem
    sample = drive(ICE().steps(problem, Goal(gamma=0.0), np.random.default_rng(1)), problem).value.sample
    assert sample.n_units == 4000
    assert sample.weights.max() <= 10 / 4000 * (1 + 1e-9)
    assert sample.weights.sum() == pytest.approx(1, abs=4 * np.sqrt((sample.weights**2).sum()))
    assert (sample.weights**2).sum() < 0.01
