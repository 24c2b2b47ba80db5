"""Gradient walks, and terms with their gradients in standard normal space, where what they cost is counted."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.method import Goal, TermsOffer, request_gradients, request_terms, whole_simulations
from samplers.methods.base import SimulationSteps, Simulator, noise_mask
from samplers.methods.series import WALKS
from samplers.problem import Distribution, FloatArray, Inputs, StandardNormal, Terms


def join_terms(parts: Sequence[Terms]) -> Terms:
    """Return the terms of some batches, at least one, as those of one."""
    f, values, ticks = (np.concatenate([getattr(one, name) for one in parts]) for name in ("f", "values", "ticks"))
    return Terms(f, values, ticks, parts[0].threshold, next((one.names for one in parts if one.names), ()))


class TermSimulator(Simulator):
    """The way from standard normal space to terms and gradients, which count at their cost; `offer` is the run's."""

    def __init__(self, inputs: Inputs, offer: TermsOffer, goal: Goal) -> None:
        super().__init__(inputs, goal)
        self.offer = offer

    def terms(self, u: FloatArray) -> SimulationSteps[Terms]:
        """Return the terms at u (n, d), n > 0."""
        terms = yield from request_terms(self.inputs.base.from_standard_normal(u))
        self.n_sim += len(u)
        return terms

    def gradients(
        self, u: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64]
    ) -> SimulationSteps[FloatArray]:
        """Return the gradients (n, d) by u of one term (n,), attained at ticks (n,), at each of the points u (n, d)."""
        if len(u) == 0:
            return np.empty_like(u)
        answer = yield from request_gradients(self.inputs.base.from_standard_normal(u), term, ticks)
        self.n_sim += whole_simulations(answer.cost)
        return pull_back(self.inputs.base, u, answer.values, noise_mask(self.inputs))


def pull_back(base: Any, u: FloatArray, gradients: FloatArray, noise: NDArray[np.bool_]) -> FloatArray:
    """Return the gradients (n, d) by x = T(u), at u (n, d), as gradients by u, block by block: no simulation.

    A block with `pull_back` has its own; others are differentiated by central differences, but for noise (d,), which is
    its own u. If each x_i depends on its own u_i alone, as the first point shows, one difference gives all of them.
    """
    if isinstance(base, StandardNormal) or noise.all():
        return gradients
    if hasattr(base, "pull_back"):
        return np.asarray(base.pull_back(u, gradients))
    blocks = tuple(getattr(base, "blocks", ()))  # independent, side by side
    dims = [block.dim for block in blocks]
    if sum(dims) == len(noise) and all(isinstance(block, Distribution) for block in blocks):
        ends = np.cumsum(dims)[:-1]
        parts = zip(blocks, *(np.split(each, ends, axis=-1) for each in (u, gradients, noise)), strict=True)
        return np.hstack([pull_back(*part) for part in parts])

    step = 1e-4  # standard deviations: the error is 1e-8, that of rounding 1e-12

    def differences(at: FloatArray, steps: FloatArray) -> FloatArray:
        ahead, behind = np.split(base.from_standard_normal(np.concatenate([at + steps, at - steps])), 2)
        return np.asarray((ahead - behind) / (2 * step))

    result, moved = gradients.copy(), np.flatnonzero(~noise)
    each = step * np.eye(len(noise))[moved]
    rows, columns = np.nonzero(differences(u[0], each))
    if (moved[rows] == columns).all():
        result[:, moved] *= differences(u, each.sum(axis=0))[:, moved]
    else:
        result[:, moved] = [differences(point, each) @ own for point, own in zip(u, gradients, strict=True)]
    return result


class Walks(NamedTuple):
    """Walks of several terms where they have come, and what they have met."""

    term: NDArray[np.int64]  # that each walk follows, (m,)
    u: FloatArray  # points reached, (m, d)
    fallen: FloatArray  # share of the way from the first value to the threshold, (m,)
    distance: FloatArray  # beta of the half-space that the last gradient describes; NaN for none; (m,)
    gradient_terms: NDArray[np.int64]  # (k,)
    gradients: FloatArray  # of unit length, at all points that the walks have passed, (k, d)
    failing_terms: NDArray[np.int64]  # the least ones, (l,)
    failures: FloatArray  # points at which f fails, of whatever term, (l, d)


def plan_walks(terms: Terms, budget: int, step: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the term of each walk and the base draw (a row of `terms`) that it starts from, shapes (m,).

    Main terms, which are often the least among low draws, have many walks, others two, most promising first, as many as
    can make two steps of a cost of `step` simulations. Of a term's starts half are low values attained late.
    """
    known = np.isfinite(terms.values).all(axis=1)
    lowest, numbers = terms.lowest, np.arange(terms.values.shape[1])
    none = np.empty(0, dtype=np.int64)
    if not known.any():
        return none, none
    low = known & (lowest <= np.quantile(lowest[known], 0.2))
    counts = np.bincount(terms.least[low], minlength=len(numbers))
    ever = np.isin(numbers, terms.least[known])
    main = counts >= max(WALKS.candidate_share * len(lowest), 1)
    affordable = int(WALKS.budget_share * budget / (2 * step))
    each = int(np.clip(min(WALKS.walkers, affordable) // max(main.sum(), 1), 2, WALKS.most))
    order = np.lexsort((terms.values[known].min(axis=0), ~ever))  # those that ever are the least come first
    others = [j for j in order if not main[j]][: max(WALKS.most_scouted, int((ever & ~main).sum()))]
    others = others[: max(affordable - each * int(main.sum()), 0) // WALKS.scouts]
    walked = [(j, each) for j in numbers[main]] + [(j, WALKS.scouts) for j in others]
    starts = [_choose_starts(terms.values[:, j], terms.ticks[:, j], n) for j, n in walked]
    return np.repeat([j for j, _ in walked], [len(one) for one in starts]).astype(np.int64), np.concatenate(
        [none, *starts]
    )


def _choose_starts(values: FloatArray, ticks: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Return at most n rows of the lower half of a term's values (k,), early and late ones by turns, lowest first."""
    order = np.argsort(values, kind="stable")
    order = order[np.isfinite(values[order])]
    lower = order[: max(len(order) // 2, n)]
    late = ticks[lower] > np.median(ticks[lower])
    turn = np.where(late, np.cumsum(late), np.cumsum(~late))
    return np.asarray(lower[np.argsort(turn, kind="stable")][:n])


def walk_downhill(
    simulator: TermSimulator, u: FloatArray, terms: Terms, term: NDArray[np.int64], gamma: float, limit: int
) -> SimulationSteps[Walks]:
    """Walk from points u (m, d) with known terms down one term each, until it fails or the steps are used up.

    A step goes along the gradient of the walk's `term` (m,), as far as the term would fall to its threshold if it were
    linear, but no further than its length. A step that does not fall is taken back, and its gradient kept. `limit` is
    a value of `simulator.n_sim` that is not exceeded.
    """
    rows, threshold = np.arange(len(u)), terms.threshold
    u, excess, ticks = u.copy(), terms.values[rows, term] - threshold, terms.ticks[rows, term].copy()
    first, distance, length = excess.copy(), np.full(len(u), np.nan), np.full(len(u), WALKS.first_step)
    unit, ahead, fresh = np.full_like(u, np.nan), np.full(len(u), np.nan), rows
    passed, failing = [(term[:0], u[:0])], [(term[:0], u[:0])]
    for _ in range(WALKS.steps):
        walking = (excess > 0) & ~(distance > WALKS.max_distance)
        cost = simulator.offer.count_gradients(len(fresh)) + int(walking.sum())
        if simulator.n_sim + cost > limit:
            break
        slope = yield from simulator.gradients(u[fresh], term[fresh], ticks[fresh])
        norm = np.linalg.norm(slope, axis=1)
        norm[~np.isfinite(norm) | (norm == 0)] = np.nan
        unit[fresh], ahead[fresh] = slope / norm[:, None], excess[fresh] / norm
        distance[fresh] = ahead[fresh] - np.einsum("ij,ij->i", unit[fresh], u[fresh])
        sloping = fresh[~np.isnan(norm)]
        passed.append((term[sloping], unit[sloping]))
        walkers = np.flatnonzero(walking & (distance <= WALKS.max_distance))
        if len(walkers) == 0:
            break
        size = np.minimum(ahead[walkers] + 0.03, length[walkers])  # beyond the threshold: rounding must not stop it
        reached = u[walkers] - size[:, None] * unit[walkers]
        seen = yield from simulator.terms(reached)
        known = np.isfinite(seen.f)
        fails = known & (seen.f <= gamma)
        failing.append((seen.least[fails], reached[fails]))
        own = np.arange(len(walkers)), term[walkers]
        fell = known & (seen.values[own] - threshold < excess[walkers])
        taken = walkers[fell]
        u[taken], excess[taken], ticks[taken] = (
            reached[fell],
            (seen.values[own] - threshold)[fell],
            seen.ticks[own][fell],
        )
        length[walkers] *= np.where(fell, WALKS.first_step, WALKS.shrinkage)
        fresh = taken[excess[taken] > 0]
    fallen = np.where(first > 0, 1 - excess / np.where(first > 0, first, 1.0), 1.0)
    met = [np.concatenate(parts) for found in (passed, failing) for parts in zip(*found, strict=True)]
    return Walks(term, u, fallen, distance, *met)
