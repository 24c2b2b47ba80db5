import numpy as np
import pytest

from samplers.errors import EvaluationError
from samplers.execution.evaluation_log import SMALLEST_F, EvaluationLog
from samplers.problem import StandardNormal

X = np.array([[1.0, 0.0], [3.0, 0.0], [2.0, 7.5], [4.0, 0.0], [-1.0, 0.0]])
F = X[:, 0]
WITH_NAN = np.where(F == 2, np.nan, F)


def make_log(**options):
    return EvaluationLog(2, StandardNormal(2), 0.0, **options)


def test_counts_every_row():
    log = make_log()
    np.testing.assert_array_equal(log.record(X, F), F)
    log.record(X[:2], np.array([1.0, 2.0]))
    assert log.n_sim == 7
    assert log.failures.total == 1


def test_nan_is_refused_with_row_and_x_and_nothing_is_recorded():
    log = make_log()
    with pytest.raises(EvaluationError, match=r"row 2 of a batch of 5, x = \[2\. , 7\.5\]"):
        log.record(X, WITH_NAN)
    assert (log.n_sim, log.failures.total) == (0, 0)


@pytest.mark.parametrize("on_error", ["failure", "bound"])
def test_rows_without_outcome_count_as_failing(on_error):
    log = make_log(on_error=on_error)
    np.testing.assert_array_equal(log.record(X, WITH_NAN), [1.0, 3.0, -np.inf, 4.0, -1.0])
    assert (log.n_sim, log.n_errors, log.failures.total) == (5, 1, 2)
    assert np.isnan(log.failures.f).sum() == 1


def test_minus_infinity_is_an_outcome():
    log = make_log(on_error="failure")
    np.testing.assert_array_equal(log.record(X, np.full(5, -np.inf)), SMALLEST_F)
    assert log.n_errors == 0


def test_failures_are_ranked_by_density_and_bounded(rng):
    log = make_log(keep=10)
    x = rng.standard_normal((400, 2))
    for part in np.split(x, 4):
        log.record(part, part[:, 0])
    failing = x[x[:, 0] <= 0]
    log_prob = StandardNormal(2).log_prob
    expected = np.sort(log_prob(failing))[::-1][:10]
    np.testing.assert_allclose(log.failures.log_p0, expected)
    np.testing.assert_allclose(log_prob(log.failures.x), expected)
    np.testing.assert_array_equal(log.failures.f, log.failures.x[:, 0])
    assert log.failures.total == len(failing)


def test_the_density_of_failures_is_asked_for_many_at_once(rng):
    """A batch of a few rows costs a base fitted to data milliseconds: only `keep` new ones, or a reader, ask for it."""

    class CountingNormal(StandardNormal):
        asked = 0

        def log_prob(self, x):
            CountingNormal.asked += 1
            return super().log_prob(x)

    log = EvaluationLog(2, CountingNormal(2), 0.0, keep=10)
    x = -np.abs(rng.standard_normal((24, 2)))
    for part in np.split(x, 8):
        log.record(part, part[:, 0])
    assert CountingNormal.asked == 2  # after 12 and 24
    assert log.failures.total == 24
    assert log.failures is log.failures
    log.record(x[:1], x[:1, 0])
    assert (log.failures.total, CountingNormal.asked) == (25, 3)
