"""Importance of columns, derivatives by parameters, shares of the spread over refits, and what a sensitivity says."""

import json

import numpy as np
import pytest
from scipy import stats

import samplers
from tests.samplers.analysis.parametric_normal import ALPHA, BASE, BETA, HAZARD, ParametricNormal, fitted, run


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


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0]])
def test_importance_of_correlated_inputs_is_of_each_given_those_before(order):
    """FORM's alpha in the space of u is L' a / |L' a| for a half-space a . x and a covariance L L'."""
    covariance = np.array([[1.0, 0.7, 0.2], [0.7, 1.0, 0.3], [0.2, 0.3, 1.0]])[np.ix_(order, order)]
    a = np.array([1.0, 0.8, 1.2])[order]
    alpha = np.linalg.cholesky(covariance).T @ a
    limit = 3.0 * np.linalg.norm(alpha)
    problem = samplers.FunctionProblem(lambda x: limit - x @ a, base=stats.multivariate_normal(np.zeros(3), covariance))
    found = samplers.estimate(problem, seed=0, max_sim=6000).sensitivity()
    assert [each.name for each in found.columns] == [f"x{j + 1}" for j in np.argsort(-(alpha**2))]
    assert found.conditional and "FORM may rank otherwise" in str(found)


def test_irrelevant_noise_has_no_importance():
    """300 columns of noise: without the correction of the bias their block would have most of it."""
    problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], 302)
    found = samplers.estimate(problem, "mc", seed=0, max_sim=200_000).sensitivity(["x", "noise"], [2, 300])
    importance = {each.name: each.importance for each in found.columns}
    assert importance["x"] > 0.6
    assert importance["noise"] < 0.05
    assert not found.conditional and "FORM" not in str(found)


@pytest.mark.parametrize("method", ["two-stage", "mc", "is", "ce", "adss"])
def test_derivatives_are_those_of_the_half_space(method):
    """By a mean, per standard deviation: alpha_j h with h = phi / Phi(-); by a sd, per 10 %: 0.1 alpha_j^2 beta h."""
    found = run(method=method, max_sim=60_000 if method == "mc" else 6000).sensitivity()
    exact = np.append(ALPHA * HAZARD, 0.1 * ALPHA**2 * BETA * HAZARD)
    expected = {each.name: value for each, value in zip(BASE.parameters(), exact, strict=True)}
    for each in found.parameters:
        assert each.d_log_p == pytest.approx(expected[each.name], abs=4 * each.error + 1e-6)
        assert 0 < each.error < 0.5


def test_shares_of_the_spread_add_up_and_name_what_varies():
    """Var of g_i delta_i: (0.8 h 0.3)^2 by the mean and (0.1 x 0.36 beta h)^2 by the sd."""
    found = run(fitted(200), max_sim=6000).sensitivity(["speed", "gap", "offset"])
    shares = {each.name: each.share for each in found.parameters}
    assert sum(shares.values()) == pytest.approx(1.0)
    one, two = (0.8 * HAZARD * 0.3) ** 2, (0.1 * 0.36 * BETA * HAZARD) ** 2
    assert shares["mean of speed"] == pytest.approx(one / (one + two), abs=0.08)
    assert sum(found.shares.values()) == pytest.approx(1.0)
    assert next(iter(found.shares)) == "speed"
    assert found.parameters[0].name == "mean of speed"
    assert found.correlation > 0.97
    assert found.first_order_spread == pytest.approx(found.spread, rel=0.15)
    assert "more recordings of speed would narrow the interval most" in str(found)


def test_without_comparable_refits_there_are_no_shares(result):
    assert result.sensitivity().shares == {}
    assert "no refits" in str(result.sensitivity())
    base = fitted(15)
    for refit in base.refits[:8]:
        refit.parameters = lambda names=(), like=None: []
    found = run(base).sensitivity()
    assert (found.shares, found.n_refits) == ({}, (7, 15))
    assert found.reason == "only 7 of 15 refits have the parameters of the base, so that no share is known"
    same = fitted(12)
    same.refits = (ParametricNormal(BASE.mean, BASE.sd),) * 12
    assert "does not differ" in run(same).sensitivity().reason


def test_json_and_picture(tmp_path):
    found = run(fitted()).sensitivity()
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["parameters"][0]["share"] == found.parameters[0].share
    assert data["columns"][0]["importance"] == found.columns[0].importance
    from matplotlib.figure import Figure

    figure = Figure()
    widths = [bar.get_width() for bar in found.plot(figure.subplots()).patches]
    assert widths == [100 * each.importance for each in found.columns] == sorted(widths, reverse=True)
    figure.savefig(tmp_path / "bars.png")


def test_few_failures_do_not_determine_the_importance():
    """Five draws of 4,000 fail: no importance is above 1, and the table says that they are too few."""
    problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=3)
    sparse = next(
        result
        for seed in range(50)
        if (result := samplers.estimate(problem, "mc", seed=seed, max_sim=4000)).failures.total == 5
    ).sensitivity()
    assert sparse.points == pytest.approx(5.0)
    assert all(0.0 <= each.importance <= 1.0 for each in sparse.columns)
    assert "only 5 effective failing points, too few for importance and derivatives" in str(sparse)
    enough = samplers.estimate(problem, seed=0, max_sim=4000).sensitivity()
    assert "too few" not in str(enough)


def test_bad_input_is_refused_in_one_line(result):
    with pytest.raises(ValueError, match="Expected names and sizes of 3 columns, got 2 names"):
        result.sensitivity(["a", "b"])

    class Broken(ParametricNormal):
        def with_parameters(self, values):
            broken = ParametricNormal(*np.split(np.asarray(values), 2))
            broken.log_prob = lambda x: np.full(len(x), -np.inf)
            return broken

    with pytest.raises(ValueError, match="no finite derivative by the mean of x1 at a failing point"):
        run(Broken(BASE.mean, BASE.sd)).sensitivity()
