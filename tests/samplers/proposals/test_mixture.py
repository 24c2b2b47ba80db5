"""Mixtures: densities that integrate to one, draws in proportion, and responsibilities by Bayes' rule."""

import numpy as np
import pytest
from scipy import integrate, stats

from samplers.components import VonMisesFisherNakagami
from samplers.proposals import Gaussian, GaussianMixture, Mixture, posterior

ONE = GaussianMixture(
    np.array([0.25, 0.75]), [Gaussian(np.array([m]), np.array([[s]])) for m, s in ((-2, 0.5), (3, 2))]
)


def test_density_is_the_weighted_sum_and_integrates_to_one():
    x = np.array([[-2.0], [0.0], [3.0]])
    expected = 0.25 * stats.norm.pdf(x[:, 0], -2, 0.5) + 0.75 * stats.norm.pdf(x[:, 0], 3, 2)
    np.testing.assert_allclose(np.exp(ONE.log_prob(x)), expected)
    total, _ = integrate.quad(lambda u: float(np.exp(ONE.log_prob(np.array([[u]])))[0]), -12, 20)
    assert total == pytest.approx(1.0, abs=1e-6)


def test_draws_follow_the_distribution(rng):
    """Kolmogorov-Smirnov against the exact distribution function; the order of draws says nothing about components."""
    u = ONE.sample(20_000, rng)[:, 0]
    assert stats.kstest(u, lambda x: 0.25 * stats.norm.cdf(x, -2, 0.5) + 0.75 * stats.norm.cdf(x, 3, 2)).pvalue > 1e-3
    assert abs(u[:10_000].mean() - u[10_000:].mean()) < 4 * u.std() * np.sqrt(2 / 10_000)


def test_terms_give_responsibilities():
    """At the middle between two equal Gaussians both are as likely as their weights."""
    mixture = GaussianMixture(np.array([0.2, 0.8]), [Gaussian(np.array([m]), np.eye(1)) for m in (-1.0, 1.0)])
    np.testing.assert_allclose(posterior(mixture.log_terms(np.zeros((1, 1))))[:, 0], [0.2, 0.8])


def test_components_of_different_kinds(rng):
    parts = [Gaussian.standard(3), VonMisesFisherNakagami(np.eye(3)[0], 20.0, 10.0, 16.0)]
    mixture = Mixture(np.array([0.5, 0.5]), parts)
    u = Gaussian(np.zeros(3), 3 * np.eye(3)).sample(100_000, rng)
    ratio = np.exp(mixture.log_prob(u) - Gaussian(np.zeros(3), 3 * np.eye(3)).log_prob(u))
    assert ratio.mean() == pytest.approx(1.0, abs=4 * ratio.std() / np.sqrt(len(u)))


def test_widening_keeps_weights_and_means():
    wide = ONE.widen(3.0)
    np.testing.assert_array_equal(wide.weights, ONE.weights)
    for before, after in zip(ONE.components, wide.components, strict=True):
        np.testing.assert_array_equal(after.mean, before.mean)
        np.testing.assert_allclose(after.covariance, 9 * before.covariance)
