"""Distribution of the last layer's weights: density, draws and maps against each other, arrays, and as a block."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from agents.learned.networks import RADIUS, WeightDistribution
from samplers.methods.blocks import announced_blocks

PRECISION = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, -0.5], [0.0, -0.5, 2.0]])
MEAN = np.array([1.0, -2.0, 0.5])


@pytest.fixture
def small():
    return WeightDistribution(MEAN, PRECISION)


def test_draws_have_mean_and_covariance(small, rng):
    n, covariance = 200_000, np.linalg.inv(PRECISION)
    x = small.sample(n, rng)
    np.testing.assert_allclose(x.mean(axis=0), MEAN, atol=4 * np.sqrt(covariance.max() / n))
    np.testing.assert_allclose(np.cov(x.T), covariance, atol=4 * covariance.max() * np.sqrt(2 / n))


def test_maps_are_inverse_and_density_is_theirs(weight_distribution, rng):
    """log p(x) = log phi(u) - log |dx / du| at u = the point in standard normal space."""
    u = rng.standard_normal((20, weight_distribution.dim))
    x = weight_distribution.from_standard_normal(u)
    np.testing.assert_allclose(weight_distribution.to_standard_normal(x), u, atol=1e-10)
    _, log_det = np.linalg.slogdet(weight_distribution.precision)
    np.testing.assert_allclose(
        weight_distribution.log_prob(x), stats.norm.logpdf(u).sum(axis=1) + 0.5 * log_det, rtol=1e-12
    )
    np.testing.assert_allclose(
        weight_distribution.covariance @ weight_distribution.precision, np.eye(weight_distribution.dim), atol=1e-8
    )
    np.testing.assert_array_equal(weight_distribution.cholesky, np.tril(weight_distribution.cholesky))


def test_arrays_bring_back_the_same_distribution(weight_distribution):
    arrays = weight_distribution.to_arrays()
    again = WeightDistribution.from_arrays(arrays, weight_distribution.radius)
    np.testing.assert_array_equal(again.mean, weight_distribution.mean)
    np.testing.assert_array_equal(again.precision, weight_distribution.precision)
    assert sum(array.nbytes for array in arrays.values()) < 0.1 * weight_distribution.precision.nbytes


def test_it_is_a_block_whose_mean_stays_in_the_box(weight_distribution, rng):
    base = SimpleNamespace(
        blocks=(
            weight_distribution,
            SimpleNamespace(alpha=np.full(2, 2.0), beta=np.full(2, 2.0), low=np.zeros(2), high=np.ones(2)),
        ),
        log_prob=lambda x: weight_distribution.log_prob(x[:, :404]) + stats.beta(2, 2).logpdf(x[:, 404:]).sum(axis=1),
    )
    product = announced_blocks(SimpleNamespace(base=base, dim=406))
    x = product.sample(300, rng)
    wanted = np.full((2, 300), 1 / 300)
    x[:, :404] += 0.05  # asks for means far outside the box
    moved = product.project(x, wanted, 0.8)
    shift = moved.sample(20_000, rng)[:, :404].mean(axis=0) - weight_distribution.mean
    assert np.abs(shift).max() < RADIUS + 5 * np.sqrt(weight_distribution.covariance.max()) / np.sqrt(20_000)
    assert np.abs(shift).max() > 0.5 * RADIUS


@pytest.mark.parametrize(
    ("mean", "precision", "radius", "message"),
    [
        (MEAN, PRECISION[:2], 0.01, "got \\(3,\\) and \\(2, 3\\)"),
        (MEAN * np.nan, PRECISION, 0.01, "finite"),
        (MEAN, PRECISION + np.triu(np.ones((3, 3)), 1), 0.01, "symmetric"),
        (MEAN, -PRECISION, 0.01, "positive definite"),
        (MEAN, PRECISION, -1.0, "radius"),
        (MEAN, PRECISION, np.nan, "radius"),
    ],
)
def test_what_is_no_law_is_refused(mean, precision, radius, message):
    with pytest.raises(ValueError, match=message):
        WeightDistribution(mean, precision, radius)


def test_arrays_that_are_no_upper_triangle_are_refused(small):
    arrays = small.to_arrays()
    with pytest.raises(ValueError, match="upper triangle"):
        WeightDistribution.from_arrays({**arrays, "columns": arrays["columns"] + 1})
    with pytest.raises(ValueError, match="one length"):
        WeightDistribution.from_arrays({**arrays, "precision": arrays["precision"][1:]})


def test_gradients_are_pulled_back_by_the_map(small, rng):
    """g(u) = a.x(u) is linear: its gradient is its value at the unit vectors less that at 0."""
    a = rng.standard_normal(3)
    expected = small.from_standard_normal(np.eye(3)) @ a - MEAN @ a
    np.testing.assert_allclose(small.pull_back(rng.standard_normal((2, 3)), np.tile(a, (2, 1))), [expected] * 2)
