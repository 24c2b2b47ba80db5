"""Exploration: the search for every region of failure, the first stage of `TwoStage`.

Four sources. Only subset simulation follows f downhill; the others use no more than whether a point fails, so that
plateaus, ties, jumps and misleading level sets do not matter to them:

1. Draws from the base distribution, and wide ones from N(0, s^2 I): a half-space at distance beta fails with
   probability Phi(-beta / s), whatever the dimension.
2. Subset simulation from the base draws, for regions too small to be hit by wide draws.
3. Chains inside the region of failure (pCN), started from both, so that wide failures become likely ones
   (`regions.py`).
4. The points half way between two failing points: if one fails, the two belong to one region (`regions.py`).
"""

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc.chains import Chains, Growth, independent_chains
from samplers.mcmc.descent import NextLevel, descend
from samplers.mcmc.kernels import ScaledKernel
from samplers.method import Interrupted
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, MixtureSettings
from samplers.methods.two_stage.regions import ExplorationResult, SubsetPoints, grow_regions
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, ExplorationSettings, RegionSettings
from samplers.methods.two_stage.simulator import ComponentDraws, Simulator
from samplers.problem import FloatArray
from samplers.proposals.components import IsotropicNormal, MixtureComponent, draw_components
from samplers.statistics.thresholds import next_level
from samplers.trace import Status


@dataclass(frozen=True)
class Sizes:
    """Simulations for each part of the exploration."""

    base: int
    """Base draws."""
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
    def within(cls, budget: int, settings: ExplorationSettings = DEFAULT_SETTINGS.exploration) -> "Sizes":
        """Return the sizes for a budget."""
        usual = settings.usual_budget
        scale = budget / usual if budget < usual else math.sqrt(budget / usual)
        return cls(
            base=round(settings.base * scale),
            wide=tuple((width, round(n * scale)) for width, n in settings.wide),
            level=max(settings.least_level, round(settings.level * scale)),
            starts=max(settings.least_starts, round(settings.starts * scale)),
            level_starts=max(settings.least_level_starts, round(settings.level_starts * scale)),
            most=int(settings.descent_share * budget),
            limit=int(settings.share * budget),
        )


@dataclass(frozen=True)
class ExplorationPlanner:
    """Levels whose seeds are a random part of the points below the threshold, in chains of equal length."""

    gamma: float
    """Threshold of failure."""
    n: int
    """Points per level, a few more where the chains do not divide them."""
    budget: int
    """Simulations for all levels."""
    settings: ExplorationSettings

    def plan_next(self, chains: Chains, depth: int, n_sim: int, rng: np.random.Generator) -> NextLevel | Status:
        """Return the next level, or how the descent ends: converged once `level_fraction` of the points fail."""
        points = chains.by_step()
        threshold = next_level(points.f, self.settings.level_fraction, self.gamma)
        if threshold == self.gamma:
            return Status.CONVERGED
        if threshold is None or depth >= self.settings.max_levels:
            return Status.STALLED
        seeds = rng.permutation(np.flatnonzero(points.f <= threshold))[: self.n // self.settings.points_per_seed]
        steps = max(1, math.ceil(self.n / len(seeds)) - 1)
        if n_sim + steps * len(seeds) > self.budget:
            return Status.BUDGET
        return NextLevel(threshold, points.select(seeds), np.full(len(seeds), steps + 1))


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
    explore: ExplorationSettings = DEFAULT_SETTINGS.exploration,
    mixture: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
) -> Generator[FloatArray, FloatArray, ExplorationResult]:
    """Find the regions of failure, starting from the first draws; none if nothing fails."""
    n_base = int(first.counts[0])
    descent = yield from _descend(simulator, first.u[:n_base], first.f[:n_base], gamma, sizes, rng, explore)
    wide = np.flatnonzero(first.f[n_base:] <= gamma) + n_base
    scale = np.repeat(np.arange(len(first.counts)), first.counts)
    most = max(2, (sizes.limit - simulator.n_sim) // explore.chain_cost)
    chosen = wide[_subsample(scale[wide], min(sizes.starts, most), rng)]
    far = yield from _bisect_towards_origin(simulator, first.u[chosen], gamma, explore.bisections)
    others = max(sizes.level_starts, sizes.starts + sizes.level_starts - len(far))
    starts = np.concatenate([far, rng.permutation(descent.failing)[: min(others, most - len(far))]])
    if len(starts) == 0:
        return ExplorationResult([], noisy=False)
    return (yield from grow_regions(simulator, starts, descent, gamma, sizes.limit, rng, settings, mixture))


def _descend(
    simulator: Simulator,
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    sizes: Sizes,
    rng: np.random.Generator,
    explore: ExplorationSettings,
) -> Generator[FloatArray, FloatArray, SubsetPoints]:
    """Run subset simulation from base draws u (n, d), f (n,), until a tenth of a level fails or the budget is used.

    All candidates are kept, for the regressions around the regions; there is no estimate, so no level is recorded.
    """
    kernel = ScaledKernel(
        "conditional", "unit", explore.initial_scale, explore.level_acceptance, deviations=np.ones(u.shape[1])
    )
    planner = ExplorationPlanner(gamma, sizes.level, sizes.most - simulator.n_sim, explore)
    levels = list[Growth]()
    start = Growth.start(independent_chains(u, f), kernel)
    status = yield from descend(simulator.inputs, start, planner, lambda growth, _: levels.append(growth), rng)
    outcomes = np.concatenate([level.f_candidates for level in levels])
    simulator.n_sim += len(outcomes)
    if status is Status.STOPPED:
        raise Interrupted
    last = levels[-1].chains
    failing = np.unique(last.where(last.f <= gamma).u, axis=0)
    return SubsetPoints(failing, np.concatenate([level.candidates for level in levels]), outcomes, len(levels) - 1)


def _subsample(scale: NDArray[np.int64], n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose n of the wide failures: half of them the least wide ones, the rest at random."""
    order = np.lexsort((rng.random(len(scale)), scale))
    return np.concatenate([order[: n // 2], rng.permutation(order[n // 2 :])[: n - n // 2]])


def _bisect_towards_origin(
    simulator: Simulator, u: FloatArray, gamma: float, steps: int
) -> Generator[FloatArray, FloatArray, FloatArray]:
    """Move failing points (n, d) towards the origin along their rays, by bisection; they still fail."""
    safe, failing = np.zeros(len(u)), np.ones(len(u))
    for _ in range(steps):
        middle = 0.5 * (safe + failing)
        fails = (yield from simulator.evaluate(u * middle[:, None])) <= gamma
        failing, safe = np.where(fails, middle, failing), np.where(fails, safe, middle)
    return u * failing[:, None]
