"""Mixtures of `SubspaceGaussian` components, fitted to weighted points with cautious covariances.

References:
    Schwarz, "Estimating the dimension of a model", Annals of Statistics 6, 1978 (BIC).
    Ionides, "Truncated importance sampling", Journal of Computational and Graphical Statistics 17, 2008.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, SubspaceSettings
from samplers.problem import FloatArray
from samplers.proposals.components import SubspaceGaussian, log_ratios
from samplers.proposals.em import expectation_maximisation, one_hot, posterior
from samplers.proposals.k_means import k_means
from samplers.proposals.shrinkage import shrink_covariance
from samplers.statistics.weights import normalise_weights

LEAST_MIXING = 1e-6
"""Least weight of a component while others move; none is given up."""
LEAST_VARIANCE_OF_COMPONENT = 1e-6
"""Points may coincide."""
SHORT_MEAN = 1e-9
"""A mean shorter than this has no direction; its length divides."""
TINY_WEIGHT = 1e-300
"""Stands for 0 where a logarithm or a quotient is taken."""


class GroupedPoints(NamedTuple):
    """Weighted points to which components are fitted."""

    u: FloatArray
    """Shape (n, d)."""
    weights: FloatArray
    """Adding up to 1, shape (n,)."""
    ess: float
    """How many independent points they are worth."""
    groups: NDArray[np.int64]
    """Points of one group (a chain) belong to one component; numbers from 0, shape (n,)."""

    @property
    def n_groups(self) -> int:
        """Number of groups."""
        return int(self.groups.max()) + 1


class SubspaceMixture(NamedTuple):
    """A fitted mixture."""

    components: list[SubspaceGaussian]
    weights: FloatArray
    score: float
    """Log likelihood, in independent points, less the BIC penalty."""


def fit_shrunk_subspace_gaussian(
    u: FloatArray, weights: FloatArray, ess: float, settings: SubspaceSettings = DEFAULT_MIXTURE_SETTINGS.subspace
) -> tuple[SubspaceGaussian, float]:
    """Return the component of weighted points, and the share of the shrinkage target in its covariance.

    Its covariance is shrunk as by `shrink_covariance`. Above `high_dim` dimensions it is the target alone: one
    direction, that of the mean, and N(0, 1) across it.

    Args:
        u: Points, shape (n, d).
        weights: Adding up to 1, shape (n,).
        ess: How many independent points they are worth.
        settings: Limits of variances and of the mean's correction.
    """
    dim = u.shape[1]
    mean = weights @ u
    norm = float(np.linalg.norm(mean))
    v = mean / norm if norm > 0 else np.eye(dim)[0]
    along = float(weights @ (u @ v - norm) ** 2)
    if dim > settings.high_dim:
        # Noise makes the mean of few points too long, by (d - 1) / ess in the square, and turns it.
        excess = min((dim - 1) / (ess * max(norm, SHORT_MEAN) ** 2), settings.max_mean_excess)
        variance = np.array([min(along * (1 - excess) + excess, settings.max_spread)])
        raised = inflate_variances(variance, ess, settings)
        return SubspaceGaussian(v[:, None], np.array([norm * (1 - excess)]), raised), 1.0
    centred = (u - mean) * np.sqrt(weights)[:, None]  # `weighted_moments` would lose digits of small variances far out
    shrunk, share = shrink_covariance(centred.T @ centred, v, along, ess)
    values, axes = np.linalg.eigh(shrunk)
    return SubspaceGaussian(axes, axes.T @ mean, inflate_variances(values, ess, settings)), share


def inflate_variances(
    variance: FloatArray, ess: float, settings: SubspaceSettings = DEFAULT_MIXTURE_SETTINGS.subspace
) -> FloatArray:
    """Return variances (r,), those under 1 raised by some of their standard errors.

    Too small a variance makes weights unbounded, too large a one costs a few draws.
    """
    variance = np.maximum(variance, LEAST_VARIANCE_OF_COMPONENT)
    error = math.sqrt(2 / max(ess, settings.min_ess))
    raised = np.minimum(variance * (1 + settings.standard_errors * error), 1.0)
    return np.where(variance < 1, raised, variance)


def fit_subspace_mixture(
    points: GroupedPoints,
    most: int,
    rng: np.random.Generator,
    settings: SubspaceSettings = DEFAULT_MIXTURE_SETTINGS.subspace,
) -> SubspaceMixture:
    """Return a mixture of at most `most` components, their number chosen by BIC."""
    best = None
    worse = 0
    for k in (size for size in settings.sizes if size <= most):
        if k > 1 and (k > points.n_groups or points.ess < settings.points_per_component * k):
            break
        restarts = 1 if k == 1 else settings.em_restarts
        found = max(
            (_fit_from(points, _initial_responsibilities(points, k, rng), settings) for _ in range(restarts)),
            key=lambda mix: mix.score,
        )
        if best is None or found.score > best.score:
            best, worse = found, 0
        else:
            worse += 1
        if worse == settings.max_worse:
            break
    assert best is not None  # one component can always be fitted
    return best


def _initial_responsibilities(points: GroupedPoints, k: int, rng: np.random.Generator) -> FloatArray:
    """Return responsibilities (k, n) to start from: clusters of the groups' means."""
    n_groups = points.n_groups
    mass = np.bincount(points.groups, weights=points.weights, minlength=n_groups).astype(np.float64)
    means = np.zeros((n_groups, points.u.shape[1]))
    np.add.at(means, points.groups, points.u * points.weights[:, None])
    return one_hot(k_means(means / np.maximum(mass, TINY_WEIGHT)[:, None], mass / mass.sum(), k, rng)[points.groups], k)


class _Fitted(NamedTuple):
    """Components with the share of the shrinkage target in each, and their weights."""

    components: list[SubspaceGaussian]
    target_shares: list[float]
    weights: FloatArray


@dataclass(frozen=True)
class _GroupedFamily:
    """Mixtures in which all points of a group come from one component, see `samplers.proposals.em.Family`."""

    points: GroupedPoints
    settings: SubspaceSettings

    def maximise(self, responsibilities: FloatArray) -> _Fitted:
        """Return the components that have at least one point, from responsibilities (k, n)."""
        u, weights, ess, _ = self.points
        mass = (responsibilities * weights).sum(axis=1)
        shares, mass = responsibilities[mass * ess > 1], mass[mass * ess > 1]
        fits = [
            fit_shrunk_subspace_gaussian(
                u, share * weights / m, max(float(m) * ess, self.settings.min_ess), self.settings
            )
            for share, m in zip(shares, mass, strict=True)
        ]
        return _Fitted([one for one, _ in fits], [share for _, share in fits], mass / mass.sum())

    def log_terms(self, mixture: _Fitted) -> FloatArray:
        """Return log(weight_j) and the log ratio to N(0, I) of each point's group, in independent points, (k, n)."""
        u, weights, ess, groups = self.points
        per_point = log_ratios(mixture.components, u) * (ess * weights)
        per_group = np.array([np.bincount(groups, weights=row, minlength=self.points.n_groups) for row in per_point])
        return np.asarray((per_group + np.log(mixture.weights)[:, None])[:, groups])


def _fit_from(points: GroupedPoints, start: FloatArray, settings: SubspaceSettings) -> SubspaceMixture:
    """Return the mixture that expectation-maximisation reaches from responsibilities (k, n)."""
    once_per_group = 1 / np.bincount(points.groups)[points.groups]
    fit, log_likelihood = expectation_maximisation(
        _GroupedFamily(points, settings),
        start,
        once_per_group,
        settings.max_em_iterations,
        lambda total: settings.min_relative_gain * abs(total),
    )
    dim = points.u.shape[1]
    most = settings.covariance_parameters_per_dim * dim
    covariances = [min((1 - share) * dim * (dim + 1) / 2, most) for share in fit.target_shares]
    parameters = len(fit.components) - 1 + sum(dim + 1 + size for size in covariances)
    penalty = 0.5 * math.log(max(points.ess, settings.min_bic_ess)) * parameters
    return SubspaceMixture(fit.components, fit.weights, log_likelihood - penalty)


def refit_components(
    components: list[SubspaceGaussian],
    u: FloatArray,
    log_weights: FloatArray,
    settings: SubspaceSettings = DEFAULT_MIXTURE_SETTINGS.subspace,
) -> list[SubspaceGaussian]:
    """Return components moved to weighted points u (n, d), each by those that are its own.

    Some steps of expectation-maximisation from the present components; their number stays, so that one with few
    points is not lost.
    """
    weights = truncate_weights(log_weights)
    log_mixing = np.zeros(len(components))
    for _ in range(settings.refit_steps):
        shares = posterior(log_ratios(components, u) + log_mixing[:, None])
        log_w = np.log(np.maximum(weights, TINY_WEIGHT))
        components = [_refit(one, u, share, log_w, settings) for one, share in zip(components, shares, strict=True)]
        log_mixing = np.log(np.maximum((shares * weights).sum(axis=1), LEAST_MIXING))
    return components


def _refit(
    component: SubspaceGaussian, u: FloatArray, shares: FloatArray, log_weights: FloatArray, settings: SubspaceSettings
) -> SubspaceGaussian:
    """Return a component fitted to its share (n,) of weighted points.

    Where the weights are too uneven to fit it, they are raised to powers less than 1 until they are not.
    """
    count = float(shares.sum())
    if count < settings.min_refit_points:
        return component
    wanted = max(settings.refit_ess, settings.refit_ess_per_dim * u.shape[1])
    wanted = min(wanted, count / settings.points_per_refit_ess)
    log_shares = np.log(np.maximum(shares, TINY_WEIGHT))
    for power in np.arange(1.0, 0.0, -settings.power_step):
        w = normalise_weights(log_shares + power * log_weights)
        ess = 1 / float((w * w).sum())
        if ess >= wanted:
            break
    return fit_shrunk_subspace_gaussian(u, w, max(ess, settings.min_ess), settings)[0]


def truncate_weights(log_weights: FloatArray) -> FloatArray:
    """Return weights that add up to 1, those over sqrt(n) times their mean cut to that (Ionides 2008)."""
    w = normalise_weights(log_weights)
    w = np.minimum(w, 1 / math.sqrt(len(w)))
    return np.asarray(w / w.sum())
