import numpy as np
import pytest

from samplers.counted import LOWEST, Counted, EvaluationError
from samplers.problem import FunctionProblem


def first(x):
    return x[:, 0]


def counted(f, dim=2, gamma=0.0, **options):
    return Counted(FunctionProblem(f, dim), gamma, **options)


def test_counts_every_row_and_reports_it():
    seen = []
    problem = counted(first, on_batch=seen.append)
    problem.evaluate(np.ones((3, 2)))
    problem.evaluate(np.ones((4, 2)))
    assert problem.n_sim == 7
    assert seen == [3, 7]


def test_an_empty_batch_does_not_reach_f(recorder):
    f = recorder(first)
    assert counted(f).evaluate(np.empty((0, 2))).shape == (0,)
    assert f.batches == []


def test_f_cannot_change_the_callers_points():
    def careless(x):
        x[:] = 99.0
        return x[:, 0]

    x = np.ones((2, 2))
    counted(careless).evaluate(x)
    np.testing.assert_array_equal(x, 1.0)


@pytest.mark.parametrize("shape", [(3,), (3, 5), (1, 3, 2)])
def test_wrong_shape_of_x(shape):
    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\)"):
        counted(first).evaluate(np.ones(shape))


@pytest.mark.parametrize("f", [lambda x: x, lambda x: x[:-1, 0], lambda x: 1.0, lambda x: x[:, :1]])
@pytest.mark.parametrize("on_error", ["raise", "failure", "bound"])
def test_wrong_shape_of_f_is_always_an_error(f, on_error):
    with pytest.raises(EvaluationError, match=r"Expected f to return shape \(3,\)"):
        counted(f, on_error=on_error).evaluate(np.ones((3, 2)))


def test_budget_is_a_wall():
    problem = counted(first, max_sim=5)
    problem.evaluate(np.ones((5, 2)))
    with pytest.raises(RuntimeError, match="0 of max_sim=5 left"):
        problem.evaluate(np.ones((1, 2)))
    assert problem.n_sim == 5


def nan_in_row_two(x):
    f = x[:, 0].copy()
    f[x[:, 0] == 2] = np.nan
    return f


def raises_at_two(x):
    if (x[:, 0] == 2).any():
        raise RuntimeError("no such road")
    return x[:, 0]


X = np.array([[1.0, 0.0], [3.0, 0.0], [2.0, 7.5], [4.0, 0.0], [-1.0, 0.0]])


@pytest.mark.parametrize("f", [nan_in_row_two, raises_at_two])
def test_raise_names_row_and_x(f):
    with pytest.raises(EvaluationError, match=r"row 2 of a batch of 5, x = \[2\. , 7\.5\]"):
        counted(f).evaluate(X)


def test_raise_keeps_the_cause():
    with pytest.raises(EvaluationError, match="RuntimeError: no such road") as caught:
        counted(raises_at_two).evaluate(X)
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_raise_quotes_what_f_says_of_the_row_it_names():
    """f names one bad row of its batch, and not the first."""

    def f(x):
        bad = np.flatnonzero(x[:, 0] >= 2)
        if len(bad):
            raise RuntimeError(f"no road at {x[bad[-1], 0]:g}")
        return x[:, 0]

    with pytest.raises(EvaluationError, match=r"row 1 of a batch of 5, x = .*; RuntimeError: no road at 3$") as caught:
        counted(f).evaluate(X)
    assert str(caught.value.__cause__) == "no road at 3"


def test_an_error_that_does_not_repeat_is_said_to():
    calls = []

    def once(x):
        calls.append(1)
        if len(calls) == 1:
            raise OSError("socket closed")
        return x[:, 0]

    with pytest.raises(EvaluationError, match="not repeatably; OSError: socket closed"):
        counted(once).evaluate(X)


@pytest.mark.parametrize("f", [nan_in_row_two, raises_at_two])
@pytest.mark.parametrize("on_error", ["failure", "bound"])
def test_rows_without_outcome_count_as_failing(f, on_error):
    problem = counted(f, on_error=on_error)
    np.testing.assert_array_equal(problem.evaluate(X), [1.0, 3.0, -np.inf, 4.0, -1.0])
    assert problem.n_sim == 5
    assert problem.n_errors == 1
    assert problem.failures.total == 2
    assert np.isnan(problem.failures.f).sum() == 1


def test_rows_handed_over_again_are_told_apart():
    problem = counted(raises_at_two, on_error="failure")
    problem.evaluate(X)
    assert problem.n_retried == 5 + 3  # 5 -> 3 + 2; 3 -> 2 + 1
    assert problem.n_sim == 5


def test_minus_infinity_from_f_is_an_outcome():
    problem = counted(lambda x: np.full(len(x), -np.inf), on_error="failure")
    np.testing.assert_array_equal(problem.evaluate(X), LOWEST)
    assert problem.n_errors == 0


def test_failures_are_ranked_by_density_and_bounded(rng):
    problem = counted(first, keep=10)
    x = rng.standard_normal((400, 2))
    for part in np.split(x, 4):
        problem.evaluate(part)
    failing = x[x[:, 0] <= 0]
    expected = np.sort(problem.base.log_prob(failing))[::-1][:10]
    np.testing.assert_allclose(problem.failures.log_p0, expected)
    np.testing.assert_allclose(problem.base.log_prob(problem.failures.x), expected)
    np.testing.assert_array_equal(problem.failures.f, problem.failures.x[:, 0])
    assert problem.failures.total == len(failing)
