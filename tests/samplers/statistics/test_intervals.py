import math

import numpy as np
import pytest
from scipy import stats

from samplers.statistics import (
    binomial_cov,
    clopper_pearson,
    correlation_factor,
    degrees_of_freedom,
    gain_over_monte_carlo,
    log_normal_interval,
)


def test_clopper_pearson_against_scipy():
    for hits in (0, 1, 7, 49, 50):
        exact = stats.binomtest(hits, 50).proportion_ci(0.9, method="exact")
        np.testing.assert_allclose(clopper_pearson(hits, 50, 0.9), exact)


def test_clopper_pearson_is_one_sided_at_the_ends():
    assert clopper_pearson(0, 100, 0.95)[0] == 0.0
    assert clopper_pearson(0, 100, 0.95)[1] == pytest.approx(1 - 0.025**0.01)
    assert clopper_pearson(100, 100, 0.95)[1] == 1.0


@pytest.mark.parametrize("p", [0.003, 0.05, 0.5])
def test_clopper_pearson_covers_whatever_p(p):
    n = 200
    k = np.arange(n + 1)
    inside = [low <= p <= high for low, high in (clopper_pearson(int(i), n, 0.95) for i in k)]
    assert stats.binom.pmf(k, n, p)[inside].sum() >= 0.95


def test_log_normal_covers_a_log_normal_estimate(rng):
    cov, p, runs = 0.3, 1e-4, 4000
    sigma = math.sqrt(math.log1p(cov**2))
    estimates = p * np.exp(sigma * rng.standard_normal(runs))
    inside = [low <= p <= high for low, high in (log_normal_interval(e, cov, 0.95) for e in estimates)]
    assert abs(np.mean(inside) - 0.95) < 4 * math.sqrt(0.95 * 0.05 / runs)


def test_log_normal_is_cut_at_one_and_wider_with_few_degrees_of_freedom():
    assert log_normal_interval(0.9, 0.5, 0.95)[1] == 1.0
    narrow, wide = log_normal_interval(1e-3, 0.2, 0.95), log_normal_interval(1e-3, 0.2, 0.95, df=4)
    assert wide[0] < narrow[0] < 1e-3 < narrow[1] < wide[1]


@pytest.mark.parametrize(
    ("ess", "of_draws", "of_chains"),
    [(1.0, 3.0, 1.0), (5.0, 3.0, 4.0), (40.0, 10.0, 39.0), (200.0, 50.0, 199.0), (201.0, math.inf, math.inf)],
)
def test_degrees_of_freedom_grow_with_what_the_units_are_worth(ess, of_draws, of_chains):
    assert degrees_of_freedom(ess, independent=True) == of_draws
    assert degrees_of_freedom(ess, independent=False) == of_chains


def test_gain_of_monte_carlo_itself_is_one():
    assert gain_over_monte_carlo(0.01, binomial_cov(0.01, 5000), 5000) == pytest.approx(1.0)
    assert math.isnan(gain_over_monte_carlo(0.0, math.inf, 100))
    assert math.isnan(gain_over_monte_carlo(1.0, 0.0, 100))
    assert math.isnan(gain_over_monte_carlo(1e-180, 1.41, 1000))


def lengths_of(inside):
    return np.full(len(inside), inside.shape[1])


def test_correlation_factor_of_frozen_chains_is_length_minus_one():
    inside = np.repeat(np.arange(40)[:, None] < 10, 8, axis=1)
    assert correlation_factor(inside, lengths_of(inside)) == pytest.approx(7.0)


def test_correlation_factor_of_chains_of_length_one_is_zero():
    inside = np.arange(40)[:, None] < 10
    assert correlation_factor(inside, np.ones(40, dtype=int)) == 0.0


def markov_chains(rng, chains, steps, p, stay):
    """Indicator chains that keep their value with probability `stay`, else draw it anew."""
    inside = rng.random((chains, steps)) < p
    keep = rng.random((chains, steps)) < stay
    for t in range(1, steps):
        inside[:, t] = np.where(keep[:, t], inside[:, t - 1], inside[:, t])
    return inside


def test_correlation_factor_predicts_the_variance_of_a_share(rng):
    chains, steps, p, stay, runs = 100, 10, 0.1, 0.8, 1500
    sets = [markov_chains(rng, chains, steps, p, stay) for _ in range(runs)]
    shares = np.array([inside.mean() for inside in sets])
    predicted = [(1 + correlation_factor(s, lengths_of(s))) * p * (1 - p) / (chains * steps) for s in sets]
    # the variance of 1500 shares has a relative standard error of sqrt(2 / 1500) = 3.7 %
    assert np.mean(predicted) == pytest.approx(shares.var(), rel=0.15)


def test_correlation_factor_needs_the_chains_in_their_rows(rng):
    inside = markov_chains(rng, 100, 10, 0.1, 0.8)
    right = correlation_factor(inside, lengths_of(inside))
    mixed = inside.reshape(10, 100).T  # the reshape of the code released with Tian et al.
    assert right > 3.0
    assert correlation_factor(mixed, lengths_of(mixed)) < 0.35 * right


def test_correlation_factor_with_unequal_lengths(rng):
    """Against the sum over all pairs inside a chain, written out."""
    inside = markov_chains(rng, 30, 6, 0.3, 0.7)
    lengths = rng.integers(1, 7, size=30)
    used = [row[:length].astype(float) for row, length in zip(inside, lengths, strict=True)]
    n = sum(len(row) for row in used)
    p = sum(row.sum() for row in used) / n
    pairs = sum(2 * (row[i] * row[j] - p * p) for row in used for i in range(len(row)) for j in range(i + 1, len(row)))
    expected = pairs / (n * p * (1 - p))
    assert expected > 0
    assert correlation_factor(inside, lengths) == pytest.approx(expected)


def test_correlation_factor_is_never_negative():
    inside = np.tile([True, False], (20, 3))
    assert correlation_factor(inside, lengths_of(inside)) == 0.0
    assert correlation_factor(np.ones((4, 3), dtype=bool), np.full(4, 3)) == 0.0
