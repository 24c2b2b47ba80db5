"""Expectation-maximisation for mixtures of any family, and k-means for its first responsibilities.

References:
    Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", JRSS B 39, 1977.
    Geyer, Papaioannou and Straub, "Cross entropy-based importance sampling using Gaussian densities revisited",
    Structural Safety 76, 2019 (weighted points).
    Arthur and Vassilvitskii, "k-means++: the advantages of careful seeding", SODA 2007.
    Lloyd, "Least squares quantization in PCM", IEEE Transactions on Information Theory 28, 1982.
"""

import warnings
from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from samplers.problem import FloatArray

LLOYD_STEPS = 4
"""Times at most that k-means moves its centres; it only has to give expectation-maximisation a start."""

MixtureT = TypeVar("MixtureT")


class Family(Protocol[MixtureT]):
    """A family of mixtures that is fitted to weighted points; it holds the points."""

    def maximise(self, responsibilities: FloatArray) -> MixtureT:
        """Return the likeliest mixture (M-step), given how far each component explains each point, shape (k, n).

        It may drop components.
        """

    def log_terms(self, mixture: MixtureT) -> FloatArray:
        """Return log(weight_j q_j) of the components at the points, shape (k, n)."""


def expectation_maximisation(
    family: Family[MixtureT],
    responsibilities: FloatArray,
    weights: FloatArray,
    max_steps: int,
    least_gain: Callable[[float], float],
) -> tuple[MixtureT, float]:
    """Return the mixture reached from some responsibilities, and its weighted log likelihood.

    Args:
        family: What is fitted, with its points.
        responsibilities: To start from, shape (k, n), columns that add up to 1.
        weights: Of the points, shape (n,).
        max_steps: M-steps at most.
        least_gain: Given the log likelihood, the rise of it with which to go on.
    """
    reached = -np.inf
    for _ in range(max_steps):
        mixture = family.maximise(responsibilities)
        terms = family.log_terms(mixture)
        total = logsumexp(terms, axis=0)
        log_likelihood = float(weights @ total)
        if log_likelihood - reached < least_gain(log_likelihood):
            break
        reached, responsibilities = log_likelihood, np.exp(terms - total)
    return mixture, log_likelihood


def posterior(terms: FloatArray) -> FloatArray:
    """Return how likely each point comes from each component, from log(weight_j q_j), both of shape (k, n)."""
    return np.asarray(np.exp(terms - logsumexp(terms, axis=0)))


def choose_centres(x: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
    """Return at most k of the points x (n, d) as centres (k, d), drawn far from one another (k-means++).

    Each is drawn with a probability proportional to weight times squared distance from those before. There are fewer
    where the points with a weight have fewer distinct places.
    """
    odds, chosen = weights, list[int]()
    while len(chosen) < k and odds.sum() > 0:
        chosen.append(int(rng.choice(len(x), p=odds / odds.sum())))
        odds = weights * np.min([((x - x[j]) ** 2).sum(axis=1) for j in chosen], axis=0)
    return np.asarray(x[chosen])


def k_means(x: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return clusters (n,) of weighted points x (n, d), numbered from 0: k-means++, then Lloyd's steps.

    Two centres that differ by a rounding error may give one cluster, and one without points.

    Args:
        x: Points.
        weights: Shape (n,).
        k: Clusters at most.
        rng: Source of randomness.
    """
    centres = choose_centres(x, weights, k, rng)
    if len(centres) == 1:
        return np.zeros(len(x), dtype=np.int64)
    from sklearn.cluster import KMeans  # slow to import
    from sklearn.exceptions import ConvergenceWarning

    lloyd = KMeans(len(centres), init=centres, n_init=1, max_iter=LLOYD_STEPS, tol=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a cluster without points is no fault
        return np.asarray(lloyd.fit(x, sample_weight=weights).labels_, dtype=np.int64)


def one_hot(labels: NDArray[np.int64], k: int) -> FloatArray:
    """Return responsibilities (k, n) of 0 and 1 from labels (n,)."""
    return np.equal(labels, np.arange(k)[:, None]).astype(np.float64)
