"""Expectation-maximisation with any family, and k-means."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from samplers.proposals.em import choose_centres, expectation_maximisation, k_means, one_hot, posterior
from samplers.proposals.gaussian import Gaussian
from samplers.proposals.mixture import Mixture


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


def test_centres_are_far_apart_and_distinct(rng):
    """Ten tight groups: squared distances leave a second centre in one group a chance of 1e-3 at most."""
    groups = 100.0 * np.eye(10)
    x = np.repeat(groups, 20, axis=0) + 0.01 * rng.standard_normal((200, 10))
    centres = choose_centres(x, np.full(200, 1 / 200), 10, rng)
    assert sorted(np.argmax(centres, axis=1)) == list(range(10))
    assert len(choose_centres(np.ones((5, 2)), np.ones(5), 3, rng)) == 1
    only = choose_centres(np.arange(6.0)[:, None], np.array([0, 0, 1.0, 0, 0, 0]), 3, rng)
    np.testing.assert_array_equal(only, [[2.0]])


def test_k_means_finds_the_groups(rng):
    x = np.repeat([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]], 30, axis=0) + rng.standard_normal((90, 2))
    labels = k_means(x, np.ones(90), 3, rng)
    assert len({tuple(labels[30 * j : 30 * j + 30]) for j in range(3)}) == 3
    assert all(len(set(labels[30 * j : 30 * j + 30])) == 1 for j in range(3))


def test_k_means_with_fewer_places_than_clusters(rng):
    """Two places, with a rounding error in each: no warning, and no cluster has points of both."""
    x = np.repeat([[1.0, 2.0], [-1.0, 0.5]], 20, axis=0) * (1 + 1e-16 * rng.integers(-3, 4, (40, 2)))
    labels = k_means(x, np.full(40, 1 / 40), 5, rng)
    assert labels.min() >= 0 and labels.max() < 5
    assert not set(labels[:20]) & set(labels[20:])
    np.testing.assert_array_equal(k_means(x, np.full(40, 1 / 40), 1, rng), np.zeros(40))


def test_k_means_ends_where_each_point_is_nearest_to_the_mean_of_its_cluster(rng):
    """Lloyd's fixed point with weights, on groups that four moves are enough for."""
    x = np.repeat([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]], 30, axis=0) + rng.standard_normal((90, 2))
    weights = rng.random(90)
    labels = k_means(x, weights, 3, rng)
    means = np.array([np.average(x[labels == j], axis=0, weights=weights[labels == j]) for j in range(3)])
    np.testing.assert_array_equal(((x[:, None] - means) ** 2).sum(axis=2).argmin(axis=1), labels)
