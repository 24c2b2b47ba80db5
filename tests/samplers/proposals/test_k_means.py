"""k-means: seeding and Lloyd's steps, against their fixed point and scikit-learn."""

import warnings

import numpy as np
import pytest

from samplers.proposals import LLOYD_STEPS, choose_centres, k_means


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


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("k", [2, 3, 6])
def test_k_means_is_that_of_scikit_learn(seed, k):
    """From the same centres; fresh points and uneven weights, some of them 0, with groups and without."""
    cluster = pytest.importorskip("sklearn.cluster")
    rng = np.random.default_rng(seed)
    x = rng.normal(0.0, 1.0, (40, 5)) + 3.0 * (seed % 2) * rng.integers(0, 3, (40, 1))
    weights = rng.exponential(1.0, 40) * (rng.random(40) > 0.2)
    centres = choose_centres(x, weights, k, np.random.default_rng(seed))
    lloyd = cluster.KMeans(len(centres), init=centres, n_init=1, max_iter=LLOYD_STEPS, tol=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = lloyd.fit(x, sample_weight=weights).labels_
    np.testing.assert_array_equal(k_means(x, weights, k, np.random.default_rng(seed)), expected)


def test_a_cluster_that_loses_its_points_takes_the_furthest_one():
    """Where the only point of a cluster has no weight, its mean is not known."""
    x = np.array([[0.0], [1.0], [2.0], [50.0]])
    weights = np.array([1.0, 1.0, 1.0, 0.0])
    labels = k_means(x, weights, 2, np.random.default_rng(0))
    assert set(labels) == {0, 1}
