"""Finding every region of failure: the first stage of `TwoStage`.

Four sources, of which only subset simulation follows f downhill; the others ask no more than whether a point fails,
so that plateaus, ties, jumps and level sets that lead astray do not matter to them:

1. Draws from the base law, and wide ones from N(0, s^2 I): a half-space at distance beta fails with probability
   Phi(-beta / s), whatever the dimension.
2. Subset simulation from the base draws, for regions too small to be hit by wide draws.
3. Chains inside the region of failure (pCN), started from both, so that wide failures become likely ones.
4. Whether the point half way between two failing points fails as well: then they belong to one region. Near convex
   regions are kept apart by this in any dimension, however alike they look.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.bumps import HIGH_DIM
from samplers.components import Component, Wide, draw
from samplers.kernels import conditional_proposal
from samplers.levels import next_level
from samplers.planes import falling
from samplers.problem import FloatArray, Inputs

LEVEL_FRACTION = 0.1
LEVEL_ACCEPTANCE = 0.35
MOST_LEVELS = 30
BISECTIONS = 3
MOST_REGIONS = 8
MOST_CLONES = 60
COST_OF_CHAIN = 25
"""Simulations that a chain needs at most before it is sorted: bisection, two walks, looks at its region."""
PROBES = 30
NUDGE = 1e-6
NOISY = 0.9
"""Where less than this share of the points right beside failing ones fail, f is noisy."""


@dataclass(frozen=True)
class Sizes:
    """How many simulations the parts of the exploration use."""

    base: int
    wide: tuple[tuple[float, int], ...]
    """(s, draws)."""
    level: int
    """Points of each level of subset simulation."""
    starts: int
    """Chains from wide failures at most."""
    level_starts: int
    """Chains from failures of subset simulation at most, and more of them where wide draws fail less often."""
    most: int
    """Simulations after which no further level is begun."""
    limit: int
    """Simulations of the whole exploration."""

    @classmethod
    def within(cls, budget: int) -> "Sizes":
        """Return sizes for a budget: in proportion up to 6,000, with its square root above."""
        scale = budget / 6000 if budget < 6000 else math.sqrt(budget / 6000)
        return cls(
            base=round(500 * scale),
            wide=((1.5, round(120 * scale)), (2.2, round(120 * scale)), (3.0, round(80 * scale))),
            level=max(100, round(250 * scale)),
            starts=max(10, round(40 * scale)),
            level_starts=max(6, round(16 * scale)),
            most=int(0.45 * budget),
            limit=int(0.65 * budget),
        )


class Simulator:
    """Turns points of standard normal space into outcomes, and counts."""

    def __init__(self, inputs: Inputs) -> None:
        self.inputs = inputs
        self.n_sim = 0

    def f(self, u: FloatArray) -> Generator[FloatArray, FloatArray, FloatArray]:
        """Ask for f at u (n, d), shape (n,)."""
        if len(u) == 0:
            return np.empty(0)
        f = yield self.inputs.base.from_standard_normal(u)
        self.n_sim += len(u)
        return f


class Batch(NamedTuple):
    """Draws from known components."""

    components: list[Component]
    counts: NDArray[np.int64]
    """Draws of each, in this order."""
    u: FloatArray
    f: FloatArray


class Region(NamedTuple):
    """One region of failure."""

    chains: FloatArray
    """States of chains inside it, shape (chains, steps, d)."""
    u: FloatArray
    """Points proposed to them, failing or not, shape (n, d)."""
    f: FloatArray
    """Outcomes of these, shape (n,)."""

    @property
    def points(self) -> FloatArray:
        """All states, shape (chains x steps, d)."""
        return self.chains.reshape(-1, self.chains.shape[2])


class Walk(NamedTuple):
    """Where chains went."""

    states: FloatArray
    """Shape (chains, steps, d)."""
    proposals: FloatArray
    """Shape (chains, steps, d)."""
    f: FloatArray
    """Outcomes of the proposals, shape (chains, steps)."""
    sigma: FloatArray
    """Adapted steps, shape (chains,)."""

    def of(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> "Walk":
        """Return some of the chains."""
        return Walk(*(part[which] for part in self))


class Descent(NamedTuple):
    """What subset simulation saw."""

    failing: FloatArray
    """Distinct failing points of its last level, shape (k, d)."""
    u: FloatArray
    """All points simulated, shape (n, d)."""
    f: FloatArray


class Found(NamedTuple):
    """What the exploration found."""

    regions: list[Region]
    noisy: bool
    """Whether f has noise of its own: then regions cannot be told apart, and all of it is one."""


Ask = Generator[FloatArray, FloatArray, Batch]


def first_draws(simulator: Simulator, sizes: Sizes, rng: np.random.Generator) -> Ask:
    """Simulate the base and the wide draws."""
    dim = simulator.inputs.dim
    components: list[Component] = [Wide(dim), *(Wide(dim, scale) for scale, _ in sizes.wide)]
    counts = np.array([sizes.base, *(n for _, n in sizes.wide)])
    u = draw(components, counts, rng)
    f = yield from simulator.f(u)
    return Batch(components, counts, u, f)


def regions_of(
    simulator: Simulator, first: Batch, gamma: float, sizes: Sizes, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, Found]:
    """Find the regions of failure, starting from the first draws; none if nothing fails."""
    n_base = int(first.counts[0])
    descent = yield from _descend(simulator, first.u[:n_base], first.f[:n_base], gamma, sizes, rng)
    wide = np.flatnonzero(first.f[n_base:] <= gamma) + n_base
    scale = np.repeat(np.arange(len(first.counts)), first.counts)
    most = max(2, (sizes.limit - simulator.n_sim) // COST_OF_CHAIN)
    chosen = wide[_some(scale[wide], min(sizes.starts, most), rng)]
    far = yield from _drawn_in(simulator, first.u[chosen], gamma)
    others = max(sizes.level_starts, sizes.starts + sizes.level_starts - len(far))
    starts = np.concatenate([far, rng.permutation(descent.failing)[: min(others, most - len(far))]])
    if len(starts) == 0:
        return Found([], noisy=False)
    return (yield from _grown(simulator, starts, descent, gamma, sizes.limit, rng))


def _grown(
    simulator: Simulator, starts: FloatArray, descent: Descent, gamma: float, limit: int, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, Found]:
    """Run chains from failing points, twice; sort them into regions after each time."""
    dim = starts.shape[1]
    steps = (5, 6) if dim <= HIGH_DIM else (8, 8)
    walk = yield from _walk(simulator, starts, np.full(len(starts), 0.5), None, steps[0], gamma, rng)
    if (yield from _is_noisy(simulator, walk.states[:, -1], gamma, rng)):
        last = yield from _walk(simulator, walk.states[:, -1], walk.sigma, None, steps[1], gamma, rng)
        region = Region(last.states[:, 1:], last.proposals.reshape(-1, dim), last.f.ravel())
        return Found([region], noisy=True)
    after = len(starts) * (steps[1] + 1)  # the second walk, and one look at where it ended
    labels = yield from _same_region(simulator, walk.states[:, -1], gamma, limit - after, rng)
    room = max(limit - simulator.n_sim - after, 0) // (steps[1] + 1)
    more = _clones(labels, min(max(8, math.ceil(2.5 * dim / steps[1])), 24), room, rng)
    walk, labels = walk.of(more), labels[more]
    directions = np.array([_direction(walk.of(labels == k), _few(labels, descent)) for k in range(labels.max() + 1)])
    start, sigma = walk.states[:, -1], walk.sigma
    last = yield from _walk(simulator, start, sigma, directions[labels], steps[1], gamma, rng)
    labels = yield from _same_region(simulator, last.states[:, -1], gamma, limit, rng)
    kept = 2 if dim <= HIGH_DIM else 4  # early proposals to wide failures are far from where failures are likely
    proposals = np.concatenate([walk.proposals[:, -kept:], last.proposals], axis=1)
    f = np.concatenate([walk.f[:, -kept:], last.f], axis=1)
    regions = []
    for k in range(labels.max() + 1):
        own = labels == k
        regions.append(Region(last.states[own, 1:], proposals[own].reshape(-1, dim), f[own].ravel()))
    return Found([_with_descent(regions[0], descent)] if len(regions) == 1 else regions, noisy=False)


def _descend(
    simulator: Simulator, u: FloatArray, f: FloatArray, gamma: float, sizes: Sizes, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, Descent]:
    """Run subset simulation from base draws u (n, d), f (n,), until a tenth of a level fails or the budget is used."""
    points, outcomes = [u[:0]], [f[:0]]
    sigma = 0.6
    for _ in range(MOST_LEVELS):
        level = next_level(f, LEVEL_FRACTION, gamma)
        if level is None or level == gamma:
            break
        seeds = rng.permutation(np.flatnonzero(f <= level))[: sizes.level // 3]
        steps = max(1, math.ceil(sizes.level / len(seeds)) - 1)
        if simulator.n_sim + steps * len(seeds) > sizes.most:
            break
        u_chain, f_chain = u[seeds], f[seeds]
        states, at = [u_chain], [f_chain]
        for step in range(1, steps + 1):
            proposal = conditional_proposal(u_chain, np.full(u.shape[1], sigma), rng)
            f_new = yield from simulator.f(proposal)
            points.append(proposal)
            outcomes.append(f_new)
            accepted = f_new <= level
            u_chain, f_chain = np.where(accepted[:, None], proposal, u_chain), np.where(accepted, f_new, f_chain)
            states.append(u_chain)
            at.append(f_chain)
            sigma = min(sigma * math.exp((accepted.mean() - LEVEL_ACCEPTANCE) / math.sqrt(step)), 1.0)
        u, f = np.concatenate(states), np.concatenate(at)
    return Descent(np.unique(u[f <= gamma], axis=0), np.concatenate(points), np.concatenate(outcomes))


def _some(scale: NDArray[np.int64], n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose n of the wide failures: half of them the least wide ones, the rest at random."""
    order = np.lexsort((rng.random(len(scale)), scale))
    return np.concatenate([order[: n // 2], rng.permutation(order[n // 2 :])[: n - n // 2]])


def _drawn_in(simulator: Simulator, u: FloatArray, gamma: float) -> Generator[FloatArray, FloatArray, FloatArray]:
    """Draw failing points (n, d) towards the origin along their rays, by bisection; they still fail."""
    safe, failing = np.zeros(len(u)), np.ones(len(u))
    for _ in range(BISECTIONS):
        middle = 0.5 * (safe + failing)
        fails = (yield from simulator.f(u * middle[:, None])) <= gamma
        failing, safe = np.where(fails, middle, failing), np.where(fails, safe, middle)
    return u * failing[:, None]


def _walk(
    simulator: Simulator,
    u: FloatArray,
    sigma: FloatArray,
    directions: FloatArray | None,
    steps: int,
    gamma: float,
    rng: np.random.Generator,
) -> Generator[FloatArray, FloatArray, Walk]:
    """Move chains inside the region of failure by pCN, each with its own step.

    With directions (n, d) the step sigma (n,) is that along them, and every other direction is drawn nearly afresh:
    failures beyond a plane are standard normal there, and chains forget where they started at once.
    """
    across = np.ones(len(u))
    states, proposals, outcomes = [], [], []
    for step in range(1, steps + 1):
        width = sigma if directions is None else across
        xi = rng.standard_normal(u.shape)
        proposal = np.sqrt(1 - width**2)[:, None] * u + width[:, None] * xi
        if directions is not None:
            along = np.sqrt(1 - sigma**2) * (u * directions).sum(axis=1) + sigma * (xi * directions).sum(axis=1)
            proposal += (along - (proposal * directions).sum(axis=1))[:, None] * directions
        f = yield from simulator.f(proposal)
        fails = f <= gamma
        u = np.where(fails[:, None], proposal, u)
        if directions is None:
            sigma = np.clip(sigma * np.exp(0.7 * (fails - LEVEL_ACCEPTANCE) / math.sqrt(step)), 0.02, 1.0)
        else:
            across = np.clip(across * np.where(fails, 1.1, 0.75), 0.05, 1.0)
            sigma = np.clip(sigma * np.where(fails, 1.05, 0.9), 0.02, 1.0)
        states.append(u)
        proposals.append(proposal)
        outcomes.append(f)
    return Walk(np.stack(states, axis=1), np.stack(proposals, axis=1), np.stack(outcomes, axis=1), sigma)


def _is_noisy(
    simulator: Simulator, u: FloatArray, gamma: float, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, bool]:
    """Return whether points right beside failing ones (n, d) do not always fail."""
    u = rng.permutation(u)[:PROBES]
    f = yield from simulator.f(u + NUDGE * rng.standard_normal(u.shape))
    return float((f <= gamma).mean()) < NOISY


def _same_region(
    simulator: Simulator, u: FloatArray, gamma: float, limit: int, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, NDArray[np.int64]]:
    """Sort failing points (n, d) into regions, numbered from 0: those half way to whose first point fails.

    Points left over after MOST_REGIONS regions or at the limit of simulations go to the region with the nearest mean.
    """
    labels = np.full(len(u), -1)
    for k in range(MOST_REGIONS):
        free = np.flatnonzero(labels < 0)
        if len(free) == 0:
            break
        first = rng.choice(free)
        labels[first] = k
        others = free[free != first]
        if simulator.n_sim + len(others) > limit:
            break
        fails = (yield from simulator.f(0.5 * (u[others] + u[first]))) <= gamma
        labels[others[fails]] = k
    free = np.flatnonzero(labels < 0)
    if len(free):
        means = np.array([u[labels == k].mean(axis=0) for k in range(labels.max() + 1)])
        labels[free] = np.argmax(u[free] @ means.T - 0.5 * (means**2).sum(axis=1), axis=1)
    return labels


def _clones(labels: NDArray[np.int64], least: int, room: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the numbers of all chains, those of regions with few repeated until there are `least` or no room is."""
    more = []
    for k in range(labels.max() + 1):
        own = np.flatnonzero(labels == k)
        more.append(rng.choice(own, max(least - len(own), 0)))
    return np.concatenate([np.arange(len(labels)), np.concatenate(more)[: min(room, MOST_CLONES)]])


def _few(labels: NDArray[np.int64], descent: Descent) -> Descent | None:
    """Return the descent where there is one region only, so that its points belong to it."""
    return descent if labels.max() == 0 else None


def _direction(walk: Walk, descent: Descent | None) -> FloatArray:
    """Return the direction in which a region lies, shape (d,): where f falls if it does so linearly, else its mean."""
    dim = walk.states.shape[2]
    region = Region(walk.states, walk.proposals.reshape(-1, dim), walk.f.ravel())
    if descent is not None:
        region = _with_descent(region, descent)
    axis, r2 = falling(region.u, region.f)
    if r2 > 0.5:
        return axis
    mean = walk.states[:, -3:].mean(axis=(0, 1))
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def _with_descent(region: Region, descent: Descent) -> Region:
    """Add the lower points of subset simulation where those around the region are too few for a regression."""
    if len(region.u) >= 3 * region.u.shape[1] or len(descent.f) == 0:
        return region
    low = descent.f <= np.quantile(descent.f, 0.7, method="lower")  # f may be infinite
    return Region(region.chains, np.concatenate([region.u, descent.u[low]]), np.concatenate([region.f, descent.f[low]]))
