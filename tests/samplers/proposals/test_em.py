"""Expectation-maximisation with any family."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from samplers.proposals import Gaussian, Mixture, expectation_maximisation, k_means, one_hot, posterior


@dataclass
class UnitVariance:
    """Mixtures of N(mean, I): the textbook M-step; it keeps the log likelihoods that it saw."""

    u: np.ndarray
    weights: np.ndarray

    def __post_init__(self):
        self.seen = []

    def maximise(self, responsibilities):
        mass = responsibilities * self.weights
        totals = mass.sum(axis=1)
        means = mass @ self.u / totals[:, None]
        return Mixture(totals / totals.sum(), [Gaussian(mean, np.eye(len(mean))) for mean in means])

    def log_terms(self, mixture):
        self.seen.append(float(self.weights @ mixture.log_prob(self.u)))
        return mixture.log_terms(self.u)


def two_groups(rng, n=2000):
    """0.25 of the points around (-3, 0), the others around (3, 1)."""
    first = rng.random(n) < 0.25
    return rng.standard_normal((n, 2)) + np.where(first[:, None], [-3.0, 0.0], [3.0, 1.0])


def fit(u, weights, k, rng, steps=60):
    family = UnitVariance(u, weights)
    start = one_hot(k_means(u, weights, k, rng), k)
    return *expectation_maximisation(family, start, weights, steps, lambda _: 1e-8), family


def test_two_gaussians_are_recovered(rng):
    """Standard errors: 1 / sqrt(500) of a mean, 0.01 of a weight; four of each."""
    mixture, _, _ = fit(two_groups(rng), np.full(2000, 1 / 2000), 2, rng)
    order = np.argsort(mixture.weights)
    np.testing.assert_allclose(mixture.weights[order], [0.25, 0.75], atol=0.04)
    means = np.array([mixture.components[j].mean for j in order])
    np.testing.assert_allclose(means, [[-3.0, 0.0], [3.0, 1.0]], atol=4 / np.sqrt(500))


def test_every_step_raises_the_likelihood(rng):
    mixture, reached, family = fit(two_groups(rng) * 0.5, np.full(2000, 1 / 2000), 3, rng)
    assert len(family.seen) > 5
    assert all(after >= before - 1e-12 for before, after in pairwise(family.seen))
    assert reached == pytest.approx(family.seen[-1])
    assert reached == pytest.approx(float(mixture.log_prob(family.u).mean()))


def test_a_weight_of_two_is_a_point_twice(rng):
    u = two_groups(rng, 300)
    weights = np.where(np.arange(300) < 100, 2.0, 1.0)
    start = one_hot((u[:, 0] > 0).astype(np.int64), 2)
    twice = np.concatenate([u, u[:100]])
    start_twice = np.concatenate([start, start[:, :100]], axis=1)
    once, _ = expectation_maximisation(UnitVariance(u, weights / 400), start, weights / 400, 5, lambda _: -np.inf)
    even = np.full(400, 1 / 400)
    both, _ = expectation_maximisation(UnitVariance(twice, even), start_twice, even, 5, lambda _: -np.inf)
    np.testing.assert_allclose(once.weights, both.weights)
    for a, b in zip(once.components, both.components, strict=True):
        np.testing.assert_allclose(a.mean, b.mean)


def test_it_ends_when_the_gain_is_small(rng):
    u, weights = two_groups(rng), np.full(2000, 1 / 2000)
    start = one_hot(k_means(u, weights, 2, rng), 2)
    family = UnitVariance(u, weights)
    expectation_maximisation(family, start, weights, 50, lambda _: np.inf)
    assert len(family.seen) == 2  # one gain has been seen
    family = UnitVariance(u, weights)
    expectation_maximisation(family, start, weights, 7, lambda _: -np.inf)
    assert len(family.seen) == 7


def test_posterior_is_bayes_rule():
    terms = np.log([[0.2 * 0.5, 0.2 * 0.1], [0.8 * 0.1, 0.8 * 0.1]])
    np.testing.assert_allclose(posterior(terms), [[10 / 18, 0.2], [8 / 18, 0.8]])
