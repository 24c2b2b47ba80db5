"""A step of cross-entropy in a family of Gaussian mixtures, by expectation-maximisation.

References:
    Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm",
    JRSS B 39, 1977.
    Geyer, Papaioannou and Straub, "Cross entropy-based importance sampling using Gaussian densities
    revisited", Structural Safety 76, 2019 (weighted points).
"""

import numpy as np

from samplers.problem import FloatArray
from samplers.proposals.gaussian import shrink_towards_present, weighted_moments
from samplers.proposals.mixture import GaussianMixture

STEPS = 10
"""Steps of expectation-maximisation per step of cross-entropy; each one raises the objective."""


def fit_mixture_towards(
    now: GaussianMixture, k: int, x: FloatArray, weights: FloatArray, alpha: float
) -> GaussianMixture:
    """Return a mixture of at most k Gaussians nearer to alpha Q + (1 - alpha) P than `now`, which is P.

    Maximises a lower bound of equation 2's objective: the points of Q are shared among the
    components anew in every step, the mass of P stays with the components that it comes from, so
    that its share in their moments is exact. A mixture of one component becomes one of k: these
    are copies of it, and the points are first shared by k-means.

    Args:
        now: The present mixture.
        k: Components at most; fewer where Q has fewer distinct points or alpha = 1 leaves one empty.
        x: Points of Q, shape (n, d).
        weights: Their weights, adding up to 1, shape (n,).
        alpha: Share of Q.
    """
    if len(now.components) == 1:
        shares = _clusters(x, weights, k)
        k = shares.shape[1]
        now = GaussianMixture(np.full(k, 1 / k), [now.components[0]] * k)
    else:
        shares = now.responsibilities(x)
    for _ in range(STEPS):
        fitted = _maximise(now, x, weights[:, None] * shares, alpha)
        if len(fitted.components) < shares.shape[1]:
            return fitted
        shares = fitted.responsibilities(x)
    return fitted


def _maximise(now: GaussianMixture, x: FloatArray, mass: FloatArray, alpha: float) -> GaussianMixture:
    """Return weights, means and covariances for points shared as `mass` (n, k), which adds up to 1."""
    weights, components = [], []
    for weight, component, part in zip(now.weights, now.components, mass.T, strict=True):
        total = float(part.sum())
        share = alpha * total + (1 - alpha) * weight
        if share < np.finfo(np.float64).eps:
            continue
        part = part / total if total > 0 else np.full(len(x), 1 / len(x))
        target = weighted_moments(x, part).mix_with(component.moments, alpha * total / share)
        weights.append(share)
        components.append(shrink_towards_present(target, component, 1 / float(part @ part)))
    return GaussianMixture(np.array(weights) / sum(weights), components)


def _clusters(x: FloatArray, weights: FloatArray, k: int) -> FloatArray:
    """Return to which of at most k clusters each point of x (n, d) belongs, as zeros and ones (n, k)."""
    from sklearn.cluster import KMeans  # over a second to import

    k = min(k, len(np.unique(x, axis=0)))
    labels = KMeans(k, n_init=3, random_state=0).fit(x, sample_weight=weights).labels_
    return np.asarray(labels[:, None] == np.arange(k), dtype=np.float64)
