"""Problems of functions: what is refused, with which hint."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
import torch

import samplers


@pytest.mark.parametrize("dim", [0, -1, 2.0, "2", True])
def test_dim_must_be_a_positive_whole_number(dim):
    with pytest.raises(ValueError, match="whole number of at least 1"):
        samplers.FunctionProblem(lambda x: x[:, 0], dim)
    with pytest.raises(ValueError, match="whole number of at least 1"):
        samplers.distributions.StandardNormal(dim)


@pytest.mark.parametrize("x", [np.zeros(2), np.zeros((3, 1)), np.zeros((1, 3, 2))])
def test_x_must_be_rows_of_d_numbers(x):
    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\), got \("):
        samplers.FunctionProblem(lambda x: x[..., 0], 2).evaluate(x)


@pytest.mark.parametrize(
    "f",
    [
        lambda x: 1.0,
        lambda x: x[1:, 0],
        lambda x: None,
        lambda x: ["far"] * len(x),
        lambda x: x[:, 0] > 1.0,
        lambda x: [1.0, *(x[1:, 0] > 1.0)],
        lambda x: torch.from_numpy(x[:, 0]) > 1.0,
        lambda x: (1e3 * x[:, 0]).astype("m8[ms]"),
    ],
    ids="scalar short none words booleans mixed tensor times".split(),
)
@pytest.mark.parametrize("on_error", ["raise", "bound"])
def test_f_must_give_one_real_number_per_row(f, on_error):
    """Not an outcome that is missing, but an f that is none: no rule for errors covers it."""
    with pytest.raises(samplers.EvaluationError, match=r"Expected f to return shape \(50,\), one"):
        samplers.estimate(samplers.FunctionProblem(f, 2), "mc", seed=1, max_sim=50, on_error=on_error)


def cells(values, missing):
    """Return values as objects, those that are NaN as another thing that stands for missing."""
    return [missing if math.isnan(value) else value for value in values.tolist()]


def test_rows_in_a_list_are_read_as_they_are_alone():
    rows = [np.ma.masked_array([1e20, 2.0], [True, False]), [3.0, None]]
    np.testing.assert_array_equal(samplers.problem.read_numbers(rows, "terms"), [[np.nan, 2.0], [3.0, np.nan]])
    with pytest.raises(samplers.EvaluationError, match="booleans"):
        samplers.problem.read_numbers([[1.0, True], [2.0, False]], "terms")


MISSING = {
    "masked": np.ma.masked_invalid,
    "masked numbers": lambda f: np.ma.array(np.nan_to_num(f, nan=-9999).round(), mask=np.isnan(f), dtype=int),
    "masked elements": lambda f: cells(f, np.ma.masked),
    "objects": lambda f: np.array(cells(f, None), dtype=object),
    "nullable integers": lambda f: pd.Series(cells(f.round(), pd.NA), dtype="Int64"),
    "NaN as an integer": lambda f: torch.tensor(f).round().int(),
    "tensor with its gradient": lambda f: torch.tensor(f, requires_grad=True),
}


@pytest.mark.parametrize("form", MISSING)
def test_what_is_masked_or_missing_is_no_outcome(form):
    """In whole arrays, in terms, and in what either of two problems to be compared gives."""

    def lost(x):
        return MISSING[form](np.where(x[:, 1] > 1.0, np.nan, 4.0 * (2.0 - x[:, 0])))

    problem = samplers.FunctionProblem(lost, 2)
    x = problem.base.sample(50, np.random.default_rng(0))
    np.testing.assert_array_equal(np.isnan(problem.evaluate(x)), x[:, 1] > 1.0)
    result = samplers.estimate(problem, "mc", seed=0, max_sim=200, on_error="failure")
    assert result.failures.total >= np.isnan(result.failures.f).sum() > 20
    series = samplers.FunctionProblem(dim=2, terms=lambda x: np.ma.masked_where(x > 1.0, 3.0 - x))
    np.testing.assert_array_equal(np.isnan(series.terms(x).values), x > 1.0)
    with pytest.raises(samplers.EvaluationError, match=r"f failed twice on x = .* f is NaN"):
        samplers.compare(problem, samplers.FunctionProblem(lambda x: 5.0 - x[:, 0], 2), "mc", seed=0, max_sim=400)


def test_a_p_above_a_half_comes_with_the_direction():
    wrong_way = samplers.FunctionProblem(lambda x: (x[:, 0] > 2.0).astype(int), 2)
    assert "If large f is dangerous, return -f" in samplers.estimate(wrong_way, "mc", seed=0, max_sim=500).remarks[0]


def test_a_series_system_is_given_by_its_terms_alone():
    problem = samplers.FunctionProblem(dim=2, terms=lambda x: 3.0 - x, gradient=lambda x, term: -np.eye(2)[term])
    x = np.array([[1.0, 0.0], [4.0, 5.0]])
    np.testing.assert_array_equal(problem.evaluate(x), [2.0, -2.0])
    terms = problem.terms(x, gamma=1.0)
    np.testing.assert_array_equal(terms.values, 3.0 - x)
    np.testing.assert_array_equal(terms.f, terms.lowest)
    np.testing.assert_array_equal(terms.least, [0, 1])
    assert terms.threshold == 1.0
    gradients = problem.gradient(x, terms.least, terms.ticks[[0, 1], terms.least])
    np.testing.assert_array_equal(gradients.values, [[-1.0, 0.0], [0.0, -1.0]])
    assert gradients.cost == 2 * problem.gradient_cost


def test_a_copy_of_a_problem_with_terms_has_the_same_terms():
    problem = samplers.FunctionProblem(dim=2, terms=lambda x: 3.0 - x)
    assert dataclasses.replace(problem) == problem
    np.testing.assert_array_equal(dataclasses.replace(problem).terms(np.zeros((1, 2))).values, [[3.0, 3.0]])


@pytest.mark.parametrize(
    "arguments", [{"terms": 3.0}, {"terms": abs, "gradient": 3.0}, {"terms": abs, "gradient_cost": 0}]
)
def test_terms_and_gradients_must_be_functions_and_cost_something(arguments):
    with pytest.raises(ValueError, match="Expected"):
        samplers.FunctionProblem(dim=2, **arguments)


@pytest.mark.parametrize(
    "f",
    [lambda x: 3.0 - x[0], lambda x: 3.0 - float(x[0]), lambda x: 1.0 if x[0] > x[1] else 2.0],
    ids=["row", "float", "branch"],
)
def test_an_f_of_one_point_gets_a_hint(f):
    problem = samplers.FunctionProblem(f, dim=2)
    said = r"batch of points of shape \(n, 2\); pass vectorized=False"
    with pytest.raises(samplers.EvaluationError, match=said) as error:
        samplers.estimate(problem, "mc", seed=0, max_sim=100)
    assert "\n" not in str(error.value)
    rows = dataclasses.replace(problem, vectorized=False)
    assert samplers.estimate(rows, "mc", seed=0, max_sim=100).n_sim == 100


def test_an_f_that_returns_a_column_is_told_to_take_it():
    column = samplers.FunctionProblem(lambda x: 3.0 - x[:, :1], dim=2)
    with pytest.raises(samplers.EvaluationError, match=r"got \(100, 1\)\. Return its only column, f\(x\)\[:, 0\]\."):
        column.evaluate(np.zeros((100, 2)))
    ragged = samplers.FunctionProblem(lambda x: [[1.0], [2.0, 3.0]], dim=2)
    with pytest.raises(samplers.EvaluationError, match="pass vectorized=False"):
        ragged.evaluate(np.zeros((2, 2)))


@pytest.mark.parametrize("names", [["a"], ["a", "a"]])
def test_names_of_columns_that_do_not_fit_are_refused(names):
    with pytest.raises(ValueError, match="2 different names, got"):
        samplers.FunctionProblem(lambda x: x[:, 0], dim=2, column_names=names)
    with pytest.raises(ValueError, match="Expected 2 different names"):
        samplers.estimate(samplers.FunctionProblem(lambda x: x[:, 0], 2), "mc", seed=0, max_sim=100).to_arrow(names)
