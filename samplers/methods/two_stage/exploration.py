"""Finding every region of failure: the first stage of `TwoStage`.

Four sources, of which only subset simulation follows f downhill; the others ask no more than whether a point fails,
so that plateaus, ties, jumps and level sets that lead astray do not matter to them:

1. Draws from the base law, and wide ones from N(0, s^2 I): a half-space at distance beta fails with probability
   Phi(-beta / s), whatever the dimension.
2. Subset simulation from the base draws, for regions too small to be hit by wide draws.
3. Chains inside the region of failure (pCN), started from both, so that wide failures become likely ones
   (`regions.py`).
4. Whether the point half way between two failing points fails as well: then they belong to one region (`regions.py`).
"""

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc.kernels import conditional_proposal
from samplers.methods.two_stage.regions import ExplorationResult, SubsetPoints, grow_regions
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, RegionSettings
from samplers.methods.two_stage.simulator import ComponentDraws, Simulator
from samplers.problem import FloatArray
from samplers.proposals.components import IsotropicNormal, MixtureComponent, draw_components
from samplers.statistics.thresholds import next_level

LEVEL_FRACTION = 0.1
LEVEL_ACCEPTANCE = 0.35
MOST_LEVELS = 30
BISECTIONS = 3
COST_OF_CHAIN = 25
"""Simulations that a chain needs at most before it is sorted: bisection, two walks, looks at its region."""


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
            starts=max(10, round(60 * scale)),
            level_starts=max(6, round(16 * scale)),
            most=int(0.45 * budget),
            limit=int(0.65 * budget),
        )


def first_draws(
    simulator: Simulator, sizes: Sizes, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, ComponentDraws]:
    """Simulate the base and the wide draws."""
    dim = simulator.inputs.dim
    components: list[MixtureComponent] = [
        IsotropicNormal(dim),
        *(IsotropicNormal(dim, scale) for scale, _ in sizes.wide),
    ]
    counts = np.array([sizes.base, *(n for _, n in sizes.wide)])
    u = draw_components(components, counts, rng)
    f = yield from simulator.evaluate(u)
    return ComponentDraws(components, counts, u, f)


def find_regions(
    simulator: Simulator,
    first: ComponentDraws,
    gamma: float,
    sizes: Sizes,
    rng: np.random.Generator,
    settings: RegionSettings = DEFAULT_SETTINGS.regions,
) -> Generator[FloatArray, FloatArray, ExplorationResult]:
    """Find the regions of failure, starting from the first draws; none if nothing fails."""
    n_base = int(first.counts[0])
    descent = yield from _descend(simulator, first.u[:n_base], first.f[:n_base], gamma, sizes, rng)
    wide = np.flatnonzero(first.f[n_base:] <= gamma) + n_base
    scale = np.repeat(np.arange(len(first.counts)), first.counts)
    most = max(2, (sizes.limit - simulator.n_sim) // COST_OF_CHAIN)
    chosen = wide[_subsample(scale[wide], min(sizes.starts, most), rng)]
    far = yield from _bisect_towards_origin(simulator, first.u[chosen], gamma)
    others = max(sizes.level_starts, sizes.starts + sizes.level_starts - len(far))
    starts = np.concatenate([far, rng.permutation(descent.failing)[: min(others, most - len(far))]])
    if len(starts) == 0:
        return ExplorationResult([], noisy=False)
    return (yield from grow_regions(simulator, starts, descent, gamma, sizes.limit, rng, settings))


def _descend(
    simulator: Simulator, u: FloatArray, f: FloatArray, gamma: float, sizes: Sizes, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, SubsetPoints]:
    """Run subset simulation from base draws u (n, d), f (n,), until a tenth of a level fails or the budget is used."""
    points, outcomes = [u[:0]], [f[:0]]
    sigma, levels = 0.6, 0
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
            f_new = yield from simulator.evaluate(proposal)
            points.append(proposal)
            outcomes.append(f_new)
            accepted = f_new <= level
            u_chain, f_chain = np.where(accepted[:, None], proposal, u_chain), np.where(accepted, f_new, f_chain)
            states.append(u_chain)
            at.append(f_chain)
            sigma = min(sigma * math.exp((accepted.mean() - LEVEL_ACCEPTANCE) / math.sqrt(step)), 1.0)
        u, f = np.concatenate(states), np.concatenate(at)
        levels += 1
    return SubsetPoints(np.unique(u[f <= gamma], axis=0), np.concatenate(points), np.concatenate(outcomes), levels)


def _subsample(scale: NDArray[np.int64], n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose n of the wide failures: half of them the least wide ones, the rest at random."""
    order = np.lexsort((rng.random(len(scale)), scale))
    return np.concatenate([order[: n // 2], rng.permutation(order[n // 2 :])[: n - n // 2]])


def _bisect_towards_origin(
    simulator: Simulator, u: FloatArray, gamma: float
) -> Generator[FloatArray, FloatArray, FloatArray]:
    """Draw failing points (n, d) towards the origin along their rays, by bisection; they still fail."""
    safe, failing = np.zeros(len(u)), np.ones(len(u))
    for _ in range(BISECTIONS):
        middle = 0.5 * (safe + failing)
        fails = (yield from simulator.evaluate(u * middle[:, None])) <= gamma
        failing, safe = np.where(fails, middle, failing), np.where(fails, safe, middle)
    return u * failing[:, None]
