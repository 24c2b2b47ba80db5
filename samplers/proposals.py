"""Proposals: Gaussians and mixtures, fitted to weighted points by expectation-maximisation with shrunk covariances.

A covariance that is estimated from few weighted points is drawn towards N(0, I) with one special direction, for points
of one failure region, or towards the present Gaussian of a search, for a step of it.

References:
    Geyer, Papaioannou and Straub, "Cross entropy-based importance sampling using Gaussian densities revisited",
    Structural Safety 76, 2019 (weighted points).
    Stein, "Lectures on the theory of estimation of many parameters", Journal of Soviet Mathematics 34, 1986
    (eigenvalues; put into order again as by Lin and Perlman, "A Monte Carlo comparison of four estimators of a
    covariance matrix", 1985).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.special import logsumexp

from samplers.bases import Gaussian
from samplers.components import expectation_maximisation, shrink_covariance, start_from_centres
from samplers.problem import FloatArray

__all__ = ["Gaussian", "Mixture", "correct_eigenvalues", "fit_proposal_mixture", "fit_shrunk_gaussian"]


class ProposalDistribution(Protocol):
    """A distribution that can be drawn from and whose density is known; all that importance sampling needs."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of k distributions with weights (k,) that add up to 1; those that are widened can `widen`."""

    weights: FloatArray
    components: Sequence[Any]  # each a ProposalDistribution

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        counts = rng.multinomial(n, self.weights)
        parts = [c.sample(int(k), rng) for c, k in zip(self.components, counts, strict=True)]
        return rng.permutation(np.concatenate(parts))

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""
        return np.asarray(logsumexp(self.log_terms(u), axis=0))

    def log_terms(self, u: FloatArray) -> FloatArray:
        """Return log(weight_j q_j) of the components at u (n, d), shape (k, n)."""
        return np.stack([np.log(w) + c.log_prob(u) for w, c in zip(self.weights, self.components, strict=True)])

    def widen(self, factor: float) -> Mixture:
        """Return the mixture with every component more spread out by about this factor."""
        return Mixture(self.weights, [component.widen(factor) for component in self.components])


LEAST_VARIANCE = 1e-8
"""Added to the variance in every direction: points may coincide."""
PRIOR_DIM = 10
"""Above this many dimensions the present covariance counts as more than d + 1 points, in proportion to d."""


def correct_eigenvalues(values: FloatArray, n: float) -> FloatArray:
    """Return the eigenvalues l (d,) of a covariance of n > d points, increasing, without their bias, by Stein.

    Each is divided by 1 - (d - 1) / n + (2 / n) sum_j l_i / (l_i - l_j).
    """
    gaps = values[:, None] - values
    gaps[gaps == 0] = np.inf  # its own, and equal ones
    factors = 1 - (len(values) - 1) / n + (2 / n) * (values[:, None] / gaps).sum(axis=1)
    logs = np.log(values) - np.log(np.where(factors > 0, factors, 1.0))
    return np.asarray(np.exp(isotonic_regression(logs).x))


def fit_shrunk_gaussian(u: FloatArray, weights: FloatArray) -> Gaussian:
    """Return the Gaussian of points u (n, d) with weights (n,), its covariance shrunk by `shrink_covariance`."""
    mean = weights @ u
    covariance = (u * weights[:, None]).T @ u - np.outer(mean, mean)
    v = mean / max(float(np.linalg.norm(mean)), np.finfo(np.float64).tiny)
    along = max(float(v @ covariance @ v), LEAST_VARIANCE)
    shrunk, _ = shrink_covariance(covariance, v, along, 1 / float(weights @ weights))
    return Gaussian.from_covariance(mean, shrunk + LEAST_VARIANCE * np.eye(len(mean)))


def move_gaussian(present: Gaussian, u: FloatArray, weights: FloatArray, share: float) -> Gaussian:
    """Return the Gaussian with the moments of share Q + (1 - share) P, its covariance drawn towards P, the present.

    Q has points u (n, d) with weights (n,); P counts as (d + 1) max(1, d / PRIOR_DIM) points beside the effective ones
    of Q: in many dimensions the noise of a covariance ruins importance weights.
    """
    own = present.covariance
    mean = share * (weights @ u) + (1 - share) * present.mean
    square = share * ((u * weights[:, None]).T @ u) + (1 - share) * (own + np.outer(present.mean, present.mean))
    prior = (present.dim + 1) * max(1.0, present.dim / PRIOR_DIM)
    pull = prior / (prior + 1 / float(weights @ weights))
    return Gaussian.from_covariance(mean, (1 - pull) * (square - np.outer(mean, mean)) + pull * own)


Fit = Callable[[FloatArray, FloatArray], Any]
"""Fits one component, which can `widen`, to points (n, d) with weights (n,) that add up to 1."""


def fit_proposal_mixture(
    fit: Fit, u: FloatArray, weights: FloatArray, most: int, size: int, rng: np.random.Generator
) -> Mixture:
    """Return the mixture of 1 to `most` components, fitted to u (n, d) with weights (n,), by the best BIC.

    The criterion counts the effective number of points, and `size` parameters a component.
    """
    points = 1 / float(weights @ weights)
    best, highest = Mixture(np.ones(1), [fit(u, weights)]), -np.inf
    for k in range(1, most + 1):
        if k * size >= points:  # the criterion means nothing there
            break
        mixture = best if k == 1 else _fit_mixture_of_size(fit, u, weights, k, rng)
        score = points * float(weights @ mixture.log_prob(u)) - 0.5 * (k * size + k - 1) * np.log(points)
        if score <= highest:
            break
        best, highest = mixture, score
    return best


def _fit_mixture_of_size(fit: Fit, u: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> Mixture:
    """Return a mixture of at most k components by expectation-maximisation, from distant first centres."""

    def maximise(responsibilities: FloatArray) -> Mixture:
        mass = weights * responsibilities
        totals = mass.sum(axis=1)
        kept = totals > min(0.01, 0.5 / k)  # of 1000 points fewer than 10; the heaviest one always stays
        components = [fit(u, part / part.sum()) for part in mass[kept]]
        return Mixture(totals[kept] / totals[kept].sum(), components)

    # Separate regions of failure lie in separate directions from the origin.
    directions = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    start = start_from_centres(directions, weights, k, rng)
    mixture, _ = expectation_maximisation(
        maximise, lambda mixture: mixture.log_terms(u), start, weights, 50, lambda _: 1e-3
    )
    return mixture
