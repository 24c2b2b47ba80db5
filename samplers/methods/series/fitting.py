"""Proposals of a search by terms: for each term Gaussians in the subspace of its gradients, N(0, I) across it.

With orthonormal axes V_j (d, r) and a density q_j on R^r, a draw of term j is u = xi + V_j (z - V_j' xi) with
xi ~ N(0, I) and z ~ q_j. The mixture over the terms has the exact density ratio

    q(u) / phi(u) = a_0 + (1 - a_0) sum_j pi_j q_j(V_j' u) / phi_r(V_j' u),

also where the subspaces of the terms differ.
"""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtr

from samplers.components import SubspaceGaussian, draw_counts, log_ratios, mixture_log_ratio, posterior
from samplers.methods.base import SimulationSteps
from samplers.methods.series.settings import LAW, ROUNDS, WALKS
from samplers.methods.series.walks import Directions, TermSimulator, Walks, describe_half_spaces, join_terms
from samplers.methods.two_stage.mixture import (
    LEAST_VARIANCE_OF_COMPONENT,
    GroupedPoints,
    SubspaceMixture,
    fit_subspace_mixture,
)
from samplers.problem import FloatArray, Terms
from samplers.proposals import correct_eigenvalues
from samplers.sample import (
    DrawWeights,
    effective_number,
    effective_sample_size,
    normalise_weights,
)


@dataclass(frozen=True, eq=False)
class ComponentGroup:
    """Components of one stratum: a draw takes one of them at random."""

    share: float
    """Of the term's draws."""
    components: tuple[SubspaceGaussian, ...]
    """In the coordinates of the subspace."""
    weights: FloatArray
    """Adding up to 1, shape (k,)."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points z, shape (n, r)."""
        counts = rng.multinomial(n, self.weights / self.weights.sum())
        return np.concatenate([c.sample(int(k), rng) for c, k in zip(self.components, counts, strict=True)])


@dataclass(frozen=True, eq=False)
class TermLaw:
    """Proposal of one term."""

    axes: FloatArray
    """V, orthonormal columns, shape (d, r)."""
    groups: tuple[ComponentGroup, ...]
    """Their shares add up to 1."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log(q_j / phi) at u (n, d), shape (n,)."""
        z = u @ self.axes
        components = [component for group in self.groups for component in group.components]
        weights = np.concatenate([group.share * group.weights for group in self.groups])
        return mixture_log_ratio(log_ratios(components, z), weights)

    def sample(self, group: int, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points of one group, shape (n, d)."""
        xi = rng.standard_normal((n, len(self.axes)))
        z = self.groups[group].sample(n, rng)
        return np.asarray(xi + (z - xi @ self.axes) @ self.axes.T)


@dataclass(frozen=True, eq=False)
class TermProposal:
    """Mixture of base draws and the proposals of the terms; its strata are the base and every group."""

    dim: int
    base_share: float
    """a_0."""
    laws: tuple[TermLaw, ...]
    shares: FloatArray
    """pi_j, adding up to 1, shape (len(laws),)."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log(q / phi) at u (n, d), shape (n,)."""
        terms = [np.full(len(u), math.log(self.base_share))]
        for share, law in zip(self.shares, self.laws, strict=True):
            terms.append(math.log((1 - self.base_share) * share) + law.log_ratio(u))
        return np.asarray(logsumexp(np.array(terms), axis=0))

    @property
    def stratum_shares(self) -> FloatArray:
        """Shares of the base and of every group, shape (k,)."""
        groups = [
            (1 - self.base_share) * share * group.share
            for share, law in zip(self.shares, self.laws, strict=True)
            for group in law.groups
        ]
        return np.array([self.base_share, *groups])

    def draw(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.int64]]:
        """Draw n points, a fixed number from each stratum; return them (n, d) and their strata (n,)."""
        counts = draw_counts(self.stratum_shares, n, rng)
        parts = [rng.standard_normal((int(counts[0]), self.dim))]
        strata = [(law, group) for law in self.laws for group in range(len(law.groups))]
        parts += [law.sample(group, int(k), rng) for (law, group), k in zip(strata, counts[1:], strict=True)]
        return np.concatenate(parts), np.repeat(np.arange(len(counts)), counts)


@dataclass(frozen=True, eq=False)
class TermHistory:
    """Base draws and all draws of proposals, weighted as draws from the mixture of all of them (balance heuristic).

    Later proposals depend on earlier draws, so that p from these weights is 10 to 15 % low on Highway-v0: they serve to
    fit the next proposal and for a run that is stopped early, not for the estimate.
    """

    u: FloatArray
    """Shape (n, d)."""
    terms: Terms
    log_density: FloatArray
    """log(sum_k n_k q_k / phi) over the proposals so far, base draws being one, shape (n,)."""
    proposals: tuple[tuple[int, TermProposal], ...] = field(default=())
    """Draws of each proposal, and the proposal."""
    n_base: int = 0
    """Base draws, the first of all."""
    firsts: tuple[int, ...] = ()
    """Simulations that the run had spent before each proposal's draws."""

    @property
    def log_weights(self) -> FloatArray:
        """log(phi / q) - log(n), shape (n,): exp of them over some points adds up to their probability."""
        return -self.log_density

    @property
    def draw_weights(self) -> tuple[DrawWeights, ...]:
        """Weight of every draw in the p of all of them."""
        sizes = (self.n_base, *(n for n, _ in self.proposals))
        whole = DrawWeights(first=0, log_weights=self.log_weights)
        return whole.split(*zip((0, *self.firsts), sizes, strict=True))

    def add(self, u: FloatArray, terms: Terms, proposal: TermProposal, first: int) -> "TermHistory":
        """Return the history with draws u (m, d) of a proposal, before which the run had spent `first` simulations."""
        count = np.log(len(u))
        old = np.logaddexp(self.log_density, count + proposal.log_ratio(self.u))
        new = np.full(len(u), np.log(self.n_base))
        for n, earlier in (*self.proposals, (len(u), proposal)):
            new = np.logaddexp(new, np.log(n) + earlier.log_ratio(u))
        return TermHistory(
            np.concatenate([self.u, u]),
            join_terms([self.terms, terms]),
            np.concatenate([old, new]),
            (*self.proposals, (len(u), proposal)),
            self.n_base,
            (*self.firsts, first),
        )

    def failing(self, gamma: float) -> NDArray[np.bool_]:
        """Return which points have f <= gamma, shape (n,)."""
        return np.asarray(self.terms.f <= gamma)


POWER_STEPS = 20
"""Bisections for the power of the weights: to one millionth."""


@dataclass(frozen=True, eq=False)
class PursuedTerm:
    """A term with a proposal of its own."""

    number: int
    directions: Directions
    """k gradients."""
    direction_weights: FloatArray
    """Shape (k,)."""
    ends: FloatArray
    """Ends of walks, shape (m, d)."""
    law: TermLaw
    ready: bool = False
    """Whether the law was fitted to failures."""


def find_axes(directions: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the right singular vectors of weighted directions (k, d) that matter as columns, shape (d, r)."""
    _, values, right = np.linalg.svd(directions * weights[:, None], full_matrices=False)
    kept = values[: LAW.rank] > LAW.least_singular * values[0]
    return np.asarray(right[: LAW.rank][kept].T)


def choose_guards(directions: Directions) -> FloatArray:
    """Return design points (m, d) that are apart from each other, those nearest to the origin first."""
    points = directions.design_points
    distance = np.linalg.norm(points, axis=1)
    order = [row for row in np.argsort(distance, kind="stable") if np.isfinite(distance[row])]
    chosen = list[int]()
    for row in order:
        if all(np.linalg.norm(points[row] - points[other]) >= LAW.guard_spacing for other in chosen):
            chosen.append(int(row))
    return np.asarray(points[chosen[: LAW.max_guards]])


def first_law(axes: FloatArray, ends: FloatArray, guards: FloatArray) -> TermLaw:
    """Return the proposal around ends of walks (m, d): one Gaussian, drawn towards variance 1, and its guards."""
    z = ends @ axes
    n, centred = len(z), z - z.mean(axis=0)
    covariance = (centred.T @ centred + LAW.prior_points * np.eye(z.shape[1])) / (n + LAW.prior_points)
    values, vectors = np.linalg.eigh(covariance)
    bump = SubspaceGaussian(vectors, vectors.T @ z.mean(axis=0), values)
    return build_law(axes, [bump], np.ones(1), z, guards @ axes)


def fit_law(
    axes: FloatArray,
    u: FloatArray,
    log_weights: FloatArray,
    ends: FloatArray,
    guards: FloatArray,
    rng: np.random.Generator,
    likely: NDArray[np.bool_] | None = None,
) -> TermLaw:
    """Return the proposal fitted to weighted points u (n, d), with guards around the heaviest of them too.

    The covariances are those of many points, whose weights are tempered for it; the means and the shares follow fewer
    and heavier points, and only the `likely` ones (n,): failures, where u are points of a higher level too.
    """
    z = u @ axes
    likely = np.ones(len(u), dtype=bool) if likely is None else likely
    heaviest = np.flatnonzero(likely)[np.argsort(-log_weights[likely], kind="stable")[: LAW.max_heavy]]
    around = np.concatenate([u[heaviest], ends])[: LAW.max_ends]
    many = temper_weights(log_weights, LAW.shape_ess)
    points = GroupedPoints(z, many, 1 / float(many @ many), np.arange(len(z)))
    mixture = fit_subspace_mixture(points, LAW.max_bumps, rng)
    few = np.zeros(len(u))
    few[likely] = temper_weights(log_weights[likely], LAW.mean_ess)
    bumps, shares = _finish(mixture, z, many, few)
    return build_law(axes, bumps, shares, around @ axes, guards @ axes)


def _finish(
    mixture: SubspaceMixture, z: FloatArray, many: FloatArray, few: FloatArray
) -> tuple[list[SubspaceGaussian], FloatArray]:
    """Return the components with the covariances of many points z (n, r) and the means of few, and their shares.

    Components that none of the few belongs to are left out.
    """
    shares = posterior(log_ratios(mixture.components, z) + np.log(mixture.weights)[:, None])
    bumps = [_shape(one, z, share * many) for one, share in zip(mixture.components, shares, strict=True)]
    mass = shares @ few
    moved = [
        SubspaceGaussian(one.axes, one.axes.T @ ((share * few) @ z / m), one.variance)
        for one, share, m in zip(bumps, shares, mass, strict=True)
        if m > 0
    ]
    return moved, mass[mass > 0] / mass.sum()


def _shape(component: SubspaceGaussian, z: FloatArray, weights: FloatArray) -> SubspaceGaussian:
    """Return a component with Stein's estimate of the covariance of weighted points z (n, r), if they are enough."""
    mass = weights.sum()
    ess = effective_number(weights)
    if ess < LAW.shape_points * z.shape[1]:
        return component
    centred = (z - weights @ z / mass) * np.sqrt(weights / mass)[:, None]
    values, axes = np.linalg.eigh(centred.T @ centred)
    corrected = correct_eigenvalues(np.maximum(values, LEAST_VARIANCE_OF_COMPONENT), ess)
    return SubspaceGaussian(axes, axes.T @ component.centre, corrected)


def build_law(
    axes: FloatArray, bumps: list[SubspaceGaussian], weights: FloatArray, ends: FloatArray, guards: FloatArray
) -> TermLaw:
    """Return bumps, the same tempered, and Gaussians around ends and design points z (m, r), as one proposal."""
    tempered = tuple(
        SubspaceGaussian(b.axes, LAW.tempered_mean * b.mean, LAW.tempered_variance * b.variance) for b in bumps
    )
    groups = [
        ComponentGroup(LAW.bump_share * float(w / weights.sum()), (bump,), np.ones(1))
        for bump, w in zip(bumps, weights, strict=True)
    ]
    groups.append(ComponentGroup(LAW.tempered_share, tempered, weights / weights.sum()))
    if len(ends):
        nearest = np.argmax(log_ratios(bumps, ends) + np.log(weights)[:, None], axis=0)
        around = tuple(  # in the shape of the nearest bump, but wider
            SubspaceGaussian(b.axes, b.axes.T @ (LAW.end_mean * end), np.minimum(LAW.end_variance * b.variance, 1.0))
            for b, end in zip((bumps[k] for k in nearest), ends, strict=True)
        )
        groups.append(ComponentGroup(LAW.end_share, around, np.full(len(ends), 1 / len(ends))))
    if len(guards):
        identity = np.eye(guards.shape[1])
        half_spaces = tuple(SubspaceGaussian(identity, guard, np.ones(len(guard))) for guard in guards)
        groups.append(ComponentGroup(LAW.guard_share, half_spaces, np.full(len(guards), 1 / len(guards))))
    total = sum(group.share for group in groups)
    return TermLaw(axes, tuple(ComponentGroup(g.share / total, g.components, g.weights) for g in groups))


def temper_weights(log_weights: FloatArray, wanted: float) -> FloatArray:
    """Return weights to the largest power up to 1 with which they are worth `wanted` points, adding up to 1."""
    wanted = min(wanted, 0.5 * len(log_weights))
    low, high = 0.0, 1.0
    if effective_sample_size(log_weights) >= wanted:
        return normalise_weights(log_weights)
    for _ in range(POWER_STEPS):
        power = 0.5 * (low + high)
        low, high = (power, high) if effective_sample_size(power * log_weights) >= wanted else (low, power)
    return normalise_weights(low * log_weights)


class NearPoints(NamedTuple):
    """Points that a term is fitted to."""

    rows: NDArray[np.int64]
    """Of the history, those with the lowest values of the term first, shape (k,)."""
    likely: NDArray[np.bool_]
    """Which of them the mean follows: the failures once there are enough, shape (k,)."""
    ready: bool
    """Whether the failures are worth `ready_ess` points."""


def near_points(history: TermHistory, term: int, gamma: float) -> NearPoints:
    """Return the points under the lowest level of a term at which they are worth `level_ess`, and all its failures.

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
    ess = np.cumsum(w) ** 2 / np.cumsum(w**2)
    reached = np.flatnonzero(ess >= ROUNDS.level_ess)
    count = int(reached[0]) + 1 if len(reached) else len(rows)
    under = (values[rows] <= history.terms.threshold) | (fails[rows] & enough)
    rows = rows[: max(count, int(np.flatnonzero(under)[-1]) + 1 if under.any() else 0)]
    likely = fails[rows] if enough else np.ones(len(rows), dtype=bool)
    return NearPoints(rows, likely, enough and effective_sample_size(log_weights[fails]) >= ROUNDS.ready_ess)


def pursue_walked(walks: Walks, history: TermHistory) -> list[PursuedTerm]:
    """Return the terms that walks came near, with proposals around their ends; those that hardly fail are left out."""
    found, tails = list[PursuedTerm](), list[float]()
    for term in np.unique(np.concatenate([walks.term, walks.failing_terms])):
        directions, ends = walks.directions.of(term), _ends(walks, history, int(term))
        if len(ends) and len(directions.term):
            found.append(start_term(int(term), directions, ends))
            arrived = walks.distance[(walks.term == term) & (walks.values <= history.terms.threshold)]
            arrived = arrived[np.isfinite(arrived)]
            tails.append(float(ndtr(-np.median(arrived))) if len(arrived) else math.nan)
    least = WALKS.negligible * max((tail for tail in tails if tail > 0), default=0.0)
    return [one for one, tail in zip(found, tails, strict=True) if not tail < least]


def start_term(number: int, directions: Directions, ends: FloatArray) -> PursuedTerm:
    """Return a term with a proposal around ends (m, d), from its gradients."""
    weights = np.ones(len(directions.term))
    law = first_law(find_axes(directions.values, weights), ends, choose_guards(directions))
    return PursuedTerm(number, directions, weights, ends, law)


def _ends(walks: Walks, history: TermHistory, term: int) -> FloatArray:
    """Return the ends of a term's walks: those that fail, else the lower half if one came half way."""
    mine = (walks.term == term) & ~(walks.distance > WALKS.max_distance)
    failing = mine & (walks.values <= history.terms.threshold)
    on_the_way = walks.failures[walks.failing_terms == term]
    ends = np.concatenate([walks.u[failing], on_the_way])[: LAW.max_ends]
    if len(ends) or not mine.any():
        return ends
    values, threshold = walks.values[mine], history.terms.threshold
    half_way = 0.5 * (float(np.median(walks.start_values[mine])) + threshold)
    lower = values <= np.median(values)
    return walks.u[mine][lower] if values.min() <= half_way else ends


def mix_terms(pursued: list[PursuedTerm], history: TermHistory, gamma: float, final: bool = False) -> TermProposal:
    """Return the mixture over the terms.

    With all of them at the threshold pi_j is proportional to sqrt(sum_j W^2), the sum over failures that the term is
    the least of, with tempered weights, and at least `min_term_share`; until then those that are not come first. In
    the `final` rounds a term that has not been reached waits no longer.
    """
    k = len(pursued)
    if final or all(one.ready for one in pursued):
        failing = history.failing(gamma)
        w, least = temper_weights(history.log_weights[failing], ROUNDS.share_ess), history.terms.least[failing]
        size = np.array([np.sqrt((w[least == one.number] ** 2).sum()) for one in pursued])
        shares = size / size.sum() if size.sum() > 0 else np.full(k, 1 / k)
        shares = np.maximum(shares, min(ROUNDS.min_term_share, 0.7 / k))
    else:
        shares = np.array([ROUNDS.waiting_share if one.ready else 1.0 for one in pursued])
    return TermProposal(history.u.shape[1], ROUNDS.base_share, tuple(one.law for one in pursued), shares / shares.sum())


def refit_terms(
    simulator: TermSimulator,
    history: TermHistory,
    pursued: list[PursuedTerm],
    gamma: float,
    limit: int,
    rng: np.random.Generator,
) -> SimulationSteps[list[PursuedTerm]]:
    """Return the terms with proposals fitted to all draws, after a few more gradients of each at likely points.

    Terms that failures showed and nobody pursued join them.
    """
    known = {one.number for one in pursued}
    new = [int(j) for j in np.unique(history.terms.least[history.failing(gamma)]) if j not in known]
    numbers = [one.number for one in pursued] + new
    near = [near_points(history, j, gamma) for j in numbers]
    each = max(min(ROUNDS.gradients, ROUNDS.max_gradients // max(len(numbers), 1)), 1)
    chosen = [_draw_rows(points.rows[points.likely], history.log_weights, each, rng) for points in near]
    while chosen and simulator.n_sim + simulator.offer.count_gradients(sum(map(len, chosen))) > limit:
        chosen = [rows[: len(rows) // 2] for rows in chosen]  # count_gradients(0) is 0
    rows, term = np.concatenate(chosen), np.repeat(numbers, [len(part) for part in chosen])
    slopes = yield from simulator.gradients(history.u[rows], term, history.terms.ticks[rows, term])
    excess = history.terms.values[rows, term] - history.terms.threshold
    found = describe_half_spaces(term, history.u[rows], slopes, excess)
    result = []
    for number, points in zip(numbers, near, strict=True):
        directions = found.of(number)
        old = next((one for one in pursued if one.number == number), None)
        if old is not None:
            result.append(_refit_term(old, history, directions, points, rng))
        elif len(directions.term):
            ends = history.u[points.rows[points.likely][: LAW.max_ends]]
            result.append(start_term(number, directions, ends))
    return result


def _refit_term(
    term: PursuedTerm, history: TermHistory, directions: Directions, points: NearPoints, rng: np.random.Generator
) -> PursuedTerm:
    """Return a term with further gradients, fitted to some points of the history."""
    later = float(term.direction_weights.max()) * ROUNDS.later_weight
    weights = np.concatenate([term.direction_weights, np.full(len(directions.term), later)])
    directions = term.directions.join(directions)
    axes = find_axes(directions.values, weights)
    guards = choose_guards(directions)
    rows, likely, ready = points
    law = fit_law(axes, history.u[rows], history.log_weights[rows], term.ends, guards, rng, likely)
    return replace(term, directions=directions, direction_weights=weights, law=law, ready=term.ready or ready)


def _draw_rows(rows: NDArray[np.int64], log_weights: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return at most n different ones of some rows, drawn by weight."""
    if len(rows) <= n:
        return rows
    weights = normalise_weights(log_weights[rows])
    possible = min(n, int(np.count_nonzero(weights)))
    return np.asarray(rng.choice(rows, possible, replace=False, p=weights))
