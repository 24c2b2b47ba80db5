"""Fitting mixtures of bumps to points: expectation-maximisation with careful covariances.

References:
    Ledoit and Wolf, "A well-conditioned estimator for large-dimensional covariance matrices", Journal of
    Multivariate Analysis 88, 2004 (how much to shrink).
    Schwarz, "Estimating the dimension of a model", Annals of Statistics 6, 1978 (BIC).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from samplers.problem import FloatArray
from samplers.proposals.components import SubspaceGaussian, log_ratios
from samplers.statistics.weights import normalise_weights

HIGH_DIM = 40
"""Above this many dimensions a bump has one direction of its own: more cannot be learned from some hundred points."""
STEPS = 25
"""Steps of expectation-maximisation at most."""
RESTARTS = 3


class GroupedPoints(NamedTuple):
    """Weighted points to which bumps are fitted."""

    u: FloatArray
    """Shape (n, d)."""
    weights: FloatArray
    """Adding up to 1, shape (n,)."""
    ess: float
    """How many independent points they are worth."""
    groups: NDArray[np.int64]
    """Points of one group (a chain) belong to one bump; numbers from 0, shape (n,)."""


class SubspaceMixture(NamedTuple):
    """A mixture of bumps."""

    bumps: list[SubspaceGaussian]
    weights: FloatArray
    score: float
    """Log likelihood, in independent points, less the BIC penalty."""


def fit_shrunk_subspace_gaussian(u: FloatArray, weights: FloatArray, ess: float) -> tuple[SubspaceGaussian, float]:
    """Return the bump of weighted points and how much of it is the shrinkage target.

    The covariance S is drawn towards T = I + (l - 1) v v', with v the direction of the mean and l the variance
    along it: one special direction, else standard normal, as beyond a plane. Its share is Ledoit and Wolf's
    b^2 / d^2. Above HIGH_DIM dimensions it is all of it.

    Args:
        u: Points, shape (n, d).
        weights: Adding up to 1, shape (n,).
        ess: How many independent points they are worth.
    """
    dim = u.shape[1]
    mean = weights @ u
    norm = float(np.linalg.norm(mean))
    v = mean / norm if norm > 0 else np.eye(dim)[0]
    along = float(weights @ (u @ v - norm) ** 2)
    if dim > HIGH_DIM:
        # Noise makes the mean of few points too long, by (d - 1) / ess in the square, and turns it.
        excess = min((dim - 1) / (ess * max(norm, 1e-9) ** 2), 0.5)
        variance = np.array([min(along * (1 - excess) + excess, 4.0)])
        return SubspaceGaussian(v[:, None], np.array([norm * (1 - excess)]), inflate_variances(variance, ess)), 1.0
    centred = (u - mean) * np.sqrt(weights)[:, None]
    covariance = centred.T @ centred
    target = np.eye(dim) + (along - 1) * np.outer(v, v)
    noise = (float(np.trace(covariance)) ** 2 + float((covariance * covariance).sum())) / ess
    distance = float(((covariance - target) ** 2).sum())
    share = min(1.0, max(noise / distance if distance > 0 else 1.0, (dim + 1) / (2 * (dim + 1 + ess))))
    values, axes = np.linalg.eigh((1 - share) * covariance + share * target)
    return SubspaceGaussian(axes, axes.T @ mean, inflate_variances(values, ess)), share


def inflate_variances(variance: FloatArray, ess: float) -> FloatArray:
    """Return variances (r,), those under 1 raised by two of their standard errors.

    Too small a variance makes weights unbounded, too large a one costs a few draws.
    """
    variance = np.maximum(variance, 1e-6)
    raised = np.minimum(variance * (1 + 2 * math.sqrt(2 / max(ess, 2.0))), 1.0)
    return np.where(variance < 1, raised, variance)


def fit_mixture(points: GroupedPoints, most: int, rng: np.random.Generator) -> SubspaceMixture:
    """Return a mixture of at most `most` bumps, their number chosen by BIC."""
    best = None
    worse = 0
    for k in (k for k in (1, 2, 3, 4, 6, 8) if k <= most):
        if k > 1 and (k > points.groups.max() + 1 or points.ess < 4 * k):
            break
        restarts = 1 if k == 1 else RESTARTS
        found = max(
            (_run_em(points, _initial_responsibilities(points, k, rng)) for _ in range(restarts)),
            key=lambda mix: mix.score,
        )
        if best is None or found.score > best.score:
            best, worse = found, 0
        else:
            worse += 1
        if worse == 2:
            break
    assert best is not None  # one bump can always be fitted
    return best


def _initial_responsibilities(points: GroupedPoints, k: int, rng: np.random.Generator) -> FloatArray:
    """Return responsibilities (k, n) to start from: clusters of the groups' means."""
    n_groups = int(points.groups.max()) + 1
    mass = np.bincount(points.groups, weights=points.weights, minlength=n_groups).astype(np.float64)
    means = np.zeros((n_groups, points.u.shape[1]))
    np.add.at(means, points.groups, points.u * points.weights[:, None])
    nearest = _clusters(means / np.maximum(mass, 1e-300)[:, None], mass, k, rng)
    return np.equal(nearest[points.groups], np.arange(k)[:, None]).astype(np.float64)


def _clusters(x: FloatArray, mass: FloatArray, k: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return clusters (n,) of points x (n, d): k-means++ and five steps of Lloyd."""
    mass = mass / mass.sum()
    centres = [x[rng.choice(len(x), p=mass)]]
    while len(centres) < k:
        far = np.min([((x - c) ** 2).sum(axis=1) for c in centres], axis=0) * mass
        if far.sum() <= 0:
            break
        centres.append(x[rng.choice(len(x), p=far / far.sum())])
    middle = np.array(centres)
    for _ in range(5):
        near = np.argmin(-2 * x @ middle.T + (middle**2).sum(axis=1), axis=1)
        for j in range(len(middle)):
            if mass[near == j].sum() > 0:
                middle[j] = np.average(x[near == j], axis=0, weights=mass[near == j])
    return np.asarray(near, dtype=np.int64)


def _run_em(points: GroupedPoints, shares: FloatArray) -> SubspaceMixture:
    """Run expectation-maximisation from responsibilities (k, n) until the likelihood rises no more."""
    u, weights, ess, groups = points
    n_groups = int(groups.max()) + 1
    last = -math.inf
    for _ in range(STEPS):
        mass = (shares * weights).sum(axis=1)
        shares, mass = shares[mass * ess > 1], mass[mass * ess > 1]  # less than a point is no bump
        fits = [
            fit_shrunk_subspace_gaussian(u, s * weights / m, max(float(m) * ess, 2.0))
            for s, m in zip(shares, mass, strict=True)
        ]
        bumps, mixing = [bump for bump, _ in fits], mass / mass.sum()
        per_point = log_ratios(bumps, u) * (ess * weights)
        per_group = np.array([np.bincount(groups, weights=row, minlength=n_groups) for row in per_point])
        per_group += np.log(mixing)[:, None]
        total = logsumexp(per_group, axis=0)
        likelihood = float(total.sum())
        if likelihood - last < 1e-3 * abs(likelihood):
            break
        last = likelihood
        shares = np.exp(per_group - total)[:, groups]
    dim = u.shape[1]
    parameters = len(fits) - 1 + sum(dim + 1 + min((1 - a) * dim * (dim + 1) / 2, 2 * dim) for _, a in fits)
    return SubspaceMixture(bumps, mixing, likelihood - 0.5 * math.log(max(ess, 3.0)) * parameters)


def refit_components(bumps: list[SubspaceGaussian], u: FloatArray, log_weights: FloatArray) -> list[SubspaceGaussian]:
    """Return bumps moved to weighted points u (n, d), each by those that are its own.

    Two steps of expectation-maximisation from the present bumps; their number stays, so that a bump with few points
    is not lost. Where the weights of a bump's points are too uneven to fit it, they are tempered until they are not.
    """
    weights = truncate_weights(log_weights)
    log_mixing = np.zeros(len(bumps))
    for _ in range(2):
        log_shares = log_ratios(bumps, u) + log_mixing[:, None]
        shares = np.exp(log_shares - logsumexp(log_shares, axis=0))
        bumps = [_moved(b, u, s, np.log(np.maximum(weights, 1e-300))) for b, s in zip(bumps, shares, strict=True)]
        log_mixing = np.log(np.maximum((shares * weights).sum(axis=1), 1e-6))
    return bumps


def _moved(bump: SubspaceGaussian, u: FloatArray, shares: FloatArray, log_weights: FloatArray) -> SubspaceGaussian:
    count = float(shares.sum())
    if count < 5:
        return bump
    wanted = min(max(30.0, 3.0 * u.shape[1]), count / 3)
    log_shares = np.log(np.maximum(shares, 1e-300))
    for power in np.arange(1.0, 0.0, -0.1):
        w = normalise_weights(log_shares + power * log_weights)
        ess = 1 / float((w * w).sum())
        if ess >= wanted:
            break
    return fit_shrunk_subspace_gaussian(u, w, max(ess, 2.0))[0]


def truncate_weights(log_weights: FloatArray) -> FloatArray:
    """Return weights that add up to 1, those over sqrt(n) times their mean cut to that (Ionides 2008)."""
    w = normalise_weights(log_weights)
    w = np.minimum(w, 1 / math.sqrt(len(w)))
    return np.asarray(w / w.sum())
