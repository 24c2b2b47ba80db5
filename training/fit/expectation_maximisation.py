"""Expectation maximisation of Gaussian mixtures, all starts at once.

The steps, the starts and the rule that ends them are those of scikit-learn's `GaussianMixture` (McLachlan, Peel,
"Finite mixture models", 2000, chapter 3). A recipe has thousands of fits to few events, and nearly all of
scikit-learn's time goes into calls on small arrays: here the starts share them. Log densities and moments are products
of matrices with the monomials of the points, 1, x_i and x_i x_j; points must be standardised, or their sums would
cancel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from sklearn.utils import check_random_state

from samplers.problem import FloatArray

TOLERANCE = 1e-6
"""Change of the mean log likelihood below which a start has converged."""
EM_ITERATIONS = 5000
LEAST_MASS = 10 * float(np.finfo(np.float64).eps)
"""Added to the number of points of a component, so that an empty one has a mean."""


class EmFit(NamedTuple):
    """A mixture, and how likely the points are under it."""

    weights: FloatArray
    """Shape (K,), sum 1."""
    means: FloatArray
    """Shape (K, d)."""
    covariances: FloatArray
    """Shape (K, d, d)."""
    log_likelihood: float
    """Of all points."""


class _Mixtures(NamedTuple):
    """Several mixtures: weights (S, K), means (S, K, d) and covariances (S, K, d, d)."""

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray

    def select(self, chosen: NDArray[np.int64]) -> _Mixtures:
        return _Mixtures(*(values[chosen] for values in self))


def fit_mixture_of_starts(points: FloatArray, components: int, floor: float, seed: int, starts: int) -> EmFit:
    """Return the likeliest of the mixtures that several starts lead to.

    Each start is a k-means clustering of the points.

    Args:
        points: Standardised points, shape (n, d).
        components: Number of components K.
        floor: Added to the variances of each component.
        seed: Seed of the starts.
        starts: Number of starts; for one component they are all alike.
    """
    monomials = _expand(points)
    mixtures = _maximise(_start(points, components, seed, starts if components > 1 else 1), monomials, floor)
    bounds = np.full(len(mixtures.weights), -np.inf)
    active = np.arange(len(bounds))
    for _ in range(EM_ITERATIONS):
        log_density, responsibilities = _expect(mixtures.select(active), monomials)
        for whole, part in zip(mixtures, _maximise(responsibilities, monomials, floor), strict=True):
            whole[active] = part
        reached = log_density.mean(axis=1)
        moving = np.abs(reached - bounds[active]) >= TOLERANCE
        bounds[active] = reached
        active = active[moving]
        if not len(active):
            break
    best = mixtures.select(np.array([np.argmax(bounds)]))
    log_likelihood = float(_expect(best, monomials)[0].sum())
    return EmFit(best.weights[0], best.means[0], best.covariances[0], log_likelihood)


def _expand(points: FloatArray) -> FloatArray:
    """Return 1, x_i and x_i x_j of each point, shape (1 + d + d^2, n)."""
    n, d = points.shape
    products = (points[:, :, None] * points[:, None, :]).reshape(n, d * d)
    return np.ascontiguousarray(np.hstack([np.ones((n, 1)), points, products]).T)


def _start(points: FloatArray, components: int, seed: int, starts: int) -> FloatArray:
    """Return which cluster each point belongs to, 1 or 0, shape (starts, K, n)."""
    if components == 1:
        return np.ones((starts, 1, len(points)))
    random_state = check_random_state(seed)
    clusters = [
        KMeans(n_clusters=components, n_init=1, random_state=random_state).fit(points).labels_ for _ in range(starts)
    ]
    return np.asarray(np.stack(clusters)[:, None] == np.arange(components)[:, None], dtype=np.float64)


def _expect(mixtures: _Mixtures, monomials: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log density of each point, shape (S, n), and the responsibilities, shape (S, K, n)."""
    log_joint = _log_joint(mixtures, monomials)
    largest = log_joint.max(axis=1, keepdims=True)
    shares = np.exp(log_joint - largest)
    total = shares.sum(axis=1, keepdims=True)
    return (largest + np.log(total))[:, 0], shares / total


def _maximise(responsibilities: FloatArray, monomials: FloatArray, floor: float) -> _Mixtures:
    """Return the mixtures of largest expected likelihood given responsibilities (S, K, n)."""
    s, k, n = responsibilities.shape
    d = _dimension(monomials)
    sums = (responsibilities.reshape(s * k, n) @ monomials.T).reshape(s, k, -1)
    mass = sums[..., 0] + LEAST_MASS
    means = sums[..., 1 : 1 + d] / mass[..., None]
    second = (sums[..., 1 + d :] / mass[..., None]).reshape(s, k, d, d)
    covariances = second - means[..., :, None] * means[..., None, :] + floor * np.eye(d)
    return _Mixtures(mass / mass.sum(axis=1, keepdims=True), means, covariances)


def _log_joint(mixtures: _Mixtures, monomials: FloatArray) -> FloatArray:
    """Return the log densities of component and point, shape (S, K, n)."""
    s, k = mixtures.weights.shape
    d = _dimension(monomials)
    precisions = np.linalg.inv(mixtures.covariances)
    linear = (precisions @ mixtures.means[..., None])[..., 0]
    constant = (
        np.log(mixtures.weights)
        - 0.5 * (linear * mixtures.means).sum(axis=-1)
        - 0.5 * np.linalg.slogdet(mixtures.covariances).logabsdet
        - 0.5 * d * np.log(2.0 * np.pi)
    )
    coefficients = np.concatenate([constant[..., None], linear, -0.5 * precisions.reshape(s, k, d * d)], axis=-1)
    return np.asarray((coefficients.reshape(s * k, -1) @ monomials).reshape(s, k, -1))


def _dimension(monomials: FloatArray) -> int:
    """Return d of 1 + d + d^2 monomials."""
    return round(float(np.sqrt(len(monomials) - 0.75)) - 0.5)
