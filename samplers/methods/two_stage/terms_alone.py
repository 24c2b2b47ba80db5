"""Unexplored terms: searches of their own for terms of f that the exploration has met but has no failures of.

Where f is a least over terms, the exploration follows f, and a term that is the least in few places can be lost: points
go where another term is lower. All points of the exploration are simulated with their terms. A term that was the least
at any of them, and in which no state of the chains fails, is then followed alone: from points where it fails, or by
lines of descent on its own value from low base draws. A failure of a term is a failure of f, so that chains grow from
the ends, and their regions become components like any others.
"""

import math
from collections.abc import Generator
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from samplers.components import IsotropicNormal
from samplers.method import request_terms
from samplers.methods.base import ComponentDraws, SimulationSteps, Simulator
from samplers.methods.series.walks import answer_by_terms, join_terms
from samplers.methods.two_stage.exploration import bisect_towards_origin, choose_roots, walk_lines
from samplers.methods.two_stage.regions import ExplorationResult, SubsetPoints, grow_regions
from samplers.methods.two_stage.settings import EXPLORATION, TERMS_ALONE
from samplers.problem import FloatArray, FunctionProblem, Terms

_T = TypeVar("_T")


class TermRecord:
    """Points of the exploration with their terms, and the terms whose failures were searched for and not found.

    It is changed in place, as the count of the simulator is. `unreached` has the names of terms that were the least
    somewhere and of which no failure is known, those that were followed alone and those for which no simulations were
    left, and the probability from which on a half-space would have been hit by the first draws.
    """

    def __init__(self) -> None:
        self._x, self._terms = list[FloatArray](), list[Terms]()
        self.unreached: tuple[tuple[str, ...], tuple[str, ...], float] = (), (), 0.0

    @property
    def several(self) -> bool:
        """Whether there is more than one term, as far as is known."""
        return not (self._terms and self._terms[0].values.shape[1] == 1)

    def watch(self, steps: Generator[FloatArray, FloatArray, _T]) -> Generator[FloatArray, FloatArray, _T]:
        """Run steps that ask for f with terms requested in its place; where there is but one term, f is enough."""
        return (yield from answer_by_terms(steps, self._add) if self.several else steps)

    def _add(self, x: FloatArray, terms: Terms) -> FloatArray:
        self._x.append(x)
        self._terms.append(terms)
        return terms.f

    def join(self) -> tuple[FloatArray, Terms]:
        """Return all points (n, d), n > 0, and their terms, in the order in which they were simulated."""
        return np.concatenate(self._x), join_terms(self._terms)

    def describe(self, p: float) -> tuple[str, ...]:
        """Return remarks on the terms that were not reached, for an estimate p."""
        searched, unsearched, limit = self.unreached
        share = f" ({limit / p:.0e} of p)" if p > 0 else ""
        bound = f"the first draws rule out a half-space with probability above {limit:.0e}{share}"
        parts = (("searched one by one without reaching failure", searched), ("not searched one by one", unsearched))
        return tuple(
            f"Terms that were smallest at some points but have no known failure ({how}): {_list_names(names)}; {bound}."
            for how, names in parts
            if names
        )


def explore_terms(
    simulator: Simulator,
    exploration: ExplorationResult,
    record: TermRecord,
    first: ComponentDraws,
    gamma: float,
    room: int,
    rng: np.random.Generator,
) -> SimulationSteps[ExplorationResult]:
    """Search for failures of the terms that the exploration has met but has no failures of; add their regions."""
    if exploration.noisy or exploration.scattered or not record.several:
        return exploration
    x, terms = record.join()
    fails = (terms.values <= terms.threshold) & np.isfinite(terms.f)[:, None]
    within = int(TERMS_ALONE.chain_share * room)
    known, met, others = _rank_missing(simulator, exploration, x, terms, fails, int(first.counts[0]))
    searched = met[: math.ceil(TERMS_ALONE.line_share * room / TERMS_ALONE.usual_cost)]
    scouted = others[: math.ceil(TERMS_ALONE.scout_share * room / TERMS_ALONE.usual_cost)]
    starts = [
        _choose_failures(simulator, x[fails[:, j]], terms.values[fails[:, j], j], TERMS_ALONE.lines) for j in known
    ]
    for group, share in ((searched, TERMS_ALONE.line_share), (scouted, TERMS_ALONE.scout_share)):
        each = int(share * room) // max(len(group), 1)
        starts += [_choose_low_draws(first, terms, j, each, rng) for j in group]
    descents = [_descend_alone(start, terms.threshold, rng) for start in starts]
    nearest = [float((region.points**2).sum(axis=1).min()) for region in exploration.regions]
    far = min(nearest, default=math.inf) - 2 * math.log(TERMS_ALONE.least_density)  # |u|^2 of failures that matter
    numbers = np.array([*known, *searched, *scouted], dtype=np.int64)
    ends = yield from _run_together(simulator, descents, numbers, far)
    likely = [points[(points**2).sum(axis=1) <= far] for points in ends]
    ranked = [points[rank] for rank in range(TERMS_ALONE.lines) for points in likely if rank < len(points)]
    chosen = np.array(ranked[: within // EXPLORATION.chain_cost])
    if len(chosen):
        none = SubsetPoints(chosen[:0], chosen[:0], np.empty(0))
        grown = yield from grow_regions(simulator, chosen, none, gamma, simulator.n_sim + within, rng)
        discovery = exploration.discovery._replace(lineages=max(exploration.discovery.lineages, 1.0))
        exploration = exploration._replace(regions=[*exploration.regions, *grown.regions], discovery=discovery)
    names = terms.names or tuple(str(j) for j in range(terms.values.shape[1]))
    arrived = dict(zip(numbers.tolist(), map(len, ends), strict=True))
    missed = tuple(names[j] for j in searched if not arrived[j])
    record.unreached = missed, tuple(names[j] for j in met[len(searched) :]), hit_limit(first)
    return exploration


def _rank_missing(
    simulator: Simulator, exploration: ExplorationResult, x: FloatArray, terms: Terms, fails: NDArray[np.bool_], n: int
) -> tuple[list[int], list[int], list[int]]:
    """Return the terms of which no state of a chain fails: those known to fail, those that were the least, others.

    States of chains were simulated: each is one of the points x, the nearest one but for rounding. Terms with the least
    reliability index of first order, mean above the threshold over standard deviation, among the n base draws come
    first (Cornell, "A probability-based structural code", 1969).
    """
    from scipy.spatial import cKDTree  # slow to import, and seldom needed

    held: NDArray[np.bool_] = np.zeros(terms.values.shape[1], dtype=bool)
    if exploration.regions:
        states = np.concatenate([region.points for region in exploration.regions])
        rows = cKDTree(x).query(simulator.inputs.base.from_standard_normal(states))[1]
        held = np.asarray(fails[rows].any(axis=0))
    usual = terms.values[:n][np.isfinite(terms.values[:n]).all(axis=1)]
    spread = usual.std(axis=0)
    index = np.where(spread > 0, (usual.mean(axis=0) - terms.threshold) / np.maximum(spread, 1e-300), np.inf)
    numbers = np.arange(len(held))
    fail = np.asarray(fails.any(axis=0))
    least = np.isin(numbers, terms.least[np.isfinite(terms.f)])
    order = [int(j) for j in np.argsort(index, kind="stable") if not held[j]]
    known = [j for j in order if fail[j]]
    met = [j for j in order if least[j] and not fail[j]]
    others = [j for j in order if not least[j] and not fail[j] and np.isfinite(index[j])]
    return known, met, others


class _Starts(NamedTuple):
    """Points from which lines on one term start."""

    u: FloatArray
    """Shape (n, d)."""
    values: FloatArray
    """The term there, shape (n,)."""
    room: int
    """Simulations of these lines."""


def _choose_failures(simulator: Simulator, x: FloatArray, values: FloatArray, n: int) -> _Starts:
    """Return the n likeliest of points x (m, d) where a term fails."""
    u = simulator.inputs.base.to_standard_normal(x)
    finite = np.flatnonzero(np.isfinite(u).all(axis=1))
    nearest = finite[np.argsort((u[finite] ** 2).sum(axis=1), kind="stable")][:n]
    return _Starts(u[nearest], values[nearest], 0)


def _choose_low_draws(first: ComponentDraws, terms: Terms, term: int, room: int, rng: np.random.Generator) -> _Starts:
    """Return base draws where a term is low; they are the first points that were simulated."""
    values = terms.values[: int(first.counts[0]), term]
    roots = choose_roots(values, TERMS_ALONE.lines, rng)
    return _Starts(first.u[roots], values[roots], room)


def _descend_alone(start: _Starts, threshold: float, rng: np.random.Generator) -> SimulationSteps[FloatArray]:
    """Walk to failures of a term and towards the origin; yields points u, is sent values of the term."""
    own = Simulator(FunctionProblem(lambda u: u[:, 0], start.u.shape[1]))  # its x is u
    ends, failing = yield from walk_lines(own, start.u, start.values, threshold, 1.0, rng, start.room)
    return (yield from bisect_towards_origin(own, ends[failing], threshold, EXPLORATION.bisections))


def _run_together(
    simulator: Simulator, searches: list[SimulationSteps[FloatArray]], terms: NDArray[np.int64], far: float
) -> SimulationSteps[list[FloatArray]]:
    """Run searches that yield points u, each on its own term, in common batches; return what they return."""
    ends = [np.empty((0, simulator.inputs.dim))] * len(searches)
    sent: dict[int, FloatArray | None] = dict.fromkeys(range(len(searches)))
    while sent:
        asked = dict[int, FloatArray]()
        for k, answer in sent.items():
            try:
                u = next(searches[k]) if answer is None else searches[k].send(answer)
            except StopIteration as end:
                ends[k] = end.value
            else:
                if float((u**2).sum(axis=1).min()) <= far:
                    asked[k] = u
        sent = {}
        if asked:
            counts = [len(u) for u in asked.values()]
            x = simulator.inputs.base.from_standard_normal(np.concatenate([*asked.values()]))
            seen = yield from request_terms(x)
            simulator.n_sim += len(x)
            own = seen.values[np.arange(len(x)), np.repeat(terms[list(asked)], counts)]
            sent = dict(zip(asked, np.split(own, np.cumsum(counts)[:-1]), strict=True))
    return ends


def hit_limit(first: ComponentDraws, confidence: float = 0.95) -> float:
    """Return the probability from which on a half-space is hit by draws from several N(0, s^2 I) with this confidence.

    One at distance beta is hit by a draw with probability Phi(-beta / s), and by none of them with about
    exp(-sum_s n_s Phi(-beta / s)).
    """
    from scipy.optimize import brentq  # slow to import, and seldom needed

    scales = np.array([one.scale if isinstance(one, IsotropicNormal) else 1.0 for one in first.components])
    wanted = -float(np.log1p(-confidence))
    beta = brentq(lambda b: float(first.counts @ ndtr(-b / scales)) - wanted, 0.0, 40.0 * scales.max())
    return float(ndtr(-beta))


def _list_names(names: tuple[str, ...], most: int = 3) -> str:
    """Return some names, and how many more there are."""
    more = len(names) - most
    return ", ".join(f"'{name}'" for name in names[:most]) + (f" and {more} more" if more > 0 else "")
