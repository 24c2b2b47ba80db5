"""Statistics against SciPy, by hand and by draws."""

import numpy as np
import pytest
from scipy import stats

from samplers.mcmc import correlation_factor
from samplers.sample import (
    PRIOR_SHARE,
    add_unseen,
    clopper_pearson,
    confidence_sequence,
    effective_sample_size,
    log_normal_interval,
    next_level,
    normalise_weights,
)


def test_clopper_pearson_against_scipy():
    for hits in (0, 1, 7, 49, 50):
        exact = stats.binomtest(hits, 50).proportion_ci(0.9, method="exact")
        np.testing.assert_allclose(clopper_pearson(hits, 50, 0.9), exact)


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
    predicted = [(1 + correlation_factor(s, np.full(chains, steps))) * p * (1 - p) / (chains * steps) for s in sets]
    # the variance of 1500 shares has a relative standard error of sqrt(2 / 1500) = 3.7 %
    assert np.mean(predicted) == pytest.approx(shares.var(), rel=0.15)


def test_gamma_as_soon_as_enough_points_fail():
    f = np.arange(100.0)
    assert next_level(f, 0.1, 9.0) == 9.0  # ten points, exactly the fraction
    assert next_level(f, 0.1, 50.0) == 50.0
    assert next_level(f, 0.1, 8.0) == 9.0
    f = np.concatenate([np.full(930, 10.0), np.linspace(1, 9, 70)])
    assert next_level(f, 0.1, 0.0) == 9.0  # ties at a cap give the largest value below
    assert next_level(np.array([10.0] * 95 + [-1.0] * 5), 0.1, 0.0) == 0.0  # never past gamma


def test_the_upper_end_is_the_quantile_of_both_errors_together():
    """Against a million draws of p exp(s Z) / (1 - M)."""
    rng = np.random.default_rng(0)
    n = 10**6
    for lineages, sigma in ((4, 0.02), (25, 0.05), (200, 0.3), (25, 0.3)):
        z, m = rng.standard_normal(n), rng.beta(PRIOR_SHARE, lineages, n)
        high = np.exp(stats.norm.ppf(0.975) * sigma)
        assert add_unseen(1e-3, 1e-3 * high, lineages, 0.95) / 1e-3 == pytest.approx(
            np.quantile(np.exp(sigma * z) / (1 - m), 0.975), rel=0.01
        )


def test_a_confidence_sequence_holds_at_all_looks_together():
    """Failures counted at 60 looks: p is ever outside in 5 % of runs at most, where 95 % intervals are in 30 %."""
    rng, runs = np.random.default_rng(0), 200
    hits = rng.poisson(5.0, (runs, 60)).cumsum(axis=1)
    estimates, covs = hits / (5.0 * np.arange(1, 61)), 1 / np.sqrt(np.maximum(hits, 0.5))

    def find_ends(p, cov):
        return confidence_sequence(p, log_normal_interval(p, cov, 0.95), cov, 0.1, 0.95)

    ends = np.vectorize(find_ends)(np.maximum(estimates, 1e-9) / 100, covs)
    missed = ((ends[0] > 0.01) | (ends[1] < 0.01)).any(axis=1).sum()
    assert missed <= stats.binom.ppf(0.999, runs, 0.05)
    assert (np.abs(np.log(estimates[:, 4:])) > 1.96 * covs[:, 4:]).any(axis=1).sum() > 0.2 * runs
    low, high = confidence_sequence(1e-3, (8e-4, 1.4e-3), 0.05, 0.05, 0.95)  # at its target: 3.036 in place of 1.960
    assert np.log([low, high]) == pytest.approx(np.log(1e-3) + 3.036 / 1.960 * np.log([0.8, 1.4]), rel=1e-4)


def test_weights_far_outside_the_range_of_floats():
    log_weights = np.array([-5000.0, -5000.0 + np.log(3)])
    np.testing.assert_allclose(normalise_weights(log_weights), [0.25, 0.75])
    assert effective_sample_size(log_weights) == pytest.approx(1.6)
