"""Exploration: the search for every region of failure, the first stage of `TwoStage`.

Five sources. Subset simulation and lines of descent follow f downhill; the others use no more than whether a point
fails, so that plateaus, ties, jumps and misleading level sets do not matter to them:

1. Draws from the base distribution, and wide ones from N(0, s^2 I): a half-space at distance beta fails with
   probability Phi(-beta / s), whatever the dimension.
2. Subset simulation from the base draws, for regions too small to be hit by wide draws (`descend_levels`).
3. Lines of descent from low base draws, each a trial of its own of which region is found (`walk_lines`). They
   use nothing of the subset simulation, and are walked in the same batches (`join_batches`).
4. Chains inside the region of failure (pCN), started from all of these, so that wide failures become likely ones
   (`regions.py`).
5. The points half way between two failing points: if one fails, the two belong to one region (`regions.py`).

In subset simulation points descend from the few that were lowest at first: of 500 base draws three to five effectively
have descendants among the failures, and a region that none of these leads to is not found. No line of descent ends
because another one is lower. Its end is no draw given failure.

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
from functools import partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc import Chains, Kernel, NextLevel, RootedPoints, descend, independent_chains, judge_levels
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
from samplers.methods.two_stage.settings import BUDGET, EXPLORATION, HIGH_DIM, LINES, SLOPES
from samplers.problem import FloatArray
from samplers.proposals import IsotropicNormal, MixtureComponent, draw_components, log_ratios, mixture_log_ratio
from samplers.sample import Status, next_level

LEAST_SLOPES = 4
"""Gradients that two directions can be told from many with."""
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


def _plan_level(
    gamma: float, n: int, budget: int, chains: Chains, depth: int, n_sim: int, rng: np.random.Generator
) -> NextLevel | Status:
    """Return the next level, of n points or a few more, or how the descent ends: converged once a tenth of them fail.

    Its seeds are a random part of the points below the threshold, its chains of equal length.
    """
    step, chain = np.nonzero(chains.used.T)  # the first of every chain, the second of every chain, and so on
    points = RootedPoints(chains.u[chain, step], chains.f[chain, step], chains.roots[chain])
    if depth == 0 and np.count_nonzero(points.f <= gamma) >= EXPLORATION.common_failures:
        return Status.CONVERGED
    threshold = next_level(points.f, EXPLORATION.level_fraction, gamma)
    if threshold == gamma:
        return Status.CONVERGED
    if threshold is None or depth >= 30:  # the budget ends the descent first unless f ties
        return Status.STALLED
    seeds = rng.permutation(np.flatnonzero(points.f <= threshold))[: n // 3]  # chains take two steps or more
    steps = max(1, math.ceil(n / len(seeds)) - 1)
    if n_sim + steps * len(seeds) > budget:
        return Status.BUDGET
    return NextLevel(threshold, points.select(seeds), np.full(len(seeds), steps + 1))


def descend_levels(
    simulator: Simulator, u: FloatArray, f: FloatArray, goal: Goal, n: int, most: int, rng: np.random.Generator
) -> SimulationSteps[SubsetPoints]:
    """Run subset simulation from base draws u (n, d), f (n,), until a tenth of a level fails or the budget is used.

    If failures are common among the base draws, they are the last level.

    All candidates are kept, for the regressions around the regions; there is no estimate, so no level is recorded.
    """
    kernel = Kernel("conditional", 0.6, EXPLORATION.level_acceptance)  # begins as `AdaptiveSubsetSimulation` does
    gamma, plan = goal.gamma, partial(_plan_level, goal.gamma, n, most - simulator.n_sim)
    first = independent_chains(u, f)
    levels, trace, status = yield from descend(simulator.inputs, first, kernel, plan, gamma, rng)
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
        judge_levels(last, goal, trace)[1][1],
    )


def walk_lines(
    simulator: Simulator, u: FloatArray, f: FloatArray, gamma: float, scale: float, rng: np.random.Generator
) -> SimulationSteps[tuple[FloatArray, NDArray[np.bool_]]]:
    """Walk downhill from points u (n, d) with outcomes f (n,); return where the lines end, and which of them fail.

    A step tries v = sqrt(1 - s^2) u + s xi, with xi ~ N(0, I), or that of the step before if it was a gain, and goes
    there if f(v) <= f(u). The longer it takes, the fewer lines go on: where failures are far off, few lines that arrive
    are better than many that do not. They end when all have arrived, at twice the median time of arrival once most
    have, or at the limit of simulations (times `scale`).
    """
    u, f, n = u.copy(), f.copy(), len(f)
    s, kept, gained = np.full(n, 0.35), np.zeros_like(u), np.zeros(n, dtype=bool)
    arrival, used, time = np.where(f <= gamma, 0.0, np.inf), 0, 0
    while np.isinf(arrival).any() and used < LINES.limit * scale:
        arrived = np.isfinite(arrival)
        if arrived.mean() >= 0.6 and time >= 2 * float(np.median(arrival[arrived])):
            break
        on = np.flatnonzero(~arrived)
        on = on[on < max(1, scale * 300 / max(time, 1))]
        if len(on) == 0:
            break
        xi = np.where(gained[on, None], kept[on], rng.standard_normal((len(on), u.shape[1])))
        v = np.sqrt(1 - s[on, None] ** 2) * u[on] + s[on, None] * xi
        new = yield from simulator.evaluate(v)
        used, time, better = used + len(on), time + 1, new <= f[on]
        change = 0.5 * np.where(gained[on], 0.0, better - LINES.acceptance)  # of log s, by fresh steps alone
        s[on] = np.clip(s[on] * np.exp(change), 0.03, 1.0)
        kept[on], gained[on] = xi, new < f[on]
        u[on[better]], f[on[better]] = v[better], new[better]
        arrival[on[f[on] <= gamma]] = time
    return u, np.isfinite(arrival)


def draw_isotropic(
    simulator: Simulator, sizes: Sequence[tuple[float, int]], rng: np.random.Generator
) -> SimulationSteps[ComponentDraws]:
    """Simulate draws: for each (s, n), n of N(0, s^2 I)."""
    components: list[MixtureComponent] = [IsotropicNormal(simulator.inputs.dim, scale) for scale, _ in sizes]
    counts = np.array([n for _, n in sizes])
    u = draw_components(components, counts, rng)
    f = yield from simulator.evaluate(u)
    return ComponentDraws(components, counts, u, f)


def bisect_towards_origin(simulator: Simulator, u: FloatArray, gamma: float) -> SimulationSteps[FloatArray]:
    """Move failing points (n, d) towards the origin along their rays, to an eighth of the way; they still fail."""
    safe, failing = np.zeros(len(u)), np.ones(len(u))
    for _ in range(3):
        middle = 0.5 * (safe + failing)
        fails = (yield from simulator.evaluate(u * middle[:, None])) <= gamma
        failing, safe = np.where(fails, middle, failing), np.where(fails, safe, middle)
    return u * failing[:, None]


def contract(
    simulator: Simulator, u: FloatArray, gamma: float, rng: np.random.Generator
) -> SimulationSteps[FloatArray]:
    """Move failing points (n, d) that are unlikely by their length to likely ones: drop random directions of them.

    A point of N(0, I) has |u|^2 = d + 2 sqrt(2 d) or less in 98 of 100 cases. From further out than that and 40 more,
    chains of a dozen steps do not come to where failures are likely. Half of the directions are dropped at once at
    first, half as many after a try that does not fail.
    """
    u, dim = u.copy(), u.shape[1]
    size = np.full(len(u), dim // 2)
    for _ in range(8 if dim > 1 else 0):
        far = np.flatnonzero((u**2).sum(axis=1) > dim + 2 * math.sqrt(2 * dim) + 40)
        shorter = _drop_directions(u[far], size[far], rng)
        fails = (yield from simulator.evaluate(shorter)) <= gamma
        u[far[fails]] = shorter[fails]
        size[far[~fails]] = np.maximum(size[far[~fails]] // 2, 1)
    return u


def _drop_directions(u: FloatArray, n: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
    """Return points u (k, d) without their components in n (k,) random directions each, 0 < n < d.

    The component in a random subspace is |u| (s a + sqrt(s (1 - s)) b), with a the direction of u, b a random one
    across it and s ~ Beta(n / 2, (d - n) / 2), the share of |u|^2.
    """
    length = np.linalg.norm(u, axis=1, keepdims=True)
    along, across = u / length, rng.standard_normal(u.shape)
    across -= (across * along).sum(axis=1, keepdims=True) * along
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    s = rng.beta(n / 2, (u.shape[1] - n) / 2)[:, None]
    return np.asarray(u - length * (s * along + np.sqrt(s * (1 - s)) * across))


class Sizes(NamedTuple):
    """Simulations for each part of the exploration."""

    scale: float  # by what the numbers of the settings are multiplied
    base: int  # base draws
    wide: tuple[tuple[float, int], ...]  # (s, draws)
    level: int  # points of each level of subset simulation
    starts: int  # chains from wide failures at most; as many more from failures of the lines and the levels
    most: int  # simulations after which no further level is begun
    limit: int  # simulations of the whole exploration

    @classmethod
    def within(cls, budget: int) -> "Sizes":
        """Return the sizes for a budget."""
        usual = BUDGET.usual
        scale = budget / usual if budget < usual else math.sqrt(budget / usual)
        return cls(
            scale=scale,
            base=round(EXPLORATION.base * scale),
            wide=tuple((width, round(n * scale)) for width, n in EXPLORATION.wide),
            level=max(100, round(EXPLORATION.level * scale)),
            starts=max(10, round(EXPLORATION.starts * scale)),
            most=int(EXPLORATION.level_share * budget),
            limit=int(EXPLORATION.share * budget),
        )


def find_regions(
    simulator: Simulator, first: ComponentDraws, goal: Goal, sizes: Sizes, rng: np.random.Generator
) -> SimulationSteps[ExplorationResult]:
    """Find the regions of failure, starting from the first draws; none if nothing fails."""
    n_base, gamma = int(first.counts[0]), goal.gamma
    base_u, base_f = first.u[:n_base], first.f[:n_base]
    for_levels, for_lines = rng.spawn(2)
    descent, (ends, line_roots) = yield from join_batches(
        descend_levels(simulator, base_u, base_f, goal, sizes.level, sizes.most, for_levels),
        _find_lines(simulator, base_u, base_f, gamma, sizes.scale, for_lines),
    )
    wide_u = first.u[n_base:][first.f[n_base:] <= gamma]
    density = mixture_log_ratio(log_ratios(first.components[1:], wide_u), first.counts[1:].astype(np.float64))
    roots = len(np.union1d(descent.roots, line_roots))
    discovery = Discovery(count_lineages(roots, -density), ceiling=descent.ceiling)
    most = max(2, (sizes.limit - simulator.n_sim) // 25)  # a chain takes as many: bisection, steps, points half way
    nearest, n_far = np.argsort((wide_u**2).sum(axis=1), kind="stable"), min(sizes.starts, most)
    others = rng.permutation(nearest[n_far // 2 :])[: n_far - n_far // 2]  # no region that was met is left out by rule
    chosen = wide_u[np.append(nearest[: n_far // 2], others)]
    far, (labels, _) = yield from join_batches(
        bisect_towards_origin(simulator, chosen, gamma), label_regions(simulator, ends, gamma, sizes.limit)
    )
    n_regions = int(labels.max(initial=-1)) + 1
    if simulator.inputs.dim > HIGH_DIM and n_regions >= LINES.many_regions:
        region = Region(ends[:, None], descent.u, descent.f)
        return ExplorationResult([region], noisy=False, scattered=True, levels=descent.levels, discovery=discovery)
    order = rng.permutation(len(ends))
    few = [order[labels[order] == k][:4] for k in range(n_regions)]  # of each region
    near = np.take(ends, np.concatenate([np.empty(0, dtype=np.int64), *few]), axis=0)
    more = max(min(2 * sizes.starts, most) - len(far) - len(near), 0)  # what wide draws do not reach, the levels do
    starts = np.concatenate([far, near, rng.permutation(descent.failing)[:more]])
    if len(starts) == 0:
        return ExplorationResult([], noisy=False, discovery=discovery)
    starts = yield from contract(simulator, starts, gamma, rng)
    result = yield from grow_regions(simulator, starts, gamma, sizes.limit, rng)
    if len(result.regions) == 1 and not result.noisy:
        result = result._replace(regions=[_add_levels(result.regions[0], descent)])
    return result._replace(levels=descent.levels, discovery=discovery._replace(regions=len(result.regions)))


def _add_levels(region: Region, descent: SubsetPoints) -> Region:
    """Return a region with the lower points of subset simulation, if its own are too few for a regression."""
    if len(region.f) >= 3 * region.u.shape[1] or len(descent.f) == 0:
        return region
    low = descent.f <= np.quantile(descent.f, 0.7, method="lower")  # f may be infinite
    return Region(region.chains, np.concatenate([region.u, descent.u[low]]), np.concatenate([region.f, descent.f[low]]))


def _find_lines(
    simulator: Simulator, u: FloatArray, f: FloatArray, gamma: float, scale: float, rng: np.random.Generator
) -> SimulationSteps[tuple[FloatArray, NDArray[np.int64]]]:
    """Walk lines from low base draws u (n, d), f (n,); return their failing ends (k, d), moved inwards, and roots."""
    n = max(1, round(scale * LINES.n))
    lowest = np.lexsort((rng.random(len(f)), f))[: max(int(0.1 * len(f)), n)]
    roots = rng.permutation(lowest)[:n]
    ends, failing = yield from walk_lines(simulator, u[roots], f[roots], gamma, scale, rng)
    near = yield from bisect_towards_origin(simulator, ends[failing], gamma)
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
    if there are too many directions, or if the batch before was explained by what was known.
    """
    dim = simulator.inputs.dim
    short = exploration.scattered or dim > HIGH_DIM
    n = min(int(SLOPES.shares[short] * room / (dim + 1)), SLOPES.most)
    sought = any(len(exploration.regions) >= regions and dim >= least for regions, least in SLOPES.min_dims)
    if not sought or n < LEAST_SLOPES or exploration.noisy:
        return None
    points = _collect_points(exploration, gamma, rng)
    first = max(n - n // 2, LEAST_SLOPES)
    chosen = np.argsort(points.turns, kind="stable")[:first]
    slopes = yield from _differentiate(simulator, points.u[chosen], 0.05)  # f bends little over it
    for size in ((n - first + 1) // 2, (n - first) // 2):
        if not _have_few_directions(slopes):
            return None
        axes, others = _leading_directions(slopes), np.setdiff1d(np.arange(len(points.u)), chosen)
        points = _Points(points.u[others], points.fails[others], points.turns[others])
        # half of them fail though they are short along these directions, the others are long and do not fail
        length = np.linalg.norm(points.u @ axes, axis=1)
        shortest = np.argsort(np.where(points.fails, length, np.inf), kind="stable")[: points.fails.sum()]
        longest = np.argsort(np.where(points.fails, np.inf, -length), kind="stable")[: (~points.fails).sum()]
        half = longest[: size // 2]
        chosen = np.concatenate([shortest[: size - len(half)], half])
        more = yield from _differentiate(simulator, points.u[chosen], 0.05)
        slopes = np.concatenate([slopes, more])
        if ((more @ axes) ** 2).sum() >= 0.99 * len(more):  # nothing new
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


def _collect_points(exploration: ExplorationResult, gamma: float, rng: np.random.Generator) -> _Points:
    """Return the ends of the chains of each region, and points beside it, each in a random order.

    f may be capped within a region or beside it: points whose outcome others share have no gradient. If failure
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
    if k < LEAST_SLOPES:
        return False
    squares = np.linalg.svd(slopes, compute_uv=False) ** 2
    return bool(squares.sum() ** 2 / (squares**2).sum() <= SLOPES.few * k * dim / (k + dim))


def _leading_directions(slopes: FloatArray) -> FloatArray:
    """Return the principal directions (d, r) of unit gradients (k, d)."""
    _, sizes, axes = np.linalg.svd(slopes, full_matrices=False)
    used = sizes**2 > 0.005 * len(slopes)  # noise of f bends gradients less
    return np.asarray(axes[used][: SLOPES.most_axes].T)
