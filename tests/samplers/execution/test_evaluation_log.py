import numpy as np
import pytest

from samplers.errors import EvaluationError
from samplers.execution.evaluation_log import LEAST_FLOAT, Ledger
from samplers.problem import StandardNormal

X = np.array([[1.0, 0.0], [3.0, 0.0], [2.0, 7.5], [4.0, 0.0], [-1.0, 0.0]])
F = X[:, 0]
WITH_NAN = np.where(F == 2, np.nan, F)


def ledger(**options):
    return Ledger(2, StandardNormal(2), 0.0, **options)


def test_counts_every_row():
    book = ledger()
    np.testing.assert_array_equal(book.enter(X, F), F)
    book.enter(X[:2], [1, 2])  # whole numbers of a list are fine
    assert book.n_sim == 7
    assert book.failures.total == 1


@pytest.mark.parametrize("f", [X, F[:-1], 1.0, F[:, None], [], ["a"] * 5, [None, [1]]])
@pytest.mark.parametrize("on_error", ["raise", "failure", "bound"])
def test_what_is_not_one_number_per_row_is_always_an_error(f, on_error):
    book = ledger(on_error=on_error)
    with pytest.raises(EvaluationError, match=r"Expected f to return shape \(5,\)"):
        book.enter(X, f)
    assert book.n_sim == 0


def test_nan_is_refused_with_row_and_x_and_nothing_is_entered():
    book = ledger()
    with pytest.raises(EvaluationError, match=r"row 2 of a batch of 5, x = \[2\. , 7\.5\]"):
        book.enter(X, WITH_NAN)
    assert (book.n_sim, book.failures.total) == (0, 0)


@pytest.mark.parametrize("on_error", ["failure", "bound"])
def test_rows_without_outcome_count_as_failing(on_error):
    book = ledger(on_error=on_error)
    np.testing.assert_array_equal(book.enter(X, WITH_NAN), [1.0, 3.0, -np.inf, 4.0, -1.0])
    assert (book.n_sim, book.n_errors, book.failures.total) == (5, 1, 2)
    assert np.isnan(book.failures.f).sum() == 1


def test_minus_infinity_is_an_outcome():
    book = ledger(on_error="failure")
    np.testing.assert_array_equal(book.enter(X, np.full(5, -np.inf)), LEAST_FLOAT)
    assert book.n_errors == 0


def test_failures_are_ranked_by_density_and_bounded(rng):
    book = ledger(keep=10)
    x = rng.standard_normal((400, 2))
    for part in np.split(x, 4):
        book.enter(part, part[:, 0])
    failing = x[x[:, 0] <= 0]
    log_prob = StandardNormal(2).log_prob
    expected = np.sort(log_prob(failing))[::-1][:10]
    np.testing.assert_allclose(book.failures.log_p0, expected)
    np.testing.assert_allclose(log_prob(book.failures.x), expected)
    np.testing.assert_array_equal(book.failures.f, book.failures.x[:, 0])
    assert book.failures.total == len(failing)
