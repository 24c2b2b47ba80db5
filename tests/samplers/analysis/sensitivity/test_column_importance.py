"""Importance of columns in closed form on half-spaces."""

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.analysis.sensitivity import relative_entropies
from samplers.analysis.weighted import WeightedFailures
from tests.samplers.analysis.sensitivity.parametric_normal import ALPHA, BASE, BETA, HAZARD, ParametricNormal, run


@pytest.fixture(scope="module")
def result():
    return run(max_sim=6000)


def test_importance_of_a_half_space_is_the_squared_direction(result):
    """D_j of the half-space in closed form from mean alpha_j h and variance 1 - alpha_j^2 h (h - beta)."""
    mean = ALPHA * HAZARD
    variance = 1 - ALPHA**2 * HAZARD * (HAZARD - BETA)
    exact = (mean**2 + variance - 1 - np.log(variance)) / 2 / -np.log(stats.norm.sf(BETA))
    for each in result.sensitivity().columns:
        j = int(each.name[1]) - 1
        assert each.importance == pytest.approx(exact[j], abs=4 * each.error + 0.003)
        assert each.direction == pytest.approx(mean[j], abs=0.15)
    assert sum(each.importance for each in result.sensitivity().columns) < 1.0
    far = stats.norm.pdf(8.0) / stats.norm.sf(8.0)
    assert (0.64 * far**2) / 2 / -stats.norm.logsf(8.0) == pytest.approx(0.64, abs=0.06)  # the limit alpha_j^2


def test_importance_does_not_depend_on_units():
    other = ParametricNormal([0.0, 0.0, 0.0], [1.0, 100.0, 1e-3])
    one, two = (run(base, seed=4).sensitivity().columns for base in (BASE, other))
    assert [each.name for each in one] == [each.name for each in two]
    assert [each.importance for each in one] == pytest.approx([each.importance for each in two])


def test_columns_of_a_block_count_together(result):
    blocks = {each.name: each for each in result.sensitivity(["a", "rest"], [1, 2]).columns}
    alone = {each.name: each for each in result.sensitivity().columns}
    joint = alone["x2"].importance + alone["x3"].importance
    assert blocks["a"].importance == pytest.approx(alone["x1"].importance)
    assert blocks["rest"].importance == pytest.approx(joint, abs=0.003)
    assert blocks["rest"].direction > 0


@pytest.mark.parametrize("variance", [0.05, 0.25, 1.0, 4.0])
def test_relative_entropy_of_normal_points_has_no_bias(variance):
    """20,000 columns of 50 points N(1.5, s^2): the bias of 1 / 50 is gone but for terms of order 1 / 50^2."""
    points, columns = 50, 20_000
    u = 1.5 + np.sqrt(variance) * np.random.default_rng(0).standard_normal((points, columns))
    failures = WeightedFailures(
        x=u, rows=np.arange(points), has_outcome=np.full(points, True), weights=np.full(points, 1e-4),
        units=np.arange(points), n_units=10_000, independent=True, inflation=1.0, total=points,
    )  # fmt: skip
    entropy = relative_entropies(failures, u)[0]
    exact = (1.5**2 + variance - 1 - np.log(variance)) / 2
    assert entropy.mean() == pytest.approx(exact, abs=4 * entropy.std() / np.sqrt(columns) + 2 / points**2)


def test_irrelevant_noise_has_no_importance():
    """300 columns of noise: without the correction of the bias their block would have most of it."""
    base = samplers.StandardNormal(302)
    problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], 302)
    problem = type("P", (), {"dim": 302, "base": base, "evaluate": staticmethod(problem.evaluate)})()
    found = samplers.estimate(problem, "mc", seed=0, max_sim=200_000).sensitivity(["x", "noise"], [2, 300])
    importance = {each.name: each.importance for each in found.columns}
    assert importance["x"] > 0.6
    assert importance["noise"] < 0.05


def test_a_single_failing_point_says_so():
    problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
    result = samplers.estimate(problem, "mc", seed=0, max_sim=1000)
    assert result.failures.total == 1
    with pytest.raises(ValueError, match="A single point failed"):
        result.sensitivity()
