"""Exploration: the search for every region of failure, the first stage of `TwoStage`.

Five sources. Subset simulation and lines of descent follow f downhill; the others use no more than whether a point
fails, so that plateaus, ties, jumps and misleading level sets do not matter to them:

1. Draws from the base distribution, and wide ones from N(0, s^2 I): a half-space at distance beta fails with
   probability Phi(-beta / s), whatever the dimension (`find_wide_failures`).
2. Subset simulation from the base draws, for regions too small to be hit by wide draws (`descend_levels`).
3. Lines of descent from low base draws, each a trial of its own of which region is found (`walk_lines`). They
   use nothing of the subset simulation, and are walked in the same batches (`join_batches`).
4. Chains inside the region of failure (pCN), started from all of these, so that wide failures become likely ones
   (`regions.py`).
5. The points half way between two failing points: if one fails, the two belong to one region (`regions.py`).

In subset simulation points descend from the few that were lowest at first: of 500 base draws three to five effectively
have descendants among the failures, and a region that none of these leads to is not found. No line of descent ends
because another one is lower: each is a trial of its own of which region is found, and nothing else: its end is no draw
given failure.

Slopes: in dozens of dimensions some hundred failing points do not show in which directions failures differ from
N(0, I). Gradients of f at a handful of points do, by finite differences, where few directions matter or f is the least
or largest of a few nearly linear functions. Each gradient costs a simulation for each dimension.

References:
    Uribe, Papaioannou, Marzouk and Straub, "Cross-entropy-based importance sampling with failure-informed dimension
    reduction for rare event simulation", SIAM/ASA Journal on Uncertainty Quantification 9, 2021 (eigenvectors of
    E[grad f grad f^T] over failures, there with gradients that the simulator gives).
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from samplers.components import IsotropicNormal, MixtureComponent, draw_components, log_ratios, mixture_log_ratio
from samplers.mcmc import (
    Chains,
    Growth,
    Kernel,
    NextLevel,
    descend,
    independent_chains,
    judge_levels,
    level_record,
)
from samplers.method import Goal, Interrupted
from samplers.methods.base import ComponentDraws, SimulationSteps, Simulator
from samplers.methods.two_stage.regions import (
    Discovery,
    ExplorationResult,
    Region,
    SubsetPoints,
    count_lineages,
    grow_regions,
    label_regions,
)
from samplers.methods.two_stage.settings import EXPLORATION, LINES, SLOPES, SUBSPACE
from samplers.problem import FloatArray
from samplers.sample import Level, Status, next_level

_A = TypeVar("_A")
_B = TypeVar("_B")
_T = TypeVar("_T")


def join_batches(first: SimulationSteps[_A], second: SimulationSteps[_B]) -> SimulationSteps[tuple[_A, _B]]:
    """Run two computations side by side and return what both return.

    Each batch holds the points that the first one waits for and then those of the second one, so that there are as
    many batches as the longer one alone has. They take turns in this order whatever the simulations take, so that one
    seed gives one answer; each should have a random generator of its own. `Interrupted` ends both.
    """
    one, other = _Activity(first), _Activity(second)
    while waiting := [each for each in (one, other) if each.points is not None]:
        try:
            f = yield np.concatenate([each.points for each in waiting if each.points is not None])
        except Interrupted:
            for each in waiting:
                each.interrupt()
            raise
        for each in waiting:
            f = each.take(f)
    return one.result, other.result


class _Activity(Generic[_T]):
    """A computation that was begun: the points that it waits for, None once it has its result."""

    points: FloatArray | None
    result: _T

    def __init__(self, steps: SimulationSteps[_T]) -> None:
        self._steps = steps
        self._advance(None)

    def take(self, f: FloatArray) -> FloatArray:
        """Go on with the first of these outcomes (m,), one for each of its points; return the others."""
        assert self.points is not None
        own, others = f[: len(self.points)], f[len(self.points) :]
        self._advance(own)
        return others

    def interrupt(self) -> None:
        """Let it count what it simulated: there will be no outcomes."""
        with suppress(Interrupted):
            self._steps.throw(Interrupted())

    def _advance(self, f: FloatArray | None) -> None:
        try:
            self.points = next(self._steps) if f is None else self._steps.send(f)
        except StopIteration as end:
            self.points, self.result = None, end.value


@dataclass(frozen=True)
class ExplorationPlanner:
    """Levels whose seeds are a random part of the points below the threshold, in chains of equal length."""

    gamma: float
    """Threshold of failure."""
    n: int
    """Points per level, a few more where the chains do not divide them."""
    budget: int
    """Simulations for all levels."""

    def plan_next(self, chains: Chains, depth: int, n_sim: int, rng: np.random.Generator) -> NextLevel | Status:
        """Return the next level, or how the descent ends: converged once `level_fraction` of the points fail."""
        points = chains.by_step()
        if depth == 0 and np.count_nonzero(points.f <= self.gamma) >= EXPLORATION.common_failures:
            return Status.CONVERGED
        threshold = next_level(points.f, EXPLORATION.level_fraction, self.gamma)
        if threshold == self.gamma:
            return Status.CONVERGED
        if threshold is None or depth >= EXPLORATION.max_levels:
            return Status.STALLED
        seeds = rng.permutation(np.flatnonzero(points.f <= threshold))[: self.n // EXPLORATION.points_per_seed]
        steps = max(1, math.ceil(self.n / len(seeds)) - 1)
        if n_sim + steps * len(seeds) > self.budget:
            return Status.BUDGET
        return NextLevel(threshold, points.select(seeds), np.full(len(seeds), steps + 1))


def descend_levels(
    simulator: Simulator, u: FloatArray, f: FloatArray, goal: Goal, n: int, most: int, rng: np.random.Generator
) -> SimulationSteps[SubsetPoints]:
    """Run subset simulation from base draws u (n, d), f (n,), until a tenth of a level fails or the budget is used.

    Where failures are common among the base draws, they are the last level.

    All candidates are kept, for the regressions around the regions; there is no estimate, so no level is recorded.
    """
    kernel = Kernel("conditional", EXPLORATION.initial_scale, EXPLORATION.level_acceptance)
    gamma = goal.gamma
    planner = ExplorationPlanner(gamma, n, most - simulator.n_sim)
    levels, thresholds = list[Growth](), list[float]()

    def record(growth: Growth, planned: NextLevel | Status) -> None:
        levels.append(growth)
        thresholds.append(planned.threshold if isinstance(planned, NextLevel) else gamma)

    first = independent_chains(u, f)
    status = yield from descend(simulator.inputs, first, kernel, planner.plan_next, record, rng)
    outcomes = np.concatenate([level.f_candidates for level in levels])
    simulator.n_sim += len(outcomes)
    if status is Status.STOPPED:
        raise Interrupted
    last = levels[-1].chains
    failing = last.where(last.f <= gamma)
    return SubsetPoints(
        np.unique(failing.u, axis=0),
        np.concatenate([level.candidates for level in levels]),
        outcomes,
        len(levels) - 1,
        np.unique(failing.roots),
        _upper_end([level.chains for level in levels], thresholds, goal),
    )


def _upper_end(levels: list[Chains], thresholds: list[float], goal: Goal) -> float:
    """Return the upper end of p by subset simulation."""
    trace = list[Level]()
    for chains, threshold in zip(levels, thresholds, strict=True):
        trace.append(level_record(chains, threshold, trace))
    return judge_levels(levels[-1], goal, trace)[1][1]


def choose_roots(f: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the indices of at most n base draws with outcomes f (m,) to start from: a random part of the lowest."""
    lowest = np.lexsort((rng.random(len(f)), f))[: max(int(LINES.root_share * len(f)), n)]
    return rng.permutation(lowest)[:n]


def walk_lines(
    simulator: Simulator,
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    scale: float,
    rng: np.random.Generator,
    room: int | None = None,
) -> SimulationSteps[tuple[FloatArray, NDArray[np.bool_]]]:
    """Walk downhill from points u (n, d) with outcomes f (n,); return where the lines end, and which of them fail.

    A step has one try or more, v = sqrt(1 - s^2) u + s xi with xi ~ N(0, I); in the first of them xi is that of the
    step before if that was a gain. The line goes to the first try with f(v) < f(u), else to the first with f(v) = f(u).
    All lines take a step in one batch: where half of them have arrived, the others have two tries each. The longer it
    takes, the fewer lines go on. They end together: when all have arrived, at twice the median time of arrival once
    most have, where hardly any arrives, or at the limit of simulations (times `scale`); with `room` they have so many,
    however few arrive.
    """
    u, f, n = u.copy(), f.copy(), len(f)
    s, kept, gained = np.full(n, LINES.initial_step), np.zeros_like(u), np.zeros(n, dtype=bool)
    arrival = np.where(f <= gamma, 0.0, np.inf)
    used = time = 0
    while np.isinf(arrival).any() and not _is_late(arrival, time, used / scale, room):
        on = np.flatnonzero(np.isinf(arrival))
        on = on[on < max(1, scale * LINES.steps / max(time, 1))]
        if len(on) == 0:
            break
        tries = min(n // len(on), LINES.most_tries)
        xi = rng.standard_normal((len(on), tries, u.shape[1]))
        xi[gained[on], 0] = kept[on[gained[on]]]
        v = np.sqrt(1 - s[on, None, None] ** 2) * u[on, None] + s[on, None, None] * xi
        new = (yield from simulator.evaluate(v.reshape(-1, u.shape[1]))).reshape(xi.shape[:2])
        used, time = used + new.size, time + 1
        fresh = np.ones(new.shape, dtype=bool)
        fresh[:, 0] = ~gained[on]
        change = LINES.adaptation * (((new <= f[on, None]) - LINES.acceptance) * fresh).sum(axis=1)
        s[on] = np.clip(s[on] * np.exp(change), *LINES.step_range)
        best = np.arange(len(on)), _choose_tries(f[on], new)
        kept[on], gained[on], moves = xi[best], new[best] < f[on], new[best] <= f[on]
        u[on[moves]], f[on[moves]] = v[best][moves], new[best][moves]
        arrival[on[f[on] <= gamma]] = time
    return u, np.isfinite(arrival)


def _choose_tries(f: FloatArray, new: FloatArray) -> NDArray[np.int64]:
    """Return the number of the try (n,) that each line goes to from f (n,), if any: the first gain, else the first tie.

    Not the best one, which would be more often where f falls steeply, whichever region that is.
    """
    gain, tie = new < f[:, None], new == f[:, None]
    return np.asarray(np.where(gain.any(axis=1), gain.argmax(axis=1), tie.argmax(axis=1)))


def _is_late(arrival: FloatArray, time: int, used: float, room: int | None) -> bool:
    """Return whether the lines that are still on their way are given up."""
    arrived = np.isfinite(arrival)
    share = float(arrived.mean())
    if share >= LINES.most_arrived and time >= LINES.patience * float(np.median(arrival[arrived])):
        return True
    if room is not None:
        return used >= room
    return used >= LINES.limit or (used >= LINES.first_look and share < LINES.few_arrived)


TINY = 1e-300
"""Least length to divide by."""


def _choose_wide(u: FloatArray, scale: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
    """Return at most n of failing wide draws u (k, d) of N(0, s^2 I), s = scale (k,): half of them the least wide ones.

    Each of the rest is the one furthest in direction from all before it: no region that was met is left out by
    chance, as one in six of six_d8 was in 1 run of 60.
    """
    order = np.lexsort((rng.random(len(scale)), scale))
    near, rest = order[: n // 2], rng.permutation(order[n // 2 :])
    if len(order) > n:
        rest = rest[_spread_directions(u[near], u[rest], n - len(near))]
    return np.take(u, np.append(near, rest), axis=0)


def _spread_directions(known: FloatArray, u: FloatArray, n: int) -> NDArray[np.intp]:
    """Return the rows of n of the points u (m, d), m >= n, one by one the furthest in direction from all before it."""
    known, u = (points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), TINY) for points in (known, u))
    cosine = (u @ known.T).max(axis=1, initial=-1.0)
    chosen = np.empty(n, dtype=np.intp)
    for place in range(n):
        k = chosen[place] = int(cosine.argmin())
        cosine = np.maximum(cosine, u @ u[k])
        cosine[k] = np.inf
    return chosen


def draw_isotropic(
    simulator: Simulator, sizes: Sequence[tuple[float, int]], rng: np.random.Generator
) -> SimulationSteps[ComponentDraws]:
    """Simulate draws: for each (s, n), n of N(0, s^2 I)."""
    components: list[MixtureComponent] = [IsotropicNormal(simulator.inputs.dim, scale) for scale, _ in sizes]
    counts = np.array([n for _, n in sizes])
    u = draw_components(components, counts, rng)
    f = yield from simulator.evaluate(u)
    return ComponentDraws(components, counts, u, f)


def bisect_towards_origin(simulator: Simulator, u: FloatArray, gamma: float, steps: int) -> SimulationSteps[FloatArray]:
    """Move failing points (n, d) towards the origin along their rays, by bisection; they still fail."""
    safe, failing = np.zeros(len(u)), np.ones(len(u))
    for _ in range(steps):
        middle = 0.5 * (safe + failing)
        fails = (yield from simulator.evaluate(u * middle[:, None])) <= gamma
        failing, safe = np.where(fails, middle, failing), np.where(fails, safe, middle)
    return u * failing[:, None]


class Sizes(NamedTuple):
    """Simulations for each part of the exploration."""

    scale: float  # by what the numbers of the settings are multiplied
    base: int  # base draws
    wide: tuple[tuple[float, int], ...]  # (s, draws)
    level: int  # points of each level of subset simulation
    starts: int  # chains from wide failures at most
    level_starts: int  # chains from failures of subset simulation at most, more where wide draws fail less often
    most: int  # simulations after which no further level is begun
    limit: int  # simulations of the whole exploration

    @classmethod
    def within(cls, budget: int) -> "Sizes":
        """Return the sizes for a budget."""
        usual = EXPLORATION.usual_budget
        scale = budget / usual if budget < usual else math.sqrt(budget / usual)
        return cls(
            scale=scale,
            base=round(EXPLORATION.base * scale),
            wide=tuple((width, round(n * scale)) for width, n in EXPLORATION.wide),
            level=max(EXPLORATION.least_level, round(EXPLORATION.level * scale)),
            starts=max(EXPLORATION.least_starts, round(EXPLORATION.starts * scale)),
            level_starts=max(EXPLORATION.least_level_starts, round(EXPLORATION.level_starts * scale)),
            most=int(EXPLORATION.descent_share * budget),
            limit=int(EXPLORATION.share * budget),
        )


def find_regions(
    simulator: Simulator, first: ComponentDraws, goal: Goal, sizes: Sizes, rng: np.random.Generator
) -> SimulationSteps[ExplorationResult]:
    """Find the regions of failure, starting from the first draws; none if nothing fails."""
    n_base, gamma = int(first.counts[0]), goal.gamma
    base_u, base_f = first.u[:n_base], first.f[:n_base]
    drawn = ComponentDraws(first.components[1:], first.counts[1:], first.u[n_base:], first.f[n_base:])
    for_levels, for_lines = rng.spawn(2)
    (descent, wide), (ends, line_roots) = yield from join_batches(
        _pass_levels(simulator, base_u, base_f, drawn, goal, sizes, for_levels),
        _find_lines(simulator, base_u, base_f, gamma, sizes.scale, for_lines),
    )
    roots = len(np.union1d(descent.roots, line_roots))
    wide_fails = wide.f <= gamma
    wide_u = wide.u[wide_fails]
    density = mixture_log_ratio(log_ratios(wide.components, wide_u), wide.counts.astype(np.float64))
    discovery = Discovery(count_lineages(roots, -density), descent.ceiling)
    most = max(2, (sizes.limit - simulator.n_sim) // EXPLORATION.chain_cost)
    scales = [one.scale for one in wide.components if isinstance(one, IsotropicNormal)]
    chosen = _choose_wide(wide_u, np.repeat(scales, wide.counts)[wide_fails], min(sizes.starts, most), rng)
    far, (labels, _) = yield from join_batches(
        bisect_towards_origin(simulator, chosen, gamma, EXPLORATION.bisections),
        label_regions(simulator, ends, gamma, sizes.limit),
    )
    if simulator.inputs.dim > SUBSPACE.high_dim and labels.max(initial=-1) + 1 >= LINES.many_regions:
        region = Region(ends[:, None], descent.u, descent.f)
        return ExplorationResult([region], noisy=False, scattered=True, levels=descent.levels, discovery=discovery)
    order, n_regions = rng.permutation(len(ends)), int(labels.max(initial=-1)) + 1
    few = [order[labels[order] == k][: LINES.starts] for k in range(n_regions)]  # of each region
    near = np.take(ends, np.concatenate([np.empty(0, dtype=np.int64), *few]), axis=0)
    others = min(max(sizes.level_starts, sizes.starts + sizes.level_starts - len(far)), most - len(far))
    starts = np.concatenate([far, near, rng.permutation(descent.failing)[: max(others - len(near), 0)]])
    if len(starts) == 0:
        return ExplorationResult([], noisy=False, discovery=discovery)
    result = yield from grow_regions(simulator, starts, descent, gamma, sizes.limit, rng)
    return result._replace(discovery=discovery)


def _pass_levels(
    simulator: Simulator,
    u: FloatArray,
    f: FloatArray,
    drawn: ComponentDraws,
    goal: Goal,
    sizes: Sizes,
    rng: np.random.Generator,
) -> SimulationSteps[tuple[SubsetPoints, ComponentDraws]]:
    """Run subset simulation from base draws u (n, d), f (n,); make further wide draws if the levels went deep."""
    descent = yield from descend_levels(simulator, u, f, goal, sizes.level, sizes.most, rng)
    scale = -float(ndtri(10 ** -(descent.levels + 0.5))) / EXPLORATION.depth_ratio
    if scale > EXPLORATION.deep_scale:
        n = round(EXPLORATION.deep_draws * sizes.scale)
        deep = yield from draw_isotropic(simulator, ((scale, n),), rng)
        drawn = ComponentDraws(
            [*drawn.components, *deep.components],
            np.concatenate([drawn.counts, deep.counts]),
            np.concatenate([drawn.u, deep.u]),
            np.concatenate([drawn.f, deep.f]),
        )
    return descent, drawn


def _find_lines(
    simulator: Simulator, u: FloatArray, f: FloatArray, gamma: float, scale: float, rng: np.random.Generator
) -> SimulationSteps[tuple[FloatArray, NDArray[np.int64]]]:
    """Walk lines from base draws u (n, d), f (n,); return their failing ends (k, d), moved inwards, and roots (k,)."""
    roots = choose_roots(f, max(1, round(scale * LINES.n)), rng)
    ends, failing = yield from walk_lines(simulator, u[roots], f[roots], gamma, scale, rng)
    near = yield from bisect_towards_origin(simulator, ends[failing], gamma, EXPLORATION.bisections)
    return near, roots[failing]


def find_slopes(
    simulator: Simulator,
    exploration: ExplorationResult,
    gamma: float,
    room: int,
    rng: np.random.Generator,
) -> SimulationSteps[FloatArray | None]:
    """Return orthonormal directions in which f changes around the failures, shape (d, r); None where they are not few.

    The gradients are made in three batches. Later ones go where the known directions explain least, and are not made
    where there are too many directions, or where the batch before was explained by what was known.
    """
    dim = simulator.inputs.dim
    short = exploration.scattered or dim > SUBSPACE.high_dim
    n = min(int((SLOPES.high_dim_share if short else SLOPES.share) * room / (dim + 1)), SLOPES.most)
    if dim < SLOPES.min_dim or n < SLOPES.least or exploration.noisy or not exploration.regions:
        return None
    points = _collect_points(exploration, gamma, rng)
    first = max(n - n // 2, SLOPES.least)
    chosen = np.argsort(points.turns, kind="stable")[:first]
    slopes = yield from _differentiate(simulator, points.u[chosen], SLOPES.step)
    for size in ((n - first + 1) // 2, (n - first) // 2):
        if not _have_few_directions(slopes):
            return None
        axes, points = _leading_directions(slopes), points.leave_out(chosen)
        chosen = _choose_unexplained(points, size, axes)
        more = yield from _differentiate(simulator, points.u[chosen], SLOPES.step)
        slopes = np.concatenate([slopes, more])
        if ((more @ axes) ** 2).sum() >= SLOPES.explained * len(more):
            break
    return _leading_directions(slopes) if _have_few_directions(slopes) else None


class _Points(NamedTuple):
    """Where gradients may be made."""

    u: FloatArray
    """Shape (n, d)."""
    fails: NDArray[np.bool_]
    """Shape (n,)."""
    turns: NDArray[np.int64]
    """Number of the point among those of its region that fail, or do not, from 0, shape (n,)."""

    def leave_out(self, chosen: NDArray[np.int64]) -> "_Points":
        """Return the others."""
        kept = np.setdiff1d(np.arange(len(self.u)), chosen)
        return _Points(self.u[kept], self.fails[kept], self.turns[kept])


def _collect_points(exploration: ExplorationResult, gamma: float, rng: np.random.Generator) -> _Points:
    """Return the ends of the chains of each region, and points beside it, each in a random order.

    f may be capped within a region or beside it: points whose outcome others share have no gradient. Where failure
    needs several things at once, a point beside the region lacks the one that all points inside may have in plenty.
    """
    groups, fails = list[FloatArray](), list[bool]()
    for region in exploration.regions:
        _, where, counts = np.unique(region.f, return_inverse=True, return_counts=True)
        tied, failing = counts[where] > 1, region.f <= gamma
        flat = failing.any() and tied[failing].mean() > 0.5
        groups += [region.chains[: 0 if flat else None, -1], region.u[~failing & ~tied]]
        fails += [True, False]
    sizes = [len(u) for u in groups]
    return _Points(
        np.concatenate([rng.permutation(u) for u in groups]),
        np.repeat(fails, sizes),
        np.concatenate([np.arange(size) for size in sizes]),
    )


def _choose_unexplained(points: _Points, n: int, axes: FloatArray) -> NDArray[np.int64]:
    """Return the indices (k,) of at most n points whose outcomes known directions (d, r) explain least.

    Half of them fail though they are short along these directions, the others are long and do not fail.
    """
    length = np.linalg.norm(points.u @ axes, axis=1)
    shortest = np.argsort(np.where(points.fails, length, np.inf), kind="stable")[: points.fails.sum()]
    longest = np.argsort(np.where(points.fails, np.inf, -length), kind="stable")[: (~points.fails).sum()]
    half = longest[: n // 2]
    return np.concatenate([shortest[: n - len(half)], half])


def _differentiate(simulator: Simulator, u: FloatArray, step: float) -> SimulationSteps[FloatArray]:
    """Return the unit gradients (k, d) of f at those of the points u (n, d) where it has one."""
    n, dim = u.shape
    beside = u[:, None] + step * np.eye(dim)
    f = yield from simulator.evaluate(np.concatenate([u, beside.reshape(-1, dim)]))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # f may be infinite, or flat
        slopes = f[n:].reshape(n, dim) - f[:n, None]
        unit = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return np.asarray(unit[np.isfinite(unit).all(axis=1)])


def _have_few_directions(slopes: FloatArray) -> bool:
    """Return whether unit gradients (k, d) lie in fewer directions than random ones would.

    The squares s^2 of the singular values of k random directions are worth about k d / (k + d) equal ones: that is
    (sum s^2)^2 / sum s^4.
    """
    k, dim = slopes.shape
    if k < SLOPES.least:
        return False
    squares = np.linalg.svd(slopes, compute_uv=False) ** 2
    return bool(squares.sum() ** 2 / (squares**2).sum() <= SLOPES.few * k * dim / (k + dim))


def _leading_directions(slopes: FloatArray) -> FloatArray:
    """Return the principal directions (d, r) of unit gradients (k, d)."""
    _, sizes, axes = np.linalg.svd(slopes, full_matrices=False)
    used = sizes**2 > SLOPES.least_part * len(slopes)
    return np.asarray(axes[used][: SLOPES.most_axes].T)
