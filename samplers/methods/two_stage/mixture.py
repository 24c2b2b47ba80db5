"""The mixture proposal of two-stage: its components, fitted to weighted points, and their weights.

Mixtures of `SubspaceGaussian` components, fitted to weighted points with cautious covariances.

Mixture weights that minimise the variance of importance sampling, with lower limits for groups of components.

References:
    Schwarz, "Estimating the dimension of a model", Annals of Statistics 6, 1978 (BIC).
    Ionides, "Truncated importance sampling", Journal of Computational and Graphical Statistics 17, 2008.
    Cappé, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes", Statistics and
    Computing 18, 2008 (adapts the weights by EM, to the Kullback-Leibler divergence; here the second moment itself).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.edges import weighted_quantile
from samplers.methods.two_stage.settings import FIT, HIGH_DIM
from samplers.problem import FloatArray
from samplers.proposals import (
    MixtureComponent,
    RadialLaw,
    SubspaceGaussian,
    draw_components,
    draw_counts,
    expectation_maximisation,
    log_ratios,
    mixture_log_ratio,
    posterior,
    shrink_covariance,
    start_from_centres,
)
from samplers.sample import normalise_weights

Kind = Literal["base", "radial", "gaussian", "linear", "explored", "tempered", "spread", "directional"]
"""Where a component of a proposal comes from:

    base        N(0, I), which bounds all weights
    directional a direction and a radius, for failures like a shell or a cone
    radial      every direction alike, from the radius of the failures on
    gaussian    fitted to weighted failures
    linear      N(0, I) beyond a plane, or all of several, from regression of f as the greatest of linear functions
    explored    fitted to the chains of the exploration, never changed
    tempered    q^t phi^(1 - t) of a Gaussian q, which bounds weights where q is a bad description
    spread      as wide as the failures in the span of a few gradients of f, N(0, 1) across it
"""
NO_REGION = -1
"""Region of a component that belongs to none in particular."""


class ProposalComponent(NamedTuple):
    """A component of a proposal, and where it comes from."""

    component: MixtureComponent
    kind: Kind
    region: int = NO_REGION


@dataclass(frozen=True)
class MixtureProposal:
    """A mixture sum_k a_k q_k to draw from."""

    candidates: list[ProposalComponent]
    """The components; those of weight 0 are not drawn from."""
    weights: FloatArray
    """a_k, adding up to 1, shape (k,)."""

    @property
    def components(self) -> list[MixtureComponent]:
        """Its components q_k."""
        return [candidate.component for candidate in self.candidates]

    def log_weights(self, u: FloatArray) -> FloatArray:
        """Return log(phi / q) at u (n, d), shape (n,)."""
        log_r, weights = self._log_ratios(u)
        return -mixture_log_ratio(log_r, weights)

    def kind_ratios(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return q_kind / q at u (n, d) for the mixture of the components of each kind, (n, m), and log(phi / q)."""
        log_r, weights = self._log_ratios(u)
        log_q = mixture_log_ratio(log_r, weights)
        kinds = np.array([one.kind for one, a in zip(self.candidates, self.weights, strict=True) if a > 0])
        masses = weights[:, None] * np.exp(log_r - log_q)
        ratios = [masses[kinds == kind].sum(axis=0) / weights[kinds == kind].sum() for kind in dict.fromkeys(kinds)]
        return np.stack(ratios, axis=1), -log_q

    def drawn(self, counts: FloatArray | NDArray[np.int64]) -> "MixtureProposal":
        """Return the mixture that draws come from of which counts (k,) are from each component.

        The same where the first component, the base distribution, has none: it bounds the weights.
        """
        return MixtureProposal(self.candidates, counts / counts.sum()) if counts[0] > 0 else self

    def _log_ratios(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log(q_k / phi) of the components drawn from, shape (m, n), and their weights (m,)."""
        used = self.weights > 0
        return log_ratios([c for c, a in zip(self.components, used, strict=True) if a], u), self.weights[used]

    def draw(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.int64]]:
        """Draw n points (n, d), one component after the other; return them and how many are from which (k,)."""
        counts = draw_counts(self.weights, n, rng)
        return draw_components(self.components, counts, rng), counts


TINY_WEIGHT = 1e-300
"""Stands for 0 if a logarithm or a quotient is taken."""


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


def fit_shrunk_subspace_gaussian(u: FloatArray, weights: FloatArray, ess: float) -> tuple[SubspaceGaussian, float]:
    """Return the component of weighted points, and the share of the shrinkage target in its covariance.

    The points u (n, d) have weights (n,) that add up to 1 and are worth `ess` independent ones. The covariance is
    shrunk as by `shrink_covariance`. Above `high_dim` dimensions it is the target alone: one direction, that of the
    mean, and N(0, 1) across it.
    """
    dim = u.shape[1]
    mean = weights @ u
    norm = float(np.linalg.norm(mean))
    v = mean / norm if norm > 0 else np.eye(dim)[0]
    along = float(weights @ (u @ v - norm) ** 2)
    if dim > HIGH_DIM:
        # Noise makes the mean of few points too long, by (d - 1) / ess in the square, and turns it.
        excess = min((dim - 1) / (ess * max(norm, 1e-9) ** 2), 0.5)  # in hundreds of dimensions all is noise
        variance = np.array([min(along * (1 - excess) + excess, 4.0)])  # more comes from points of another region
        raised = inflate_variances(variance, ess)
        return SubspaceGaussian(v[:, None], np.array([norm * (1 - excess)]), raised), 1.0
    centred = (u - mean) * np.sqrt(weights)[:, None]  # E[u u'] less squares loses digits far out
    shrunk, share = shrink_covariance(centred.T @ centred, v, along, ess)
    values, axes = np.linalg.eigh(shrunk)
    return SubspaceGaussian(axes, axes.T @ mean, inflate_variances(values, ess)), share


def inflate_variances(variance: FloatArray, ess: float) -> FloatArray:
    """Return variances (r,), those under 1 raised by some of their standard errors.

    Too small a variance makes weights unbounded, too large a one costs a few draws.
    """
    variance = np.maximum(variance, 1e-6)  # points may coincide
    error = math.sqrt(2 / max(ess, 2.0))
    raised = np.minimum(variance * (1 + FIT.standard_errors * error), 1.0)
    return np.where(variance < 1, raised, variance)


def fit_subspace_mixture(points: GroupedPoints, most: int, rng: np.random.Generator) -> list[SubspaceGaussian]:
    """Return the components of a mixture of at most `most`, their number chosen by BIC."""
    best, highest, worse = list[SubspaceGaussian](), -math.inf, 0
    mass = np.bincount(points.groups, weights=points.weights, minlength=points.n_groups).astype(np.float64)
    means = np.zeros((points.n_groups, points.u.shape[1]))
    np.add.at(means, points.groups, points.u * points.weights[:, None])
    means, mass = means / np.maximum(mass, TINY_WEIGHT)[:, None], mass / mass.sum()  # of the groups
    for k in (size for size in FIT.sizes if size <= most):
        if k > 1 and (k > points.n_groups or points.ess < 4.0 * k):
            break
        restarts = 1 if k == 1 else 3  # k-means++ draws the centres
        starts = (start_from_centres(means, mass, k, rng)[:, points.groups] for _ in range(restarts))
        tries = [_fit_from(points, start) for start in starts]
        found, score = max(tries, key=lambda one: one[1])
        worse = 0 if score > highest else worse + 1
        if worse == 0:
            best, highest = found, score
        if worse == 2:  # the score is uneven in their number: after one that is worse, a better one may follow
            break
    return best


class _Fitted(NamedTuple):
    """Components with the share of the shrinkage target in each, and their weights."""

    components: list[SubspaceGaussian]
    target_shares: list[float]
    weights: FloatArray


def _fit_from(points: GroupedPoints, start: FloatArray) -> tuple[list[SubspaceGaussian], float]:
    """Return the components that expectation-maximisation reaches from responsibilities (k, n), and their score.

    A group stays together. The score is the log likelihood, in independent points, less the penalty of BIC.
    """
    u, weights, ess, groups = points

    def maximise(responsibilities: FloatArray) -> _Fitted:
        """Return the components that have at least one point."""
        mass = (responsibilities * weights).sum(axis=1)
        shares, mass = responsibilities[mass * ess > 1], mass[mass * ess > 1]
        fits = [
            fit_shrunk_subspace_gaussian(u, share * weights / m, max(float(m) * ess, 2.0))
            for share, m in zip(shares, mass, strict=True)
        ]
        return _Fitted([one for one, _ in fits], [share for _, share in fits], mass / mass.sum())

    def log_terms(mixture: _Fitted) -> FloatArray:
        """Return log(weight_j) and the log ratio to N(0, I) of each point's group, in independent points."""
        per_point = log_ratios(mixture.components, u) * (ess * weights)
        per_group = np.array([np.bincount(groups, weights=row, minlength=points.n_groups) for row in per_point])
        return np.asarray((per_group + np.log(mixture.weights)[:, None])[:, groups])

    once, least_gain = 1 / np.bincount(groups)[groups], (lambda total: 1e-3 * abs(total))  # once per group
    fit, log_likelihood = expectation_maximisation(maximise, log_terms, start, once, 25, least_gain)
    dim = points.u.shape[1]
    most = 2.0 * dim  # with all d (d + 1) / 2 of them some dozens of points would never have a second component
    covariances = [min((1 - share) * dim * (dim + 1) / 2, most) for share in fit.target_shares]
    parameters = len(fit.components) - 1 + sum(dim + 1 + size for size in covariances)
    penalty = 0.5 * math.log(max(points.ess, 3.0)) * parameters  # the logarithm would fall under 1 with fewer
    return fit.components, log_likelihood - penalty


def refit_components(
    components: list[SubspaceGaussian], u: FloatArray, log_weights: FloatArray
) -> list[SubspaceGaussian]:
    """Return components moved to weighted points u (n, d), each by those that are its own.

    Some steps of expectation-maximisation from the present components; their number stays, so that one with few
    points is not lost.
    """
    weights = truncate_weights(log_weights)
    log_mixing = np.zeros(len(components))
    for _ in range(2):  # the next rounds go on from there
        shares = posterior(log_ratios(components, u) + log_mixing[:, None])
        log_w = np.log(np.maximum(weights, TINY_WEIGHT))
        components = [_refit(one, u, share, log_w) for one, share in zip(components, shares, strict=True)]
        log_mixing = np.log(np.maximum((shares * weights).sum(axis=1), 1e-6))  # none is given up
    return components


def _refit(component: SubspaceGaussian, u: FloatArray, shares: FloatArray, log_weights: FloatArray) -> SubspaceGaussian:
    """Return a component fitted to its share (n,) of weighted points.

    If the weights are too uneven to fit it, they are raised to powers less than 1 until they are not.
    """
    count = float(shares.sum())
    if count < 5:  # it stays where it is
        return component
    wanted = max(FIT.ess[0], FIT.ess[1] * u.shape[1])
    wanted = min(wanted, count / 3.0)  # no more is asked of it than a third of its points
    log_shares = np.log(np.maximum(shares, TINY_WEIGHT))
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


def fit_radial(u: FloatArray, weights: FloatArray) -> RadialLaw:
    """Return the radial distribution whose |u|^2 has the moments of failures u (n, d) with weights (n,).

    |u|^2 = start + Gamma(shape, scale) in every direction, with shape = mean^2 / variance and scale = variance / mean
    of what |u|^2 exceeds the start by.
    """
    square = np.einsum("ij,ij->i", u, u)
    start = 0.98 * weighted_quantile(square, weights, 0.01)  # the least of few lies beyond the edge of many
    outside = square > start
    excess, w = square[outside] - start, weights[outside]
    mean = float(np.average(excess, weights=w))
    variance = max(float(np.average((excess - mean) ** 2, weights=w)), 1e-6)
    shape = max(mean * mean / variance, 0.3)  # with less nearly all draws are at the start
    return RadialLaw(u.shape[1], start, shape, max(variance / mean, 1e-3))  # the scale must be positive


class Floor(NamedTuple):
    """Components that together get at least some share of the draws."""

    members: NDArray[np.bool_]
    """Which components, shape (k,)."""
    least: float
    """Their least share."""


def minimise_second_moment(
    log_r: FloatArray, log_weights: FloatArray, start: FloatArray, floors: Sequence[Floor]
) -> FloatArray:
    """Return weights a (k,) of a mixture q_a = sum_k a_k q_k that minimise the second moment of its estimate.

    That is sum_i w_i (phi / q_a)(u_i) over failing points u_i with importance weights w_i, as logarithms (n,), convex
    in a; log_r (k, n) has log(q_k / phi) there. Each update multiplies a_k by the square root of
    G_k = sum_i w_i (phi q_k / q_a^2)(u_i); at the optimum all G_k with a_k > 0 are equal. The floors of disjoint groups
    are kept in every update.
    """
    matter = log_weights > log_weights.max() - 30.0
    log_r, log_weights = log_r[:, matter], log_weights[matter]
    largest = log_r.max(axis=0)
    ratio = np.exp(log_r - largest)
    scaled = np.exp(log_weights - largest - (log_weights - largest).max())
    a = start
    for _ in range(60):  # by then within 2 % of the least second moment
        q = np.maximum(a @ ratio, 1e-150)
        a = a * np.sqrt(ratio @ (scaled / (q * q)))
        a = keep_floors(a / a.sum(), floors)
    return a


def keep_floors(a: FloatArray, floors: Sequence[Floor]) -> FloatArray:
    """Return weights (k,) raised to the floors, the others lowered in proportion; they add up to 1.

    Members of a floor keep their proportions; without any weight they share the floor evenly. Lowering may bring
    another group under its floor, which is then raised too. Floors that add up to more than 1 are lowered in
    proportion.
    """
    groups = np.full(len(a), len(floors))  # the last one has no floor
    for number, floor in enumerate(floors):
        groups[floor.members] = number
    own = np.bincount(groups, a, len(floors) + 1)
    shares, least, raised = own.tolist(), [*(each.least for each in floors), 0.0], set[int]()
    while low := {k for k, share in enumerate(shares) if share < least[k] - 1e-12} - raised:  # less is rounding
        raised |= low
        total, rest = sum(least[k] for k in raised), sum(share for k, share in enumerate(shares) if k not in raised)
        room = max(1 - total, 0.0) if rest > 0 else 0.0
        lowered = room / rest if rest > 0 else 0.0
        shares = [
            share * lowered if k not in raised else least[k] if room > 0 else least[k] / total
            for k, share in enumerate(shares)
        ]
    if not raised:
        return a
    inside = np.where(own > 0, own, np.bincount(groups, minlength=len(own)))[groups]
    return np.asarray(np.where(own[groups] > 0, a, 1.0) / inside * np.array(shares)[groups])
