"""Weighted maximum likelihood: one component, or a mixture by expectation-maximisation.

References:
    Geyer, Papaioannou and Straub, "Cross entropy-based importance sampling using Gaussian densities
    revisited", Structural Safety 76, 2019 (expectation-maximisation for weighted points).
    Ledoit and Wolf, "A well-conditioned estimator for large-dimensional covariance matrices",
    Journal of Multivariate Analysis 88, 2004 (how much to shrink).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from samplers.problem import FloatArray
from samplers.proposals.gaussian import Gaussian, weighted_moments
from samplers.proposals.mixture import Mixture, ProposalDistribution


class WidenableDistribution(ProposalDistribution, Protocol):
    """A law that a mixture is made of."""

    def widen(self, factor: float) -> "WidenableDistribution":
        """Return the same, more spread out by about this factor."""


@dataclass(frozen=True, eq=False)
class WidenableMixture(Mixture):
    """A mixture of distributions that can be widened."""

    components: Sequence[WidenableDistribution]

    def widen(self, factor: float) -> "WidenableMixture":
        """Return the mixture with every component more spread out by about this factor."""
        return WidenableMixture(self.weights, [component.widen(factor) for component in self.components])


Fit = Callable[[FloatArray, FloatArray], WidenableDistribution]
"""Fits one component to points (n, d) with weights (n,) that add up to 1."""
STEPS = 50
"""Steps of expectation-maximisation at most."""
TOLERANCE = 1e-3
"""It ends where a step raises the mean log likelihood by less."""
LEAST_WEIGHT = 0.01
"""Components of less weight are dropped."""
LEAST_VARIANCE = 1e-8
"""Of a component, in any direction: points may coincide."""


def fit_shrunk_gaussian(u: FloatArray, weights: FloatArray) -> Gaussian:
    """Return the Gaussian of weighted points, its covariance drawn towards a simple one.

    The target is I but for the variance along the mean, T = I + (l - 1) v v': what N(0, I) beyond a plane
    has. The weight of T is the expected square error of the covariance S over its distance from T (Ledoit
    and Wolf), at least what d + 1 points beside the effectively n of the weights are worth: T where n is
    small for d, S where it is large.

    Args:
        u: Shape (n, d).
        weights: Adding up to 1, shape (n,).
    """
    dim, n = u.shape[1], 1 / float(weights @ weights)
    moments = weighted_moments(u, weights)
    mean, s = moments.first, moments.covariance
    v = mean / max(float(np.linalg.norm(mean)), np.finfo(np.float64).tiny)
    target = np.eye(dim) + (max(float(v @ s @ v), LEAST_VARIANCE) - 1) * np.outer(v, v)
    noise = (float(np.trace(s)) ** 2 + float((s * s).sum())) / n
    distance = float(((s - target) ** 2).sum())
    pull = max(noise / distance if distance > noise else 1.0, (dim + 1) / (2 * (dim + 1 + n)))
    floor = LEAST_VARIANCE * np.eye(dim)
    return Gaussian.from_covariance(mean, (1 - pull) * s + pull * target + floor)


def fit_mixture(
    fit: Fit, u: FloatArray, weights: FloatArray, most: int, size: int, rng: np.random.Generator
) -> WidenableMixture:
    """Return the mixture of 1 to `most` components with the best Bayesian information criterion.

    The criterion counts the effective number of points, (sum w)^2 / sum w^2. More components are tried for
    as long as they raise it.

    Args:
        fit: Fits one component.
        u: Points, shape (n, d).
        weights: Adding up to 1, shape (n,).
        most: Components at most.
        size: Parameters of one component.
        rng: Source of randomness, for the first centres.
    """
    points = 1 / float(weights @ weights)
    best, highest = WidenableMixture(np.ones(1), [fit(u, weights)]), -np.inf
    for k in range(1, most + 1):
        if k * size >= points:  # the criterion means nothing there
            break
        mixture = best if k == 1 else fit_mixture_of_size(fit, u, weights, k, rng)
        score = points * float(weights @ mixture.log_prob(u)) - 0.5 * (k * size + k - 1) * np.log(points)
        if score <= highest:
            break
        best, highest = mixture, score
    return best


def fit_mixture_of_size(
    fit: Fit, u: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator
) -> WidenableMixture:
    """Return a mixture of at most k components by expectation-maximisation, from distant first centres."""
    shares = initial_responsibilities(u, weights, k, rng)
    reached = -np.inf
    for _ in range(STEPS):
        mass = weights[:, None] * shares
        kept = mass.sum(axis=0) > min(LEAST_WEIGHT, 0.5 / k)
        totals = mass.sum(axis=0)[kept]
        components = [fit(u, part / part.sum()) for part in mass.T[kept]]
        mixture = WidenableMixture(totals / totals.sum(), components)
        terms = np.stack([np.log(w) + c.log_prob(u) for w, c in zip(mixture.weights, components, strict=True)], axis=1)
        highest = terms.max(axis=1, keepdims=True)
        odds = np.exp(terms - highest)
        total = odds.sum(axis=1, keepdims=True)
        likelihood = float(weights @ (highest + np.log(total))[:, 0])
        if likelihood < reached + TOLERANCE:
            break
        reached, shares = likelihood, odds / total
    return mixture


def initial_responsibilities(u: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
    """Return to which of k centres each point is nearest in direction, as zeros and ones (n, k).

    Centres are points drawn by weight times squared distance from those before (k-means++). Directions, as
    separate regions of failure lie in separate directions from the origin.
    """
    a = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    distances = np.full((len(u), k), np.inf)
    odds = weights
    for j in range(k):
        centre = a[rng.choice(len(u), p=odds / odds.sum())]
        distances[:, j] = ((a - centre) ** 2).sum(axis=1)
        odds = weights * distances.min(axis=1)
        if not odds.sum() > 0:  # fewer distinct directions than centres
            break
    return np.asarray(distances.argmin(axis=1)[:, None] == np.arange(k), dtype=np.float64)
