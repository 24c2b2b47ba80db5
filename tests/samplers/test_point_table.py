"""Tables of points."""

import numpy as np
import pytest

import samplers

PROBLEM = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)


@pytest.mark.parametrize("method", ["adss", "ce", "mc", "two-stage"])
def test_every_simulated_point_is_there_with_its_outcome(method):
    result = samplers.estimate(PROBLEM, method, seed=0, max_sim=300, keep_points=True)
    x = result.to_pandas()[["x1", "x2"]].to_numpy()
    assert x.shape == (result.n_sim, 2)
    np.testing.assert_array_equal(PROBLEM.evaluate(x), result.points.f)


def test_points_of_terms_are_kept_too():
    series = samplers.FunctionProblem(
        dim=40, terms=lambda x: 3.0 - x[:, :3], gradient=lambda x, term: -np.eye(40)[term]
    )
    result = samplers.estimate(series, seed=0, max_sim=1500, keep_points=True)
    np.testing.assert_array_equal(series.evaluate(result.points.x), result.points.f)
    assert len(result.points.f) == result.simulations.n < result.n_sim  # gradients cost, and give no outcome


def test_without_them_failing_points_have_their_coordinates():
    result = samplers.estimate(PROBLEM, "mc", seed=0, max_sim=5000)
    table = result.to_pandas(["a", "b"])
    assert len(table) == 5000
    assert table.weight[table.failed].sum() == pytest.approx(result.p)
    assert (table.a[table.failed] >= 3.0).all()
    assert table.a[~table.failed].isna().all()


def test_simulations_without_an_outcome_are_null():
    def f(x):
        return np.where(x[:, 1] > 2.0, np.nan, 3.0 - x[:, 0])

    problem = samplers.FunctionProblem(f, dim=2)
    result = samplers.estimate(problem, "mc", seed=0, max_sim=3000, on_error="failure", keep_points=True)
    for table in (
        result.to_arrow(),
        samplers.estimate(problem, "mc", seed=0, max_sim=3000, on_error="bound").to_arrow(),
    ):
        lost = table.filter(table["f"].is_null())
        assert 0 < len(lost) == table["f"].null_count
        assert all(lost["failed"].to_pylist())


@pytest.mark.parametrize("names", [["a"], ["a", "a"], ["a", "weight"]])
def test_names_that_do_not_fit_are_refused(names):
    result = samplers.estimate(PROBLEM, "mc", seed=0, max_sim=100)
    with pytest.raises(ValueError, match="Expected 2 different names"):
        result.to_arrow(names)


def test_columns_are_named_by_the_problem():
    named = samplers.FunctionProblem(PROBLEM.f, dim=2, column_names=["load", "f"])
    for keep in (False, True):
        result = samplers.estimate(named, "mc", seed=0, max_sim=6000, keep_points=keep)
        assert result.to_arrow().column_names[-2:] == ["load", "x.f"]
        assert result.to_arrow(["a", "b"]).column_names[-2:] == ["a", "b"]
    assert [each.name for each in result.sensitivity().columns] == ["load", "f"]


def test_names_outlive_a_file(tmp_path):
    named = samplers.FunctionProblem(PROBLEM.f, dim=2, column_names=["load", "wind"])
    samplers.estimate(named, "mc", seed=0, max_sim=500).save(tmp_path / "result")
    assert samplers.Estimate.load(tmp_path / "result").column_names == ("load", "wind")
