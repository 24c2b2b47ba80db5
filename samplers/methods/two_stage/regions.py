"""Failure regions: chains grow inside them, and the points half way between failing points separate them.

A half way point uses f by its sign only: if it fails, the two points are of one region. Near convex regions are
separated by this in any dimension, however alike they look.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from samplers.importance import Draws, weighted_interval
from samplers.methods.base import SimulationSteps, Simulator
from samplers.methods.two_stage.edges import fit_hyperplane
from samplers.methods.two_stage.settings import REGIONS, SUBSPACE
from samplers.problem import FloatArray
from samplers.sample import PRIOR_SHARE, Interval, add_unseen, effective_sample_size, skewed_upper_end

HITS_PER_LINEAGE = 4
"""Wide failures that count as one lineage at least: draws of N(0, s^2 I) are independent, but reach some regions more
often than others."""


class Discovery(NamedTuple):
    """How thorough the search for regions was."""

    lineages: float
    """Independent lineages that reached failure."""
    ceiling: float = 1.0
    """Upper end of p by the search's own subset simulation, or by as many of its levels as there were."""

    def unseen_share(self, confidence: float) -> float:
        """Return the upper end of the share of p in regions that were not found."""
        return float(betaincinv(PRIOR_SHARE, self.lineages, 0.5 + confidence / 2))


def count_lineages(roots: int, wide_log_weights: FloatArray) -> float:
    """Return the number of independent lineages.

    `roots` distinct base draws have lines of descent, or paths of subset simulation, that came to a failure; the wide
    draws that failed have log(phi / q) (k,).
    """
    return roots + max(effective_sample_size(wide_log_weights), len(wide_log_weights) / HITS_PER_LINEAGE)


def discovery_interval(
    draws: Draws, cov: float, confidence: float, largest_weight: float, discovery: Discovery
) -> Interval:
    """Return the interval of p from weighted draws, its upper end raised by their skewness and by what is unseen."""
    low, high = weighted_interval(draws, confidence, largest_weight, cov, discovery.ceiling)
    if len(draws.f) == 0:
        return low, high
    high = max(high, skewed_upper_end(draws.p, cov, draws.skewness / draws.n**0.5, confidence))
    return low, add_unseen(draws.p, high, discovery.lineages, confidence)


Labels = NDArray[np.int64]
"""Number of the region of each point or chain, from 0, shape (n,)."""


class Region(NamedTuple):
    """One failure region."""

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

    def within(self, axes: FloatArray) -> "Region":
        """Return the region in the coordinates of orthonormal axes (d, r)."""
        return Region(self.chains @ axes, self.u @ axes, self.f)


class ChainPaths(NamedTuple):
    """States of chains and what was proposed to them."""

    states: FloatArray
    """Shape (chains, steps, d)."""
    proposals: FloatArray
    """Shape (chains, steps, d)."""
    f: FloatArray
    """Outcomes of the proposals, shape (chains, steps)."""
    sigma: FloatArray
    """Adapted pCN steps, shape (chains,)."""

    @property
    def ends(self) -> FloatArray:
        """Last states, shape (chains, d)."""
        return self.states[:, -1]

    def select(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> "ChainPaths":
        """Return some of the chains."""
        return ChainPaths(*(part[which] for part in self))

    def to_region(self) -> Region:
        """Return the region that these chains are in."""
        return Region(self.states, self.proposals.reshape(-1, self.states.shape[2]), self.f.ravel())


class SubsetPoints(NamedTuple):
    """Points of subset simulation."""

    failing: FloatArray
    """Distinct failing points of its last level, shape (k, d)."""
    u: FloatArray
    """All points simulated, shape (n, d)."""
    f: FloatArray
    """Outcomes of these, shape (n,)."""
    levels: int = 0
    """Levels passed."""
    roots: NDArray[np.int64] = np.empty(0, dtype=np.int64)
    """Base draws that the failing points descend from, shape (m,)."""
    ceiling: float = 1.0
    """Upper end of p."""


class ExplorationResult(NamedTuple):
    """Failure regions and what else the exploration found out about f."""

    regions: list[Region]
    noisy: bool
    """Whether f has noise of its own: then regions cannot be separated, and all of it is one."""
    scattered: bool = False
    """Whether the regions are no more than pieces of something like a shell."""
    levels: int = 0
    """Levels that subset simulation passed."""
    discovery: Discovery = Discovery(lineages=1.0)
    """How thorough the search was."""
    slopes: FloatArray | None = None
    """Orthonormal directions in which f changes at failing points, shape (d, r); None where they are not sought."""

    def within(self, axes: FloatArray) -> "ExplorationResult":
        """Return the same in the coordinates of orthonormal axes (d, r)."""
        return self._replace(regions=[region.within(axes) for region in self.regions], slopes=None)


def grow_regions(
    simulator: Simulator, starts: FloatArray, descent: SubsetPoints, gamma: float, limit: int, rng: np.random.Generator
) -> SimulationSteps[ExplorationResult]:
    """Run chains from failing points, twice; sort them into regions after each time.

    The first chains come from wide failures to likely ones. The second start where these ended, follow the direction
    of their region, and are more for regions that have few. Beyond `limit` simulations points are no longer compared.
    """
    dim = starts.shape[1]
    high_dim = dim > SUBSPACE.high_dim
    steps = REGIONS.steps_high_dim if high_dim else REGIONS.steps
    sigma = np.full(len(starts), REGIONS.initial_step)
    first = yield from _pcn_chains(simulator, starts, sigma, None, steps[0], gamma, rng)
    if (yield from _is_noisy(simulator, first.ends, gamma, rng)):
        last = yield from _pcn_chains(simulator, first.ends, first.sigma, None, steps[1], gamma, rng)
        region = last.to_region()._replace(chains=last.states[:, 1:])
        return ExplorationResult([region], noisy=True, levels=descent.levels)
    reserve = len(starts) * (steps[1] + 1)  # for the second chains, and one look at where they end
    labels, _ = yield from label_regions(simulator, first.ends, gamma, limit - reserve)
    room = max(limit - simulator.n_sim - reserve, 0) // (steps[1] + 1)
    few, many = REGIONS.chains_per_region
    wanted = min(max(few, math.ceil(REGIONS.points_per_dim * dim / steps[1])), many)
    chosen = _replicate_seeds(labels, wanted, min(room, REGIONS.max_replicated), rng)
    first, labels = first.select(chosen), labels[chosen]
    n = labels.max() + 1  # the points of subset simulation belong to the only region
    only = descent if n == 1 else None
    directions = np.array([_estimate_direction(first.select(labels == k), only) for k in range(n)])
    last = yield from _pcn_chains(simulator, first.ends, first.sigma, directions[labels], steps[1], gamma, rng)
    labels, scattered = yield from label_regions(simulator, last.ends, gamma, limit)
    regions = _collect_regions(first, last, labels, REGIONS.late_steps_high_dim if high_dim else REGIONS.late_steps)
    if len(regions) == 1:
        regions = [_add_subset_points(regions[0], descent)]
    return ExplorationResult(regions, noisy=False, scattered=scattered, levels=descent.levels)


def _collect_regions(first: ChainPaths, last: ChainPaths, labels: Labels, late: int) -> list[Region]:
    """Return the regions: states of the last chains but their first, proposals to them and late ones to the first.

    Late are the last `late` steps: early proposals to wide failures are far from where failures are likely.
    """
    dim = last.states.shape[2]
    proposals = np.concatenate([first.proposals[:, -late:], last.proposals], axis=1)
    f = np.concatenate([first.f[:, -late:], last.f], axis=1)
    regions = []
    for k in range(labels.max() + 1):
        own = labels == k
        regions.append(Region(last.states[own, 1:], proposals[own].reshape(-1, dim), f[own].ravel()))
    return regions


def _pcn_chains(
    simulator: Simulator,
    u: FloatArray,
    sigma: FloatArray,
    directions: FloatArray | None,
    steps: int,
    gamma: float,
    rng: np.random.Generator,
) -> SimulationSteps[ChainPaths]:
    """Move chains inside the failure region by pCN, each with its own step.

    The proposal sqrt(1 - sigma^2) u + sigma xi, xi ~ N(0, I), leaves N(0, I) invariant; it is accepted if it fails.
    With directions the step sigma is that along them, and every other direction is drawn nearly afresh: failures
    beyond a plane are standard normal there, and chains forget where they started at once.
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
            change = REGIONS.adaptation * (fails - REGIONS.chain_acceptance) / math.sqrt(step)
            sigma = np.clip(sigma * np.exp(change), REGIONS.min_step, 1.0)
        else:
            across = np.clip(across * np.where(fails, *REGIONS.across_factors), REGIONS.min_across, 1.0)
            sigma = np.clip(sigma * np.where(fails, *REGIONS.along_factors), REGIONS.min_step, 1.0)
        states.append(u)
        proposals.append(proposal)
        outcomes.append(f)
    return ChainPaths(np.stack(states, axis=1), np.stack(proposals, axis=1), np.stack(outcomes, axis=1), sigma)


def _is_noisy(simulator: Simulator, u: FloatArray, gamma: float, rng: np.random.Generator) -> SimulationSteps[bool]:
    """Return whether points right beside failing ones (n, d) do not always fail."""
    u = rng.permutation(u)[: REGIONS.probes]
    f = yield from simulator.evaluate(u + REGIONS.probe_distance * rng.standard_normal(u.shape))
    return float((f <= gamma).mean()) < REGIONS.noisy_share


def label_regions(
    simulator: Simulator, u: FloatArray, gamma: float, limit: int
) -> SimulationSteps[tuple[Labels, bool]]:
    """Sort failing points (n, d) into regions, numbered from 0: those half way to whose first point fails.

    The first point of a region is the one nearest to the origin: far ones may lie in two regions, or reach into
    another one by half. Points left over after the last region, or at the limit of simulations, go to the region with
    the nearest mean. Return also whether so many points are left over that failure is something like a shell.
    """
    labels = np.full(len(u), -1)
    scattered = False
    joined, all_compared = np.zeros((len(u), len(u)), dtype=bool), False
    for k in range(REGIONS.max_regions):
        free = np.flatnonzero(labels < 0)
        scattered = k >= REGIONS.many_regions and len(free) > REGIONS.scattered_share * len(u)
        if len(free) == 0 or scattered:
            break
        first = free[np.argmin((u[free] ** 2).sum(axis=1))]
        labels[first] = k
        others = free[free != first]
        if not all_compared:
            all_compared = len(free) <= REGIONS.few_points
            left, right = np.full_like(others, first), others
            if all_compared:
                left, right = free[np.stack(np.triu_indices(len(free), 1))]
            if simulator.n_sim + len(left) > limit:
                break
            joined[left, right] = (yield from simulator.evaluate(0.5 * (u[left] + u[right]))) <= gamma
            joined |= joined.T
        labels[others[joined[first, others]]] = k
    free = np.flatnonzero(labels < 0)
    if len(free):
        means = np.array([u[labels == k].mean(axis=0) for k in range(labels.max() + 1)])
        # |u - m|^2 is least where u . m - |m|^2 / 2 is largest.
        labels[free] = np.argmax(u[free] @ means.T - 0.5 * (means**2).sum(axis=1), axis=1)
    return labels, scattered


def _replicate_seeds(labels: Labels, wanted: int, room: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the indices of all chains, those of small regions repeated until each has `wanted`, or `room` is used."""
    more = []
    for k in range(labels.max() + 1):
        own = np.flatnonzero(labels == k)
        more.append(rng.choice(own, max(wanted - len(own), 0)))
    return np.concatenate([np.arange(len(labels)), np.concatenate(more)[:room]])


def _estimate_direction(paths: ChainPaths, descent: SubsetPoints | None) -> FloatArray:
    """Return the direction in which a region lies, shape (d,): where f falls if it does so linearly, else its mean."""
    region = paths.to_region()
    if descent is not None:
        region = _add_subset_points(region, descent)
    plane = fit_hyperplane(region.u, region.f)
    if plane.explained > REGIONS.direction_r2:
        return plane.axis
    mean = paths.states[:, -REGIONS.mean_steps :].mean(axis=(0, 1))
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def _add_subset_points(region: Region, descent: SubsetPoints) -> Region:
    """Return a region with the lower points of subset simulation, if its own are too few for a regression."""
    if len(region.u) >= REGIONS.min_points_per_dim * region.u.shape[1] or len(descent.f) == 0:
        return region
    low = descent.f <= np.quantile(descent.f, REGIONS.lower_share, method="lower")  # f may be infinite
    return Region(region.chains, np.concatenate([region.u, descent.u[low]]), np.concatenate([region.f, descent.f[low]]))
