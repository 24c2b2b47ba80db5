"""Proposals of a search by terms: for each term Gaussians in the subspace of its gradients, N(0, I) across it.

With orthonormal axes V_j (d, r) and a density q_j on R^r, a draw of term j is u = xi + V_j (z - V_j' xi) with
xi ~ N(0, I) and z ~ q_j; its density ratio to N(0, I) is q_j(V_j' u) / phi_r(V_j' u).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from samplers.bases import Gaussian
from samplers.methods.base import SimulationSteps
from samplers.methods.series import LAW, ROUNDS, WALKS
from samplers.methods.series.walks import TermSimulator, Walks, join_terms
from samplers.problem import FloatArray, Terms
from samplers.proposals import (
    IsotropicNormal,
    LiftedComponent,
    MixtureComponent,
    SubspaceGaussian,
    correct_eigenvalues,
    draw_components,
    draw_counts,
    fit_proposal_mixture,
    fit_shrunk_gaussian,
    log_ratios,
    mixture_log_ratio,
    posterior,
)
from samplers.sample import effective_sample_size, normalise_weights


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """A mixture of Gaussians as one component of a proposal."""

    components: list[SubspaceGaussian]
    weights: FloatArray  # adding up to 1, (k,)

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log(q / phi) at u (n, d), shape (n,)."""
        return mixture_log_ratio(log_ratios(self.components, u), self.weights)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points, shape (n, d)."""
        return draw_components(self.components, draw_counts(self.weights, n, rng), rng)


@dataclass(frozen=True, eq=False)
class TermHistory:
    """All draws of a run, weighted as draws from the mixture of all proposals so far (balance heuristic).

    Later proposals depend on earlier draws, so that p from these weights is 10 to 15 % low on Highway-v0: they serve to
    fit the next proposal and for a run that is stopped early, not for the estimate.
    """

    u: FloatArray  # (n, d)
    terms: Terms
    log_density: FloatArray  # log(sum_k n_k q_k / phi) over the components so far, (n,)
    components: tuple[MixtureComponent, ...]
    counts: FloatArray  # draws of each
    batches: tuple[tuple[int, int], ...]  # simulations before each batch of draws, and their number

    @property
    def log_weights(self) -> FloatArray:
        """log(phi / q) - log(n), shape (n,): exp of them over some points adds up to their probability."""
        return -self.log_density

    def add(
        self, u: FloatArray, terms: Terms, components: tuple[MixtureComponent, ...], counts: FloatArray, first: int
    ) -> "TermHistory":
        """Return the history with draws u (m, d), `counts` of each component, before which `first` were simulated."""
        old = np.logaddexp(self.log_density, mixture_log_ratio(log_ratios(components, self.u), counts))
        components, counts = self.components + components, np.concatenate([self.counts, counts])
        new = mixture_log_ratio(log_ratios(components, u), counts)
        terms, batches = join_terms([self.terms, terms]), (*self.batches, (first, len(u)))
        return TermHistory(np.concatenate([self.u, u]), terms, np.append(old, new), components, counts, batches)

    def failing(self, gamma: float) -> NDArray[np.bool_]:
        """Return which points have f <= gamma, shape (n,)."""
        return np.asarray(self.terms.f <= gamma)


@dataclass(frozen=True, eq=False)
class PursuedTerm:
    """A term with a proposal of its own."""

    number: int
    gradients: FloatArray  # the last ones, of unit length, (k, d)
    ends: FloatArray  # of walks, (m, d)
    laws: list[MixtureComponent]  # as many as `LAW.shares`
    ready: bool = False  # whether these were fitted to failures


def find_axes(gradients: FloatArray) -> FloatArray:
    """Return the right singular vectors of gradients (k, d) that matter as columns, shape (d, r)."""
    _, values, right = np.linalg.svd(gradients, full_matrices=False)
    kept = values[: LAW.rank] > LAW.least_singular * values[0]
    return np.asarray(right[: LAW.rank][kept].T)


def start_term(number: int, gradients: FloatArray, ends: FloatArray) -> PursuedTerm:
    """Return a term with a proposal around ends of walks (m, d): one Gaussian, whose covariance I adds 20 points to."""
    axes = find_axes(gradients)
    z = ends @ axes
    centred = z - z.mean(axis=0)
    bump = _along_axes(z.mean(axis=0), (centred.T @ centred + 20 * np.eye(z.shape[1])) / (len(z) + 20))
    return PursuedTerm(number, gradients[-LAW.kept_gradients :], ends, build_laws(axes, [bump], np.ones(1), z))


def refit_term(
    term: PursuedTerm, gradients: FloatArray, history: TermHistory, near: "NearPoints", rng: np.random.Generator
) -> PursuedTerm:
    """Return a term with further gradients (k, d), its proposal fitted to points of the history.

    The covariances are those of many points, whose weights are tempered for it; the means and the shares follow fewer
    and heavier points, and only the likely ones. Components that none of these belongs to are left out.
    """
    gradients = np.concatenate([term.gradients, gradients])[-LAW.kept_gradients :]
    axes, (rows, likely, ready) = find_axes(gradients), near
    u, log_weights = history.u[rows], history.log_weights[rows]
    z, few = u @ axes, np.zeros(len(u))
    fitted = fit_proposal_mixture(fit_slab, z, temper(log_weights, LAW.many_ess), LAW.most, 3 * z.shape[1], rng)
    few[likely] = temper(log_weights[likely], LAW.few_ess)
    own = posterior(fitted.log_terms(z)) * few
    mass = own.sum(axis=1)
    bumps = [
        _along_axes(weights @ z / m, one.covariance)
        for one, weights, m in zip(fitted.components, own, mass, strict=True)
        if m > 0
    ]
    heaviest = np.flatnonzero(likely)[np.argsort(-log_weights[likely], kind="stable")[: LAW.points // 2]]
    around = np.concatenate([u[heaviest], term.ends])[: LAW.points]
    laws = build_laws(axes, bumps, mass[mass > 0] / mass.sum(), around @ axes)
    return replace(term, gradients=gradients, laws=laws, ready=term.ready or ready)


def fit_slab(z: FloatArray, weights: FloatArray) -> Gaussian:
    """Return the Gaussian of points z (n, r) with weights (n,), with Stein's covariance where they are enough for it.

    Collisions have a variance of 0.05 between "ahead" and "behind" of a car, which shrinkage towards I made 0.4: 0.67
    times the E[w^2] of collisions of the IDM ego, over chains of 13,000 failures.
    """
    ess = 1 / float(weights @ weights)
    if ess < 1.5 * z.shape[1]:
        return fit_shrunk_gaussian(z, weights)
    mean = weights @ z
    centred = (z - mean) * np.sqrt(weights)[:, None]
    values, axes = np.linalg.eigh(centred.T @ centred)
    corrected = correct_eigenvalues(np.maximum(values, 1e-6), ess)  # points may coincide
    return Gaussian.from_covariance(mean, (axes * corrected) @ axes.T)


def _along_axes(mean: FloatArray, covariance: FloatArray) -> SubspaceGaussian:
    """Return a Gaussian on R^r along its principal axes."""
    values, axes = np.linalg.eigh(covariance)
    return SubspaceGaussian(axes, axes.T @ mean, values)


def build_laws(
    axes: FloatArray, bumps: list[SubspaceGaussian], shares: FloatArray, points: FloatArray
) -> list[MixtureComponent]:
    """Return bumps with shares (k,), the same nearer and wider, and Gaussians around points z (m, r), m > 0."""
    nearer, wider = LAW.nearer
    tempered = [replace(bump, mean=nearer * bump.mean, variance=wider * bump.variance) for bump in bumps]
    unit = np.eye(points.shape[1])
    around = [SubspaceGaussian(unit, 0.9 * point, np.ones(len(unit))) for point in points]
    even = np.full(len(points), 1 / len(points))
    groups = (bumps, shares), (tempered, shares), (around, even)
    return [LiftedComponent(GaussianMixture(components, weights), axes) for components, weights in groups]


def temper(log_weights: FloatArray, wanted: float) -> FloatArray:
    """Return weights to the largest power up to 1 with which they are worth `wanted` points, adding up to 1."""
    wanted = min(wanted, 0.5 * len(log_weights))
    if effective_sample_size(log_weights) >= wanted:
        return normalise_weights(log_weights)
    return normalise_weights(brentq(lambda t: effective_sample_size(t * log_weights) - wanted, 0.0, 1.0) * log_weights)


class NearPoints(NamedTuple):
    """Points that a term is fitted to."""

    rows: NDArray[np.int64]  # of the history, those with the lowest values of the term first, (k,)
    likely: NDArray[np.bool_]  # which of them the mean follows: the failures once there are enough, (k,)
    ready: bool  # whether the failures are enough


def near_points(history: TermHistory, term: int, gamma: float) -> NearPoints:
    """Return the points under the lowest level of a term at which they are worth `few_ess`, and all its failures.

    With `min_failures` or more failures that it is the least term of, however uneven their weights, the points are
    those that it is the least of, and the failures are the likely ones: they are nearer to the likely failures than any
    higher level is.
    """
    values, log_weights = history.terms.values[:, term], history.log_weights
    known = np.isfinite(history.terms.f)
    mine = known & (history.terms.least == term)
    fails = mine & history.failing(gamma)
    enough = int(fails.sum()) >= ROUNDS.min_failures
    rows = np.flatnonzero(mine if enough else known)
    rows = rows[np.argsort(values[rows], kind="stable")]
    w = np.exp(log_weights[rows] - log_weights[rows].max())
    low = np.cumsum(w) ** 2 / np.cumsum(w**2) < LAW.few_ess
    under = (values[rows] <= history.terms.threshold) | (fails[rows] & enough)
    rows = rows[: 1 + np.flatnonzero(under).max(initial=len(rows) - 1 if low.all() else int(low.argmin()))]
    likely = fails[rows] if enough else np.ones(len(rows), dtype=bool)
    return NearPoints(rows, likely, enough and effective_sample_size(log_weights[fails]) >= ROUNDS.min_failures)


def pursue_walked(walks: Walks) -> list[PursuedTerm]:
    """Return the terms that walks came near, with proposals around their ends; those that hardly fail are left out.

    The ends are those that fail, else the lower half if one came half way.
    """
    found, tails = list[PursuedTerm](), list[float]()
    for term in np.unique(np.concatenate([walks.term, walks.failing_terms])):
        mine, gradients = walks.term == term, walks.gradients[walks.gradient_terms == term]
        arrived = mine & (walks.fallen >= 1)
        near = mine & ~(walks.distance > WALKS.max_distance)
        ends = np.concatenate([walks.u[near & arrived], walks.failures[walks.failing_terms == term]])
        if len(ends) == 0 and walks.fallen[near].max(initial=0.0) >= 0.5:
            ends = walks.u[near & (walks.fallen >= np.median(walks.fallen[near]))]
        if len(ends) and len(gradients):
            found.append(start_term(int(term), gradients, ends[: LAW.points]))
            beta = walks.distance[arrived & np.isfinite(walks.distance)]
            tails.append(float(ndtr(-np.median(beta))) if len(beta) else math.nan)
    least = WALKS.negligible * max((tail for tail in tails if tail > 0), default=0.0)
    return [one for one, tail in zip(found, tails, strict=True) if not tail < least]


def mix_terms(
    pursued: tuple[PursuedTerm, ...], history: TermHistory, gamma: float, final: bool = False
) -> tuple[tuple[MixtureComponent, ...], FloatArray]:
    """Return the components of the mixture, the base first, and their shares, a_0 first, shape (k,).

    With all of them ready pi_j is proportional to sqrt(sum_j W^2), the sum over failures that the term is the least of,
    with tempered weights, and at least `min_term_share`; until then those that are not come first. In the `final`
    rounds a term that has not been reached waits no longer.
    """
    k, base = len(pursued), IsotropicNormal(history.u.shape[1])
    shares = np.array([ROUNDS.waiting_share if one.ready else 1.0 for one in pursued])
    if final or all(one.ready for one in pursued):
        failing = history.failing(gamma)
        w, least = temper(history.log_weights[failing], LAW.many_ess), history.terms.least[failing]
        size = np.array([np.sqrt((w[least == one.number] ** 2).sum()) for one in pursued])
        shares = np.maximum(size / max(size.sum(), 1e-300), min(ROUNDS.min_term_share, 0.7 / max(k, 1)))
    parts = (1 - ROUNDS.base_share) * np.outer(shares / shares.sum(), LAW.shares)
    whole = np.append(ROUNDS.base_share, parts)
    return (base, *(law for one in pursued for law in one.laws)), whole / whole.sum()


def refit_terms(
    simulator: TermSimulator,
    history: TermHistory,
    pursued: tuple[PursuedTerm, ...],
    gamma: float,
    limit: int,
    rng: np.random.Generator,
) -> SimulationSteps[tuple[PursuedTerm, ...]]:
    """Return the terms with proposals fitted to all draws, after a few more gradients of each at likely points.

    Terms that failures showed and nobody pursued join them.
    """
    known = {one.number: one for one in pursued}
    shown = [int(j) for j in np.unique(history.terms.least[history.failing(gamma)])]
    numbers = [*known, *(j for j in shown if j not in known)]
    near = [near_points(history, j, gamma) for j in numbers]
    each = max(min(LAW.gradients, 4 * LAW.gradients // max(len(numbers), 1)), 1)
    chosen = [_draw_rows(points.rows[points.likely], history.log_weights, each, rng) for points in near]
    while chosen and simulator.n_sim + simulator.offer.count_gradients(sum(map(len, chosen))) > limit:
        chosen = [rows[: len(rows) // 2] for rows in chosen]  # count_gradients(0) is 0
    rows = np.concatenate([np.empty(0, dtype=np.int64), *chosen])
    term = np.repeat(numbers, [len(part) for part in chosen]).astype(np.int64)
    slopes = yield from simulator.gradients(history.u[rows], term, history.terms.ticks[rows, term])
    norm = np.linalg.norm(slopes, axis=1)
    good = np.isfinite(norm) & (norm > 0)
    result = []
    for number, points in zip(numbers, near, strict=True):
        mine = good & (term == number)
        gradients = slopes[mine] / norm[mine, None]
        if number in known:
            result.append(refit_term(known[number], gradients, history, points, rng))
        elif len(gradients):
            result.append(start_term(number, gradients, history.u[points.rows[points.likely][: LAW.points]]))
    return tuple(result)


def _draw_rows(rows: NDArray[np.int64], log_weights: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return at most n different ones of some rows, drawn by weight."""
    if len(rows) <= n:
        return rows
    weights = normalise_weights(log_weights[rows])
    return np.asarray(rng.choice(rows, min(n, int(np.count_nonzero(weights))), replace=False, p=weights))
