"""Gradient walks, and terms with their gradients in standard normal space, where what they cost is counted."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from samplers.method import Goal, TermsOffer, request_gradients, request_terms, whole_simulations
from samplers.methods.base import SimulationSteps, Simulator, noise_mask
from samplers.methods.series.settings import WALKS
from samplers.problem import Distribution, FloatArray, Inputs, StandardNormal, Terms

_T = TypeVar("_T")

DIFFERENCE = 1e-4
"""Standard deviations of a central difference: its error is 1e-8, that of rounding 1e-12."""
POINTS_AT_ONCE = 4
"""Points at which T is differentiated at once: 4 with 386 groups of 1,448 coordinates take 70 MB."""
PATTERN_POINTS = 3
"""Points at which it is seen which coordinates of u a coordinate of x depends on."""


def join_terms(parts: Sequence[Terms]) -> Terms:
    """Return the terms of some batches, at least one, as those of one."""
    f, values, ticks = (np.concatenate([getattr(one, name) for one in parts]) for name in ("f", "values", "ticks"))
    return Terms(f, values, ticks, parts[0].threshold, next((one.names for one in parts if one.names), ()))


def answer_by_terms(
    steps: Generator[FloatArray, FloatArray, _T], read: Callable[[FloatArray, Terms], FloatArray]
) -> Generator[FloatArray, FloatArray, _T]:
    """Run steps that ask for f (n,) at points (n, d), with terms requested in its place, from which `read` gives f."""
    answer: FloatArray | None = None
    while True:
        try:
            x = next(steps) if answer is None else steps.send(answer)
        except StopIteration as end:
            return cast(_T, end.value)
        if len(x) == 0:
            answer = np.empty(0)
            continue
        try:
            terms = yield from request_terms(x)
        except BaseException as error:
            try:
                steps.throw(error)
            except StopIteration as end:
                return cast(_T, end.value)
            raise
        answer = read(x, terms)


class TermSimulator(Simulator):
    """The way from standard normal space to terms and gradients, which count at their cost; `offer` is the run's."""

    def __init__(self, inputs: Inputs, offer: TermsOffer, goal: Goal) -> None:
        super().__init__(inputs, goal)
        self.offer = offer
        self._slopes: TransformSlopes | None = None

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
        if self._slopes is None:
            self._slopes = TransformSlopes(self.inputs)
        return self._slopes.pull_back(u, answer.values)


class TransformSlopes:
    """Derivatives of x = T(u), the map from standard normal space, block by block: no simulation.

    A block with `pull_back`, as here, has its own; others are differentiated by `DifferencedMap`.
    """

    def __init__(self, inputs: Inputs) -> None:
        base, noise = inputs.base, noise_mask(inputs)
        self._identity = isinstance(base, StandardNormal)
        blocks: tuple[Any, ...] = tuple(getattr(base, "blocks", ()))  # independent, side by side
        dims = [block.dim for block in blocks]
        if sum(dims) != inputs.dim or not all(isinstance(block, Distribution) for block in blocks):
            blocks, dims = (base,), [inputs.dim]
        self._ends = np.cumsum(dims)[:-1]
        self._maps = [
            block if hasattr(block, "pull_back") else DifferencedMap(block, own)
            for block, own in zip(blocks, np.split(noise, self._ends), strict=True)
        ]

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return the gradients (n, d) with respect to x at T(u), u (n, d), as gradients with respect to u."""
        if self._identity:
            return gradients
        parts = (np.split(points, self._ends, axis=1) for points in (u, gradients))
        return np.hstack([each.pull_back(*part) for each, *part in zip(self._maps, *parts, strict=True)])


class DifferencedMap:
    """Derivatives of x = T(u) by finite differences of it.

    Coordinates of noise are themselves. Others that no coordinate of x depends on together are moved at the same time,
    as Curtis, Powell and Reid ("On the estimation of sparse Jacobian matrices", 1974) do: where each x depends on its
    own u alone, one difference gives all of them.
    """

    def __init__(self, base: Distribution, noise: NDArray[np.bool_]) -> None:
        self._base = base
        self._moved = np.flatnonzero(~noise)
        self._groups: list[NDArray[np.int64]] | None = None
        self._pattern = np.zeros((0, len(noise)), dtype=bool)

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return the gradients (n, d) with respect to x at T(u), u (n, d), as gradients with respect to u."""
        if self._groups is None:
            self._groups = self._find_pattern(u[:PATTERN_POINTS])
        result = gradients.copy()  # noise, where dx / du = I
        for first in range(0, len(u), POINTS_AT_ONCE):
            part = slice(first, first + POINTS_AT_ONCE)
            slopes = self._differences(u[part], [self._moved[group] for group in self._groups])
            for group, slope in zip(self._groups, slopes, strict=True):
                result[part, self._moved[group]] = (slope * gradients[part]) @ self._pattern[group].T
        return result

    def _find_pattern(self, u: FloatArray) -> list[NDArray[np.int64]]:
        """Find which coordinates of x each moved coordinate of u changes; return groups of them that do not meet."""
        self._pattern = (self._differences(u, list(self._moved[:, None])) != 0).any(axis=1)
        groups, taken = list[list[int]](), list[NDArray[np.bool_]]()
        for number, row in enumerate(self._pattern):
            k = next((k for k, seen in enumerate(taken) if not (seen & row).any()), len(groups))
            if k == len(groups):
                groups.append([])
                taken.append(np.zeros_like(row))
            groups[k].append(number)
            taken[k] = taken[k] | row
        return [np.array(group) for group in groups]

    def _differences(self, u: FloatArray, groups: list[NDArray[np.int64]]) -> FloatArray:
        """Return central differences of T at u (n, d), with the coordinates of each group moved together, (k, n, d)."""
        steps = np.zeros((len(groups), 1, u.shape[1]))
        for row, group in zip(steps, groups, strict=True):
            row[0, group] = DIFFERENCE
        x = self._base.from_standard_normal(np.concatenate([u + steps, u - steps]).reshape(-1, u.shape[1]))
        ahead, behind = x.reshape(2, len(groups), *u.shape)
        return np.asarray((ahead - behind) / (2 * DIFFERENCE))


class Directions(NamedTuple):
    """Unit gradients of terms, where they exist."""

    term: NDArray[np.int64]
    """Shape (k,)."""
    values: FloatArray
    """Shape (k, d)."""
    design_points: FloatArray
    """Points nearest to the origin of the half-spaces that the gradients describe, shape (k, d); NaN where the term is
    not near its threshold."""

    def of(self, term: int) -> "Directions":
        """Return those of one term."""
        mine = self.term == term
        return Directions(self.term[mine], self.values[mine], self.design_points[mine])

    def join(self, later: "Directions") -> "Directions":
        """Return these and later ones."""
        return Directions(*(np.concatenate(pair) for pair in zip(self, later, strict=True)))


MIN_WALK_STEPS = 2
"""Steps that there must be room for before another walk is begun."""
NEAR_FAILURES = 1.5
"""Standard deviations along the gradient to the threshold within which a gradient is taken for that of the failures."""


def describe_half_spaces(term: NDArray[np.int64], u: FloatArray, slopes: FloatArray, excess: FloatArray) -> Directions:
    """Return unit gradients where they exist, and the half-spaces {excess + slope (v - u) <= 0} of those near them.

    The terms (k,) have these slopes (k, d) at points u (k, d), where they exceed their threshold by `excess` (k,).
    """
    norm = np.linalg.norm(slopes, axis=1)
    good = np.isfinite(norm) & (norm > 0)
    unit, ahead = slopes[good] / norm[good, None], excess[good] / norm[good]
    distance = ahead - np.einsum("ij,ij->i", unit, u[good])
    near = (np.abs(ahead) <= NEAR_FAILURES) & (distance > 0)
    return Directions(term[good], unit, np.where(near, -distance, np.nan)[:, None] * unit)


@dataclass(frozen=True, eq=False)
class Walks:
    """Walks of several terms where they have come."""

    term: NDArray[np.int64]
    """Term that each walk follows, shape (m,)."""
    u: FloatArray
    """Points reached, shape (m, d)."""
    values: FloatArray
    """The term there, shape (m,)."""
    start_values: FloatArray
    """The term where they began, shape (m,)."""
    ticks: NDArray[np.int64]
    """When it is attained, shape (m,)."""
    distance: FloatArray
    """Of the origin from the half-space that the last gradient of each walk describes, beta; NaN for none; (m,)."""
    directions: Directions
    """At all points that the walks have passed."""
    failures: FloatArray
    """Points on the way at which f fails, of whatever term, shape (k, d)."""
    failing_terms: NDArray[np.int64]
    """Their least terms, shape (k,)."""


def choose_terms(terms: Terms) -> tuple[list[int], list[int]]:
    """Return main terms, which are often the least among low draws, and other terms to scout, most promising first."""
    lowest, known = terms.lowest, np.isfinite(terms.values).all(axis=1)
    if not known.any():
        return [], []
    low = known & (lowest <= np.quantile(lowest[known], WALKS.candidate_quantile))
    n_terms = terms.values.shape[1]
    counts = np.bincount(terms.least[low], minlength=n_terms)
    ever = np.bincount(terms.least[known], minlength=n_terms) > 0
    main = [j for j in range(n_terms) if counts[j] >= max(WALKS.candidate_share * len(lowest), 1)]
    order = np.lexsort((terms.values[known].min(axis=0), ~ever))  # those that ever are the least come first
    others = [int(j) for j in order if j not in main]
    return main, others[: max(WALKS.max_scouted, int(ever.sum()) - len(main))]


def count_walks(n_main: int, n_others: int, budget: int, step: float) -> tuple[int, int]:
    """Return the walks of each main term, and how many other terms are scouted, so that all can make two steps."""
    affordable = int(WALKS.budget_share * budget / (MIN_WALK_STEPS * step))
    walkers = WALKS.walkers * min(1.0, budget / WALKS.usual_budget)
    wanted = int(np.clip(walkers / max(n_main, 1), WALKS.min_walkers, WALKS.max_walkers))
    each = min(wanted, max(affordable // max(n_main, 1), 2))
    return each, min(n_others, max(affordable - each * n_main, 0) // WALKS.scouts)


def choose_starts(terms: Terms, term: int, n: int) -> NDArray[np.int64]:
    """Return the rows from which n walks of a term start: low values, half of them attained late."""
    values, ticks = terms.values[:, term], terms.ticks[:, term]
    order = np.argsort(values, kind="stable")
    order = order[np.isfinite(values[order])]
    lower = order[: max(int(WALKS.start_quantile * len(order)), n)]
    late = ticks[lower] > np.median(ticks[lower])
    chosen = [*lower[late][: n // 2], *lower[~late][: n - n // 2]]
    chosen += [row for row in lower if row not in chosen][: n - len(chosen)]
    return np.array(chosen[:n], dtype=np.int64)


def walk_downhill(
    simulator: TermSimulator, u: FloatArray, terms: Terms, term: NDArray[np.int64], gamma: float, limit: int
) -> SimulationSteps[Walks]:
    """Walk from points u (m, d) with known terms down one term each, until it fails or the steps are used up.

    A step goes along the gradient of the walk's `term` (m,), as far as the term would fall to its threshold if it were
    linear, but no further than its length. A step that does not fall is taken back, and its gradient kept. `limit` is
    a value of `simulator.n_sim` that is not exceeded.
    """
    rows = np.arange(len(u))
    distance = np.full(len(u), np.nan)
    start_values = terms.values[rows, term]
    u, values, ticks = u.copy(), terms.values[rows, term].copy(), terms.ticks[rows, term].copy()
    slope, length, moved = np.full_like(u, np.nan), np.full(len(u), WALKS.first_step), np.ones(len(u), dtype=bool)
    passed = describe_half_spaces(term[:0], u[:0], u[:0], values[:0])
    failing = list[tuple[FloatArray, NDArray[np.int64]]]()
    for step in range(WALKS.steps):
        open_ = (values > terms.threshold) & ~(distance > WALKS.max_distance)
        fresh = np.flatnonzero(moved & (open_ | (step == 0)))
        cost = simulator.offer.count_gradients(len(fresh)) + int(open_.sum())
        if not (len(fresh) or open_.any()) or simulator.n_sim + cost > limit:
            break
        slope[fresh] = yield from simulator.gradients(u[fresh], term[fresh], ticks[fresh])
        norm = np.linalg.norm(slope, axis=1)
        sloping = np.isfinite(norm) & (norm > 0)
        good = fresh[sloping[fresh]]
        excess = values - terms.threshold
        passed = passed.join(describe_half_spaces(term[fresh], u[fresh], slope[fresh], excess[fresh]))
        ahead_of = excess / np.where(sloping, norm, np.nan)
        distance[good] = ahead_of[good] - np.einsum("ij,ij->i", slope[good], u[good]) / norm[good]
        walkers = np.flatnonzero(open_ & sloping & (distance <= WALKS.max_distance))
        if len(walkers) == 0:
            break
        size = np.minimum(ahead_of[walkers] + WALKS.beyond, length[walkers])
        ahead = u[walkers] - (size / norm[walkers])[:, None] * slope[walkers]
        seen = yield from simulator.terms(ahead)
        known = np.isfinite(seen.f)
        fails = known & (seen.f <= gamma)
        failing.append((ahead[fails], seen.least[fails]))
        value = seen.values[np.arange(len(walkers)), term[walkers]]
        fell = known & (value < values[walkers])
        taken = walkers[fell]
        u[taken], values[taken] = ahead[fell], value[fell]
        ticks[taken] = seen.ticks[np.flatnonzero(fell), term[taken]]
        length[walkers] *= np.where(fell, WALKS.growth, WALKS.shrinkage)
        moved = np.zeros(len(u), dtype=bool)
        moved[taken] = True
    return Walks(
        term,
        u,
        values,
        start_values,
        ticks,
        distance,
        passed,
        np.concatenate([u[:0], *(points for points, _ in failing)]),
        np.concatenate([np.empty(0, np.int64), *(least for _, least in failing)]),
    )
