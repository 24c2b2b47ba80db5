"""Mixtures fitted to weighted points by maximum likelihood, their number of components by the Bayesian criterion."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from samplers.problem import FloatArray
from samplers.proposals.em import expectation_maximisation, one_hot
from samplers.proposals.k_means import choose_centres
from samplers.proposals.mixture import Mixture, ProposalDistribution


class WidenableDistribution(ProposalDistribution, Protocol):
    """A component of a mixture that can be widened."""

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
MAX_EM_STEPS = 50
"""M-steps at most."""
LEAST_EM_GAIN = 1e-3
"""Expectation-maximisation ends where a step raises the mean log likelihood by less."""
LEAST_WEIGHT = 0.01
"""Components of less weight are dropped: with 1000 points they would rest on fewer than 10."""
LEAST_OF_EVEN_SHARE = 0.5
"""Of more than 50 components, those with less than this share of 1 / k are: the heaviest one always stays."""


def fit_proposal_mixture(
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


@dataclass(frozen=True, eq=False)
class _WeightedPoints:
    """Mixtures with k components at most that are fitted to weighted points, see `samplers.proposals.em.Family`."""

    fit: Fit
    u: FloatArray
    weights: FloatArray
    k: int

    def maximise(self, responsibilities: FloatArray) -> WidenableMixture:
        """Return the mixture of the components that have weight enough."""
        mass = self.weights * responsibilities
        totals = mass.sum(axis=1)
        kept = totals > min(LEAST_WEIGHT, LEAST_OF_EVEN_SHARE / self.k)
        components = [self.fit(self.u, part / part.sum()) for part in mass[kept]]
        return WidenableMixture(totals[kept] / totals[kept].sum(), components)

    def log_terms(self, mixture: WidenableMixture) -> FloatArray:
        """Return log(weight_j q_j) of the components at the points, shape (k, n)."""
        return mixture.log_terms(self.u)


def fit_mixture_of_size(
    fit: Fit, u: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator
) -> WidenableMixture:
    """Return a mixture of at most k components by expectation-maximisation, from distant first centres."""
    family = _WeightedPoints(fit, u, weights, k)
    start = initial_responsibilities(u, weights, k, rng)
    mixture, _ = expectation_maximisation(family, start, weights, MAX_EM_STEPS, lambda _: LEAST_EM_GAIN)
    return mixture


def initial_responsibilities(u: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
    """Return to which of k centres each point is nearest in direction, as zeros and ones (k, n).

    Directions, as separate regions of failure lie in separate directions from the origin.
    """
    a = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    centres = choose_centres(a, weights, k, rng)
    distances = np.stack([((a - centre) ** 2).sum(axis=1) for centre in centres])
    return one_hot(distances.argmin(axis=0), k)
