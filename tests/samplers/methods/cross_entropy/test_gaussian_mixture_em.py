"""A step of cross-entropy in the family of Gaussian mixtures."""

import numpy as np

from samplers.methods.blocks import MixtureBlock, fit_mixture_towards
from samplers.proposals import Gaussian, GaussianMixture


def uniform_weights(n):
    return np.full(n, 1 / n)


def test_mixture_splits_into_two_regions(rng):
    """Two clusters and a step alpha = 1: one component each, with the share and the mean of its cluster."""
    elite = rng.standard_normal((4000, 2)) * 0.3 + np.where(rng.random((4000, 1)) < 0.25, [3.0, 0.0], [-3.0, 1.0])
    moved = MixtureBlock(Gaussian.standard(2), 2).project(elite, uniform_weights(4000), 1.0)
    order = np.argsort(moved.mixture.weights)
    np.testing.assert_allclose(moved.mixture.weights[order], [0.25, 0.75], atol=0.03)
    means = np.array([moved.mixture.components[j].mean for j in order])
    np.testing.assert_allclose(means, [[3.0, 0.0], [-3.0, 1.0]], atol=0.05)
    np.testing.assert_allclose(moved.mixture.components[0].covariance, 0.09 * np.eye(2), atol=0.02)


def test_mixture_steps_raise_the_objective_of_equation_2(rng):
    """alpha E_Q[log p] + (1 - alpha) E_P[log p], by draws; no pull worth mentioning at 20,000 points."""
    elite = rng.standard_normal((20_000, 2)) + np.where(rng.random((20_000, 1)) < 0.3, [3.0, 0.0], [0.0, 3.0])
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, uniform_weights(20_000), 0.5)
    other = elite * [1.0, 0.6]
    values = []
    draws = block.sample(20_000, rng)
    for distribution in (block, block.project(other, uniform_weights(20_000), 0.7)):
        values.append(0.7 * distribution.log_prob(other).mean() + 0.3 * distribution.log_prob(draws).mean())
    assert values[1] > values[0] + 0.01


def test_mixture_keeps_the_share_1_minus_alpha_of_the_present_distribution():
    """All of Q in one point: with alpha = 0.8 the mean of the new mixture is 0.8 of the way there."""
    elite = np.tile([2.0, 1.0], (50, 1))
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, uniform_weights(50), 0.8)
    mean = sum(w * c.mean for w, c in zip(block.mixture.weights, block.mixture.components, strict=True))
    np.testing.assert_allclose(mean, [1.6, 0.8])
    x = np.random.default_rng(1).standard_normal((100, 2))
    start = MixtureBlock(Gaussian.standard(2), 3)
    np.testing.assert_allclose(start.log_prob(x), Gaussian.standard(2).log_prob(x))


def test_a_component_without_points_is_left_out():
    """With alpha = 1 the present mixture has no say: all points at the first mean leave the second component empty."""
    far = GaussianMixture(np.array([0.5, 0.5]), [Gaussian(np.full(2, mean), np.eye(2)) for mean in (0.0, 60.0)])
    x = np.random.default_rng(0).standard_normal((500, 2))
    moved = fit_mixture_towards(far, 2, x, uniform_weights(500), 1.0)
    np.testing.assert_array_equal(moved.weights, [1.0])
    np.testing.assert_allclose(moved.components[0].mean, x.mean(axis=0), atol=1e-12)


def test_equal_points_give_equal_mixtures():
    x = np.random.default_rng(1).standard_normal((300, 2))
    start = GaussianMixture(np.ones(1), [Gaussian.standard(2)])
    first, second = (fit_mixture_towards(start, 3, x, uniform_weights(300), 0.8) for _ in range(2))
    np.testing.assert_array_equal(first.weights, second.weights)
