"""Sums of logarithms, against SciPy's to the bit."""

import numpy as np
import pytest
from scipy.special import logsumexp

from samplers.statistics import log_sum_exp


def numbers(rng, shape):
    """Logarithms of any size, a fifth of them -inf, some columns wholly so."""
    a = rng.normal(0.0, 50.0, shape)
    a[rng.random(shape) < 0.2] = -np.inf
    if len(shape) == 2:
        a[:, rng.random(shape[1]) < 0.1] = -np.inf
    return a


@pytest.mark.parametrize("shape", [(1,), (7,), (3000,), (1, 5), (30, 1200), (6, 40)])
@pytest.mark.parametrize("axis", [None, 0])
def test_the_bits_are_those_of_scipy(rng, shape, axis):
    if axis is None and len(shape) == 2:
        shape = (shape[0] * shape[1],)
    a = numbers(rng, shape)
    np.testing.assert_array_equal(log_sum_exp(a, axis=axis), logsumexp(a, axis=axis))


def test_weights_and_ties_are_as_with_scipy(rng):
    a, weights = numbers(rng, (20, 500)), rng.exponential(1.0, (20, 1))
    weights[3:6] = 0.0
    a[7] = a[8]
    np.testing.assert_array_equal(log_sum_exp(a, axis=0, weights=weights), logsumexp(a, axis=0, b=weights))


def test_a_sum_of_nothing_and_one_beyond_all_numbers():
    assert log_sum_exp(np.empty(0)) == -np.inf
    np.testing.assert_array_equal(log_sum_exp(np.empty((0, 3)), axis=0), np.full(3, -np.inf))
    assert log_sum_exp(np.array([0.0, np.inf])) == np.inf
    assert np.isnan(log_sum_exp(np.array([0.0, np.nan])))
    assert float(log_sum_exp(np.array([1000.0, 1000.0]))) == 1000.0 + np.log(2.0)
