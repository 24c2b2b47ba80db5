"""Regions of failure: chains grow inside them and are told apart by the points half way between them.

The half way points ask no more of f than whether it fails: if the one between two failing points does, the two belong
to one region. Near convex regions are kept apart by this in any dimension, however alike they look.
"""

import math
from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.linear_model import descent_direction
from samplers.methods.two_stage.mixture.subspace_em import HIGH_DIM
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FloatArray

CHAIN_ACCEPTANCE = 0.35
MANY_REGIONS = 8
MOST_REGIONS = 16
SCATTERED = 0.25
"""Where this share of the points is in none of MANY_REGIONS regions, failure is something like a shell."""
MAX_REPLICATED_CHAINS = 60
PROBES = 30
NUDGE = 1e-6
NOISY = 0.9
"""Where less than this share of the points right beside failing ones fail, f is noisy."""


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


class ChainPaths(NamedTuple):
    """Where chains went."""

    states: FloatArray
    """Shape (chains, steps, d)."""
    proposals: FloatArray
    """Shape (chains, steps, d)."""
    f: FloatArray
    """Outcomes of the proposals, shape (chains, steps)."""
    sigma: FloatArray
    """Adapted steps, shape (chains,)."""

    def of(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> "ChainPaths":
        """Return some of the chains."""
        return ChainPaths(*(part[which] for part in self))


class SubsetPoints(NamedTuple):
    """What subset simulation saw."""

    failing: FloatArray
    """Distinct failing points of its last level, shape (k, d)."""
    u: FloatArray
    """All points simulated, shape (n, d)."""
    f: FloatArray
    levels: int = 0
    """Levels passed."""


class ExplorationResult(NamedTuple):
    """What the exploration found."""

    regions: list[Region]
    noisy: bool
    """Whether f has noise of its own: then regions cannot be told apart, and all of it is one."""
    scattered: bool = False
    """Whether they are no more than pieces of something like a shell."""
    levels: int = 0
    """Levels that subset simulation passed."""


def grow_regions(
    simulator: Simulator, starts: FloatArray, descent: SubsetPoints, gamma: float, limit: int, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, ExplorationResult]:
    """Run chains from failing points, twice; sort them into regions after each time."""
    dim = starts.shape[1]
    steps = (5, 6) if dim <= HIGH_DIM else (8, 8)
    walk = yield from _pcn_chains(simulator, starts, np.full(len(starts), 0.5), None, steps[0], gamma, rng)
    if (yield from _is_noisy(simulator, walk.states[:, -1], gamma, rng)):
        last = yield from _pcn_chains(simulator, walk.states[:, -1], walk.sigma, None, steps[1], gamma, rng)
        region = Region(last.states[:, 1:], last.proposals.reshape(-1, dim), last.f.ravel())
        return ExplorationResult([region], noisy=True, levels=descent.levels)
    after = len(starts) * (steps[1] + 1)  # the second walk, and one look at where it ended
    labels, _ = yield from _label_regions(simulator, walk.states[:, -1], gamma, limit - after)
    room = max(limit - simulator.n_sim - after, 0) // (steps[1] + 1)
    more = _replicate_seeds(labels, min(max(8, math.ceil(2.5 * dim / steps[1])), 24), room, rng)
    walk, labels = walk.of(more), labels[more]
    alone = descent if labels.max() == 0 else None  # the points on the way down belong to the one region, then
    directions = np.array([_estimate_direction(walk.of(labels == k), alone) for k in range(labels.max() + 1)])
    start, sigma = walk.states[:, -1], walk.sigma
    last = yield from _pcn_chains(simulator, start, sigma, directions[labels], steps[1], gamma, rng)
    labels, scattered = yield from _label_regions(simulator, last.states[:, -1], gamma, limit)
    late = 2 if dim <= HIGH_DIM else 4  # early proposals to wide failures are far from where failures are likely
    proposals = np.concatenate([walk.proposals[:, -late:], last.proposals], axis=1)
    f = np.concatenate([walk.f[:, -late:], last.f], axis=1)
    regions = []
    for k in range(labels.max() + 1):
        own = labels == k
        regions.append(Region(last.states[own, 1:], proposals[own].reshape(-1, dim), f[own].ravel()))
    regions = [_add_subset_points(regions[0], descent)] if len(regions) == 1 else regions
    return ExplorationResult(regions, noisy=False, scattered=scattered, levels=descent.levels)


def _pcn_chains(
    simulator: Simulator,
    u: FloatArray,
    sigma: FloatArray,
    directions: FloatArray | None,
    steps: int,
    gamma: float,
    rng: np.random.Generator,
) -> Generator[FloatArray, FloatArray, ChainPaths]:
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
        f = yield from simulator.evaluate(proposal)
        fails = f <= gamma
        u = np.where(fails[:, None], proposal, u)
        if directions is None:
            sigma = np.clip(sigma * np.exp(0.7 * (fails - CHAIN_ACCEPTANCE) / math.sqrt(step)), 0.02, 1.0)
        else:
            across = np.clip(across * np.where(fails, 1.1, 0.75), 0.05, 1.0)
            sigma = np.clip(sigma * np.where(fails, 1.05, 0.9), 0.02, 1.0)
        states.append(u)
        proposals.append(proposal)
        outcomes.append(f)
    return ChainPaths(np.stack(states, axis=1), np.stack(proposals, axis=1), np.stack(outcomes, axis=1), sigma)


def _is_noisy(
    simulator: Simulator, u: FloatArray, gamma: float, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, bool]:
    """Return whether points right beside failing ones (n, d) do not always fail."""
    u = rng.permutation(u)[:PROBES]
    f = yield from simulator.evaluate(u + NUDGE * rng.standard_normal(u.shape))
    return float((f <= gamma).mean()) < NOISY


def _label_regions(
    simulator: Simulator, u: FloatArray, gamma: float, limit: int
) -> Generator[FloatArray, FloatArray, tuple[NDArray[np.int64], bool]]:
    """Sort failing points (n, d) into regions, numbered from 0: those half way to whose first point fails.

    The first point of a region is the one nearest to the origin: far ones may lie in two regions, or reach into
    another one by half. Points left over after the last region, or at the limit of simulations, go to the region with
    the nearest mean.

    Returns:
        The regions' numbers (n,), and whether so many points are left over that failure is something like a shell.
    """
    labels = np.full(len(u), -1)
    scattered = False
    for k in range(MOST_REGIONS):
        free = np.flatnonzero(labels < 0)
        scattered = k >= MANY_REGIONS and len(free) > SCATTERED * len(u)
        if len(free) == 0 or scattered:
            break
        first = free[np.argmin((u[free] ** 2).sum(axis=1))]
        labels[first] = k
        others = free[free != first]
        if simulator.n_sim + len(others) > limit:
            break
        fails = (yield from simulator.evaluate(0.5 * (u[others] + u[first]))) <= gamma
        labels[others[fails]] = k
    free = np.flatnonzero(labels < 0)
    if len(free):
        means = np.array([u[labels == k].mean(axis=0) for k in range(labels.max() + 1)])
        labels[free] = np.argmax(u[free] @ means.T - 0.5 * (means**2).sum(axis=1), axis=1)
    return labels, scattered


def _replicate_seeds(labels: NDArray[np.int64], least: int, room: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the numbers of all chains, those of regions with few repeated until there are `least` or no room is."""
    more = []
    for k in range(labels.max() + 1):
        own = np.flatnonzero(labels == k)
        more.append(rng.choice(own, max(least - len(own), 0)))
    return np.concatenate([np.arange(len(labels)), np.concatenate(more)[: min(room, MAX_REPLICATED_CHAINS)]])


def _estimate_direction(walk: ChainPaths, descent: SubsetPoints | None) -> FloatArray:
    """Return the direction in which a region lies, shape (d,): where f falls if it does so linearly, else its mean."""
    dim = walk.states.shape[2]
    region = Region(walk.states, walk.proposals.reshape(-1, dim), walk.f.ravel())
    if descent is not None:
        region = _add_subset_points(region, descent)
    axis, r2 = descent_direction(region.u, region.f)
    if r2 > 0.5:
        return axis
    mean = walk.states[:, -3:].mean(axis=(0, 1))
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def _add_subset_points(region: Region, descent: SubsetPoints) -> Region:
    """Add the lower points of subset simulation where those around the region are too few for a regression."""
    if len(region.u) >= 3 * region.u.shape[1] or len(descent.f) == 0:
        return region
    low = descent.f <= np.quantile(descent.f, 0.7, method="lower")  # f may be infinite
    return Region(region.chains, np.concatenate([region.u, descent.u[low]]), np.concatenate([region.f, descent.f[low]]))
