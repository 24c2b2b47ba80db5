"""Expectation-maximisation for mixtures of any family.

References:
    Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", JRSS B 39, 1977.
    Geyer, Papaioannou and Straub, "Cross entropy-based importance sampling using Gaussian densities revisited",
    Structural Safety 76, 2019 (weighted points).
"""

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.proposals.log_sums import log_sum_exp

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
        total = log_sum_exp(terms, axis=0)
        log_likelihood = float(weights @ total)
        if log_likelihood - reached < least_gain(log_likelihood):
            break
        reached, responsibilities = log_likelihood, np.exp(terms - total)
    return mixture, log_likelihood


def posterior(terms: FloatArray) -> FloatArray:
    """Return how likely each point comes from each component, from log(weight_j q_j), both of shape (k, n)."""
    return np.asarray(np.exp(terms - log_sum_exp(terms, axis=0)))


def one_hot(labels: NDArray[np.int64], k: int) -> FloatArray:
    """Return responsibilities (k, n) of 0 and 1 from labels (n,)."""
    return np.equal(labels, np.arange(k)[:, None]).astype(np.float64)
