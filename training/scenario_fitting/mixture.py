"""Gaussian mixtures fitted to events, truncated to a box; the Bayesian information criterion selects the components."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr
from sklearn.mixture import GaussianMixture

from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture
from samplers.problem import FloatArray

MAX_COMPONENTS = 5
"""Most components that are tried."""
EVENTS_PER_COMPONENT = 10
"""Events per component and dimension that a number of components needs to be tried."""
SMALLEST_COMPONENT = 5
"""Events per dimension below which a component has collapsed on a handful of them."""
COVARIANCE_FLOOR = 0.01
"""Added to variances of standardised data: a tenth of a standard deviation."""
EM_STARTS = 20
"""Starts of expectation maximisation for each number of components."""
MASS_SAMPLES = 1_000_000
"""Draws from which the mass outside the box is estimated."""


@dataclass(frozen=True)
class MixtureCandidate:
    """A fit with one number of components."""

    components: int
    bic: float
    smallest: float
    """Events in the smallest component (sum of its responsibilities)."""
    accepted: bool
    """False if a component has collapsed on a handful of events."""


@dataclass(frozen=True)
class MixtureFit:
    """A fitted base distribution, and the fits that it was selected from.

    Example:
        >>> points = np.random.default_rng(0).standard_normal((60, 2))
        >>> fit = select_mixture(points, np.full(2, -5.0), np.full(2, 5.0))
        >>> [candidate.components for candidate in fit.candidates]
        [1, 2, 3]
    """

    mixture: TruncatedGaussianMixture
    candidates: tuple[MixtureCandidate, ...]


def select_mixture(
    points: FloatArray, low: FloatArray, high: FloatArray, seed: int = 0, most: int = MAX_COMPONENTS
) -> MixtureFit:
    """Return the Gaussian mixture with the least BIC, truncated to a box.

    For K = 1, 2, ... while there are `EVENTS_PER_COMPONENT` d events per component: expectation maximisation on
    standardised data from `EM_STARTS` seeded starts, with a floor under the covariances. Fits with a component of
    fewer than `SMALLEST_COMPONENT` d events are rejected.

    Args:
        points: Events, shape (n, d), with n > d.
        low: Lower ends of the box, shape (d,).
        high: Upper ends of the box, shape (d,).
        seed: Seed of the starts; the same seed gives the same fit.
        most: Largest number of components to try.

    Raises:
        ValueError: There are no more events than parameters, or one of them does not vary.

    Example:
        >>> points = np.random.default_rng(0).standard_normal((60, 2))
        >>> fit = select_mixture(points, np.full(2, -5.0), np.full(2, 5.0))
        >>> fit.mixture.weights.tolist()
        [1.0]
    """
    n, d = points.shape
    if n <= d:
        raise ValueError(f"{n} events are too few to fit {d} parameters; more than {d} are needed.")
    centre, scale = points.mean(axis=0), points.std(axis=0)
    if (scale == 0).any():
        raise ValueError(f"Parameter {int(np.argmin(scale))} is the same in all {n} events.")
    standard = (points - centre) / scale
    most = int(np.clip(n // (EVENTS_PER_COMPONENT * d), 1, most))
    models = [_run_em(standard, k, seed) for k in range(1, most + 1)]
    candidates = tuple(_assess(model, standard) for model in models)
    accepted = [i for i, candidate in enumerate(candidates) if candidate.accepted]
    best = models[min(accepted, key=lambda i: candidates[i].bic)]
    covariances = best.covariances_ * np.outer(scale, scale)
    mixture = _round_mixture(best.weights_, centre + best.means_ * scale, covariances, low, high)
    return MixtureFit(mixture, candidates)


def _run_em(standard: FloatArray, components: int, seed: int) -> Any:
    """Return the best model of several runs of expectation maximisation."""
    model = GaussianMixture(
        components,
        covariance_type="full",
        tol=1e-6,
        reg_covar=COVARIANCE_FLOOR,
        max_iter=5000,
        n_init=EM_STARTS,
        random_state=seed,
    )
    return model.fit(standard)


def _assess(model: Any, standard: FloatArray) -> MixtureCandidate:
    """Return BIC and smallest component of a model."""
    n, d = standard.shape
    smallest = float(model.weights_.min() * n)
    accepted = model.n_components == 1 or smallest >= SMALLEST_COMPONENT * d
    return MixtureCandidate(model.n_components, float(model.bic(standard)), smallest, accepted)


def _round_mixture(
    weights: FloatArray, means: FloatArray, covariances: FloatArray, low: FloatArray, high: FloatArray
) -> TruncatedGaussianMixture:
    """Return the mixture to six significant digits, heaviest component first.

    More digits would say nothing about the traffic and differ between machines.
    """
    order = np.argsort(-weights)
    shares = np.round(weights[order], 6)
    shares[0] = 1.0 - shares[1:].sum()
    symmetric = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    return TruncatedGaussianMixture(
        shares, _round_significant(means[order]), _round_significant(symmetric[order]), low, high
    )


def _round_significant(values: FloatArray) -> FloatArray:
    """Return values to six significant digits."""
    rounded = np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[np.float64])(values)
    return np.asarray(rounded, dtype=np.float64)


def append_independent(joint: TruncatedGaussianMixture, apart: TruncatedGaussianMixture) -> TruncatedGaussianMixture:
    """Return the joint distribution of two independent parts: a mixture, followed by one of a single component."""
    d, k = joint.dim + apart.dim, len(joint.weights)
    covariances = np.zeros((k, d, d))
    covariances[:, : joint.dim, : joint.dim] = joint.covariances
    covariances[:, joint.dim :, joint.dim :] = apart.covariances
    means = np.hstack([joint.means, np.repeat(apart.means, k, axis=0)])
    low, high = np.append(joint.low, apart.low), np.append(joint.high, apart.high)
    return TruncatedGaussianMixture(joint.weights, means, covariances, low, high)


def mass_outside(mixture: TruncatedGaussianMixture, seed: int = 0) -> dict[str, Any]:
    """Return the probability that the box cuts away from the untruncated mixture.

    Returns:
        `any`: probability that some coordinate is outside, with its `standard_error` (Monte Carlo);
        `each`: the same per coordinate, from the marginals.
    """
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(MASS_SAMPLES, mixture.weights)
    outside = 0
    for n, mean, covariance in zip(counts, mixture.means, mixture.covariances, strict=True):
        x = mean + rng.standard_normal((n, mixture.dim)) @ np.linalg.cholesky(covariance).T
        outside += int(((x < mixture.low) | (x > mixture.high)).any(axis=1).sum())
    p = outside / MASS_SAMPLES
    scale = np.sqrt(np.diagonal(mixture.covariances, axis1=1, axis2=2))
    below = ndtr((mixture.low - mixture.means) / scale)
    above = ndtr((mixture.means - mixture.high) / scale)
    each = mixture.weights @ (below + above)
    return {
        "any": p,
        "standard_error": float(f"{np.sqrt(p * (1.0 - p) / MASS_SAMPLES):.2g}"),
        "each": [float(f"{value:.3g}") for value in each],
    }
