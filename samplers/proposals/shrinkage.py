"""Shrinkage of a covariance that is estimated from few weighted points.

Two targets: N(0, I) with one special direction, for points of one failure region, and the present Gaussian of a
search, for a step of it. Without a target: the eigenvalues alone, by factors (Stein).

References:
    Stein, "Lectures on the theory of estimation of many parameters", Journal of Soviet Mathematics 34, 1986
    (eigenvalues; put into order again as by Lin and Perlman, "A Monte Carlo comparison of four estimators of a
    covariance matrix", 1985).
    Ledoit and Wolf, "A well-conditioned estimator for large-dimensional covariance matrices",
    Journal of Multivariate Analysis 88, 2004 (the share of the target).
"""

import numpy as np
from scipy.optimize import isotonic_regression

from samplers.problem import FloatArray
from samplers.proposals.gaussian import Gaussian, Moments, weighted_moments

LEAST_VARIANCE = 1e-8
"""Added to the variance in every direction: points may coincide."""
PRIOR_DIM = 10
"""Above this many dimensions the present covariance counts as more than d + 1 points, in proportion to d."""


def shrink_covariance(
    covariance: FloatArray, direction: FloatArray, along: float, n: float
) -> tuple[FloatArray, float]:
    """Return the covariance S drawn towards T = I + (along - 1) v v', and the share of T.

    T is the covariance of N(0, I) beyond a plane with normal v. Its share is the expected square error of S over the
    square distance between S and T (Ledoit and Wolf), but at least that of (d + 1) / 2 points, counted beside n of S:
    T where n is small for d, S where n is large.

    Args:
        covariance: S, of weighted points, shape (d, d).
        direction: v, the unit vector of their mean, shape (d,).
        along: Their variance along v.
        n: Number of independent points that they are worth.
    """
    dim = len(direction)
    target = np.eye(dim) + (along - 1) * np.outer(direction, direction)
    noise = (float(np.trace(covariance)) ** 2 + float((covariance * covariance).sum())) / n
    distance = float(((covariance - target) ** 2).sum())
    share = max(noise / distance if distance > noise else 1.0, (dim + 1) / (2 * (dim + 1 + n)))
    return (1 - share) * covariance + share * target, share


def correct_eigenvalues(values: FloatArray, n: float) -> FloatArray:
    """Return the eigenvalues of a covariance without their bias, by Stein's estimator.

    Of few points the small eigenvalues are too small and the large ones too large. Each is divided by
    1 - (d - 1) / n + (2 / n) sum_j l_i / (l_i - l_j): small ones change by a factor, where a target of variance 1 would
    add to them. Failures between two planes have a variance of 0.05 across, which a tenth of I triples.

    Args:
        values: l, in increasing order, positive, shape (d,).
        n: Independent points that they are estimated from, more than d.

    Example:
        >>> import numpy as np
        >>> correct_eigenvalues(np.array([0.05, 1.0, 2.0]), n=20.0).round(3)
        array([0.056, 1.105, 1.663])
    """
    gaps = values[:, None] - values
    gaps[gaps == 0] = np.inf  # its own, and equal ones
    factors = 1 - (len(values) - 1) / n + (2 / n) * (values[:, None] / gaps).sum(axis=1)
    logs = np.log(values) - np.log(np.where(factors > 0, factors, 1.0))
    return np.asarray(np.exp(isotonic_regression(logs).x))


def fit_shrunk_gaussian(u: FloatArray, weights: FloatArray) -> Gaussian:
    """Return the Gaussian of weighted points with its covariance shrunk, see `shrink_covariance`.

    Args:
        u: Points, shape (n, d).
        weights: Adding up to 1, shape (n,).
    """
    moments = weighted_moments(u, weights)
    mean, s = moments.first, moments.covariance
    v = mean / max(float(np.linalg.norm(mean)), np.finfo(np.float64).tiny)
    along = max(float(v @ s @ v), LEAST_VARIANCE)
    shrunk, _ = shrink_covariance(s, v, along, 1 / float(weights @ weights))
    return Gaussian.from_covariance(mean, shrunk + LEAST_VARIANCE * np.eye(len(mean)))


def shrink_towards_present(target: Moments, present: Gaussian, n: float) -> Gaussian:
    """Return the Gaussian with the target's mean and its covariance drawn towards the present one.

    The present covariance counts as (d + 1) max(1, d / PRIOR_DIM) points beside the n behind the target: in many
    dimensions the noise of the d (d + 1) / 2 entries of a covariance ruins importance weights.

    Args:
        target: Moments of weighted points.
        present: The Gaussian that the points are drawn from.
        n: Number of independent points that they are worth.
    """
    prior = (present.dim + 1) * max(1.0, present.dim / PRIOR_DIM)
    share = prior / (prior + n)
    return Gaussian.from_covariance(target.first, (1 - share) * target.covariance + share * present.covariance)
