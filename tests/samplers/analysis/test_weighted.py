"""Weights of failures and means over them."""

import numpy as np
import pytest

from samplers.analysis.weighted import weigh_failures
from tests.samplers.analysis.half_space_tail import METHODS, PHI, P, estimate_half_space


@pytest.mark.parametrize("method", METHODS)
def test_weights_add_up_to_p(method):
    result = estimate_half_space(method, max_sim=8_000)
    failures = weigh_failures(result)
    assert failures.weights.sum() == pytest.approx(result.p, rel=1e-12)
    assert failures.total == len(failures.x) == np.count_nonzero(result.sample.f <= 0.0)
    some = weigh_failures(result, most=5)
    assert len(some.x) == 5
    assert some.weights.sum() == pytest.approx(result.p, rel=1e-12)
    assert np.array_equal(some.x, failures.x[some.rows])


def test_the_mean_over_failures_is_that_of_the_truncated_normal():
    """E[X | X > 3] = phi(3) / Phi(-3) and E[X_2 | failure] = 0; errors are those of 30 seeds."""
    means, errors = [], []
    for seed in range(30):
        failures = weigh_failures(estimate_half_space("is", seed=seed, max_sim=1_500))
        mean, error = failures.mean_of(failures.x)
        means.append(mean)
        errors.append(error)
    z = (np.array(means) - [PHI / P, 0.0]) / errors
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(30)
    assert ((z.std(axis=0) > 0.6) & (z.std(axis=0) < 1.6)).all()


def test_errors_count_paths_of_chains_as_one():
    """Twice the points in the same units do not make a mean more certain."""
    failures = weigh_failures(estimate_half_space("mc", max_sim=20_000))
    double = {
        name: np.repeat(getattr(failures, name), 2, axis=0) for name in ("x", "rows", "has_outcome", "weights", "units")
    }
    again = type(failures)(**{**vars(failures), **double, "weights": double["weights"] / 2})
    for found, twice in zip(failures.mean_of(failures.x), again.mean_of(again.x), strict=True):
        assert np.allclose(found, twice)
