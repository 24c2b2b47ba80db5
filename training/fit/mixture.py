"""Gaussian mixtures fitted to events; the Bayesian information criterion selects the number of components.

Steps, starts and the rule that ends them are those of scikit-learn's `GaussianMixture` (McLachlan, Peel, "Finite
mixture models", 2000, chapter 3). A recipe has thousands of fits to few events, and nearly all of scikit-learn's time
goes into calls on small arrays: here S starts share them. Log densities and moments are products of matrices with the
monomials of the points, 1, x_i and x_i x_j; points must be standardised, or their sums would cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from sklearn.cluster import KMeans
from sklearn.utils import check_random_state

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
TOLERANCE, EM_ITERATIONS = 1e-6, 5000
"""Change of the mean log likelihood below which a start has converged, and most iterations."""
LEAST_MASS = 10 * float(np.finfo(np.float64).eps)
"""Added to the number of points of a component, so that an empty one has a mean."""


class Components(NamedTuple):
    """Components of one Gaussian mixture, or of several behind a first axis."""

    weights: FloatArray
    """Shape (K,), sum 1."""
    means: FloatArray
    """Shape (K, d)."""
    covariances: FloatArray
    """Shape (K, d, d)."""


class Candidate(NamedTuple):
    """A fit with one number of components."""

    number: int
    bic: float
    """Bayesian information criterion, smaller is better."""
    smallest: float
    """Events in the smallest component (sum of its responsibilities)."""
    accepted: bool
    """False if a component has collapsed on a handful of events."""


def select_mixture(
    points: FloatArray,
    seed: int = 0,
    most: int = MAX_COMPONENTS,
    starts: int | None = None,
    names: Sequence[str] = (),
) -> tuple[Components, list[Candidate]]:
    """Return the Gaussian mixture with the least BIC, in units of points (n, d), and all that it was selected from.

    For K = 1, 2, ... while there are `EVENTS_PER_COMPONENT` d events per component: expectation maximisation on
    standardised points from several seeded starts, `EM_STARTS` if None, with a floor under the covariances. Fits
    with a component of fewer than `SMALLEST_COMPONENT` d events are rejected. Messages name the parameters.
    """
    n, d = points.shape
    if n <= d:
        raise ValueError(f"{n} events are too few to fit {d} parameters; more than {d} are needed.")
    centre, scale = points.mean(axis=0), points.std(axis=0)
    if (scale == 0).any():
        which = int(np.argmin(scale))
        name = names[which] if names else f"parameter {which}"
        raise ValueError(f"Expected {name} to vary, got {centre[which]:.6g} in all {n} events.")
    standard, candidates, models = (points - centre) / scale, list[Candidate](), list[Components]()
    # A density in units of the points is smaller by the product of the scales.
    units = 2.0 * n * float(np.log(scale).sum())
    for k in range(1, int(np.clip(n // (EVENTS_PER_COMPONENT * d), 1, most)) + 1):
        model, likelihood = fit_mixture(standard, k, COVARIANCE_FLOOR, seed, EM_STARTS if starts is None else starts)
        smallest = float(model.weights.min() * n)
        bic = -2.0 * likelihood + (k - 1 + k * d + k * d * (d + 1) // 2) * float(np.log(n))
        candidates.append(Candidate(k, bic + units, smallest, k == 1 or smallest >= SMALLEST_COMPONENT * d))
        models.append(model)
    best = models[min((i for i, each in enumerate(candidates) if each.accepted), key=lambda i: candidates[i].bic)]
    mixture = Components(best.weights, centre + best.means * scale, best.covariances * np.outer(scale, scale))
    return _round(mixture), candidates


def _round(mixture: Components) -> Components:
    """Return components to six significant digits, heaviest first: more say nothing and differ between machines."""
    significant = np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[np.float64])
    order = np.argsort(-mixture.weights)
    shares = np.round(mixture.weights[order], 6)
    shares[0] = 1.0 - shares[1:].sum()
    symmetric = 0.5 * (mixture.covariances + mixture.covariances.transpose(0, 2, 1))
    return Components(shares, significant(mixture.means[order]), significant(symmetric[order]))


def append_independent(joint: Components, apart: Components) -> Components:
    """Return the joint distribution of two independent parts: a mixture, followed by one of a single component."""
    k = len(joint.weights)
    covariances = np.array([block_diag(one, apart.covariances[0]) for one in joint.covariances])
    return Components(joint.weights, np.hstack([joint.means, np.repeat(apart.means, k, axis=0)]), covariances)


def fit_mixture(points: FloatArray, components: int, floor: float, seed: int, starts: int) -> tuple[Components, float]:
    """Return the likeliest mixture that k-means starts lead to, and the log likelihood of all points (n, d)."""
    n, d = points.shape
    products = (points[:, :, None] * points[:, None, :]).reshape(n, d * d)
    monomials = np.ascontiguousarray(np.hstack([np.ones((n, 1)), points, products]).T)
    mixtures = _maximise(_start(points, components, seed, starts), monomials, d, floor)
    bounds = np.full(len(mixtures.weights), -np.inf)
    active = np.arange(len(bounds))
    for _ in range(EM_ITERATIONS):
        some = Components(*(values[active] for values in mixtures))
        log_density, responsibilities = _expect(some, monomials)
        for whole, part in zip(mixtures, _maximise(responsibilities, monomials, d, floor), strict=True):
            whole[active] = part
        reached = log_density.mean(axis=1)
        moving = np.abs(reached - bounds[active]) >= TOLERANCE
        bounds[active] = reached
        active = active[moving]
        if not len(active):
            break
    best = int(np.argmax(bounds))
    likelihood = float(_expect(Components(*(values[best : best + 1] for values in mixtures)), monomials)[0].sum())
    return Components(*(values[best] for values in mixtures)), likelihood


def _start(points: FloatArray, components: int, seed: int, starts: int) -> FloatArray:
    """Return which cluster of k-means each point belongs to, 1 or 0, shape (S, K, n); one component has one start."""
    if components == 1:
        return np.ones((1, 1, len(points)))
    random_state = check_random_state(seed)
    clusters = [
        KMeans(n_clusters=components, n_init=1, random_state=random_state).fit(points).labels_ for _ in range(starts)
    ]
    return np.asarray(np.stack(clusters)[:, None] == np.arange(components)[:, None], dtype=np.float64)


def _expect(mixtures: Components, monomials: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log density of each point, shape (S, n), and the responsibilities, shape (S, K, n)."""
    s, k, d = mixtures.means.shape
    precisions = np.linalg.inv(mixtures.covariances)
    linear = (precisions @ mixtures.means[..., None])[..., 0]
    constant = (
        np.log(mixtures.weights)
        - 0.5 * (linear * mixtures.means).sum(axis=-1)
        - 0.5 * np.linalg.slogdet(mixtures.covariances).logabsdet
        - 0.5 * d * np.log(2.0 * np.pi)
    )
    coefficients = np.concatenate([constant[..., None], linear, -0.5 * precisions.reshape(s, k, d * d)], axis=-1)
    log_joint = (coefficients.reshape(s * k, -1) @ monomials).reshape(s, k, -1)
    largest = log_joint.max(axis=1, keepdims=True)
    shares = np.exp(log_joint - largest)
    total = shares.sum(axis=1, keepdims=True)
    return (largest + np.log(total))[:, 0], shares / total


def _maximise(responsibilities: FloatArray, monomials: FloatArray, d: int, floor: float) -> Components:
    """Return the S mixtures of largest expected likelihood given responsibilities (S, K, n)."""
    s, k, n = responsibilities.shape
    sums = (responsibilities.reshape(s * k, n) @ monomials.T).reshape(s, k, -1)
    mass = sums[..., 0] + LEAST_MASS
    means = sums[..., 1 : 1 + d] / mass[..., None]
    second = (sums[..., 1 + d :] / mass[..., None]).reshape(s, k, d, d)
    covariances = second - means[..., :, None] * means[..., None, :] + floor * np.eye(d)
    return Components(mass / mass.sum(axis=1, keepdims=True), means, covariances)
