import numpy as np
import pytest
from scipy import stats

from samplers.proposals import Gaussian, Mixture, weighted_moments

MEAN = np.array([1.0, -0.5])
COVARIANCE = np.array([[1.5, 0.4], [0.4, 0.6]])


def test_gaussian_density_against_scipy(rng):
    gaussian = Gaussian.from_covariance(MEAN, COVARIANCE)
    u = rng.standard_normal((50, 2)) * 3
    np.testing.assert_allclose(gaussian.log_prob(u), stats.multivariate_normal(MEAN, COVARIANCE).logpdf(u))


def test_gaussian_draws_have_its_moments(rng):
    gaussian = Gaussian.from_covariance(MEAN, COVARIANCE)
    u = gaussian.sample(200_000, rng)
    np.testing.assert_allclose(u.mean(axis=0), MEAN, atol=4 * np.sqrt(1.5 / 200_000))
    np.testing.assert_allclose(np.cov(u.T), COVARIANCE, atol=4 * 1.5 * np.sqrt(2 / 200_000))


def test_moments_and_widening():
    gaussian = Gaussian.from_covariance(MEAN, COVARIANCE)
    np.testing.assert_allclose(gaussian.moments.covariance, COVARIANCE)
    np.testing.assert_allclose(gaussian.widen(2.0).covariance, 4 * COVARIANCE)


def test_weighted_fit_recovers_the_truth(rng):
    """Draws from N(0, I) with weights p / q have the moments of p."""
    target = Gaussian.from_covariance(np.array([0.5, 0.0]), np.diag([0.8, 1.0]))
    base = Gaussian.standard(2)
    u = base.sample(200_000, rng)
    weights = np.exp(target.log_prob(u) - base.log_prob(u))
    moments = weighted_moments(u, weights / weights.sum())
    np.testing.assert_allclose(moments.first, target.mean, atol=0.02)
    np.testing.assert_allclose(moments.covariance, target.covariance, atol=0.04)


def test_mixture_density_and_draws(rng):
    one, two = Gaussian.standard(2), Gaussian.from_covariance(MEAN + 3, COVARIANCE)
    mixture = Mixture(np.array([0.3, 0.7]), [one, two])
    u = mixture.sample(50_000, rng)
    expected = np.log(0.3 * np.exp(one.log_prob(u)) + 0.7 * np.exp(two.log_prob(u)))
    np.testing.assert_allclose(mixture.log_prob(u), expected)
    se = u.std(axis=0) / np.sqrt(len(u))
    assert (np.abs(u.mean(axis=0) - 0.7 * two.mean) < 4 * se).all()


def test_importance_weights_average_to_one(rng):
    """E_q[p0 / q] = 1 for a defensive mixture q, whose weights are at most 1 / base share."""
    base = Gaussian.standard(3)
    far = Gaussian.from_covariance(np.full(3, 1.5), 0.3 * np.eye(3))
    mixture = Mixture(np.array([0.1, 0.9]), [base, far])
    u = mixture.sample(100_000, rng)
    weights = np.exp(base.log_prob(u) - mixture.log_prob(u))
    assert weights.max() <= 10.0 * (1 + 1e-12)
    assert weights.mean() == pytest.approx(1.0, abs=4 * weights.std() / np.sqrt(len(u)))
