"""Exploration: the search for every region of failure, the first stage of `TwoStage`.

Five sources. Subset simulation and lines of descent follow f downhill; the others use no more than whether a point
fails, so that plateaus, ties, jumps and misleading level sets do not matter to them:

1. Draws from the base distribution, and wide ones from N(0, s^2 I): a half-space at distance beta fails with
   probability Phi(-beta / s), whatever the dimension (`discovery/wide.py`).
2. Subset simulation from the base draws, for regions too small to be hit by wide draws (`discovery/levels.py`).
3. Lines of descent from low base draws, each a trial of its own of which region is found (`discovery/lines.py`). They
   use nothing of the subset simulation, and are walked in the same batches (`discovery/joint_batches.py`).
4. Chains inside the region of failure (pCN), started from all of these, so that wide failures become likely ones
   (`regions.py`).
5. The points half way between two failing points: if one fails, the two belong to one region (`regions.py`).
"""

import math
from dataclasses import dataclass

import numpy as np

from samplers.method import Goal
from samplers.methods.two_stage.discovery.joint_batches import join_batches
from samplers.methods.two_stage.discovery.levels import descend_levels
from samplers.methods.two_stage.discovery.lines import LineEnds, choose_roots, walk_lines
from samplers.methods.two_stage.discovery.unseen import Discovery, count_lineages
from samplers.methods.two_stage.discovery.wide import WideFailures, bisect_towards_origin, find_wide_failures
from samplers.methods.two_stage.regions import (
    ExplorationResult,
    Labels,
    Region,
    SubsetPoints,
    grow_regions,
    label_regions,
)
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, ExplorationSettings, LineSettings, TwoStageSettings
from samplers.methods.two_stage.simulator import ComponentDraws, SimulationSteps, Simulator
from samplers.problem import FloatArray
from samplers.proposals.components import IsotropicNormal, MixtureComponent, draw_components


@dataclass(frozen=True)
class Sizes:
    """Simulations for each part of the exploration."""

    scale: float
    """By what the numbers of the settings are multiplied."""
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
            scale=scale,
            base=round(settings.base * scale),
            wide=tuple((width, round(n * scale)) for width, n in settings.wide),
            level=max(settings.least_level, round(settings.level * scale)),
            starts=max(settings.least_starts, round(settings.starts * scale)),
            level_starts=max(settings.least_level_starts, round(settings.level_starts * scale)),
            most=int(settings.descent_share * budget),
            limit=int(settings.share * budget),
        )


def first_draws(simulator: Simulator, sizes: Sizes, rng: np.random.Generator) -> SimulationSteps[ComponentDraws]:
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
    goal: Goal,
    sizes: Sizes,
    rng: np.random.Generator,
    settings: TwoStageSettings = DEFAULT_SETTINGS,
) -> SimulationSteps[ExplorationResult]:
    """Find the regions of failure, starting from the first draws; none if nothing fails."""
    n_base, gamma, explore = int(first.counts[0]), goal.gamma, settings.exploration
    base_u, base_f = first.u[:n_base], first.f[:n_base]
    drawn = ComponentDraws(first.components[1:], first.counts[1:], first.u[n_base:], first.f[n_base:])
    for_levels, for_lines = rng.spawn(2)
    (descent, wide), lines = yield from join_batches(
        _pass_levels(simulator, base_u, base_f, drawn, goal, sizes, for_levels, explore),
        _find_lines(simulator, base_u, base_f, gamma, sizes.scale, for_lines, settings),
    )
    roots = len(np.union1d(descent.roots, lines.roots))
    discovery = Discovery(count_lineages(roots, wide.log_weights), descent.ceiling)
    most = max(2, (sizes.limit - simulator.n_sim) // explore.chain_cost)
    far, (labels, _) = yield from join_batches(
        bisect_towards_origin(simulator, wide.choose(min(sizes.starts, most), rng), gamma, explore.bisections),
        label_regions(simulator, lines.u, gamma, sizes.limit, settings.regions),
    )
    if _is_scattered(labels, simulator.inputs.dim, settings):
        region = Region(lines.u[:, None], descent.u, descent.f)
        return ExplorationResult([region], noisy=False, scattered=True, levels=descent.levels, discovery=discovery)
    near = _choose_lines(lines.u, labels, rng, settings.lines)
    others = min(max(sizes.level_starts, sizes.starts + sizes.level_starts - len(far)), most - len(far))
    starts = np.concatenate([far, near, rng.permutation(descent.failing)[: max(others - len(near), 0)]])
    if len(starts) == 0:
        return ExplorationResult([], noisy=False, discovery=discovery)
    result = yield from grow_regions(
        simulator, starts, descent, gamma, sizes.limit, rng, settings.regions, settings.mixture
    )
    return result._replace(discovery=discovery)


def _pass_levels(
    simulator: Simulator,
    u: FloatArray,
    f: FloatArray,
    drawn: ComponentDraws,
    goal: Goal,
    sizes: Sizes,
    rng: np.random.Generator,
    explore: ExplorationSettings,
) -> SimulationSteps[tuple[SubsetPoints, WideFailures]]:
    """Run subset simulation from base draws u (n, d), f (n,), and make the wide draws as wide as it went deep."""
    descent = yield from descend_levels(simulator, u, f, goal, sizes.level, sizes.most, rng, explore)
    more = round(explore.deep_draws * sizes.scale)
    wide = yield from find_wide_failures(simulator, drawn, goal.gamma, descent.levels, more, rng, explore)
    return descent, wide


def _find_lines(
    simulator: Simulator,
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    scale: float,
    rng: np.random.Generator,
    settings: TwoStageSettings,
) -> SimulationSteps[LineEnds]:
    """Walk lines of descent from base draws u (n, d) with outcomes f (n,), and their ends towards the origin."""
    roots = choose_roots(f, max(1, round(scale * settings.lines.n)), rng, settings.lines)
    ends, failing = yield from walk_lines(simulator, u[roots], f[roots], gamma, scale, rng, settings.lines)
    near = yield from bisect_towards_origin(simulator, ends[failing], gamma, settings.exploration.bisections)
    return LineEnds(near, roots[failing])


def _is_scattered(labels: Labels, dim: int, settings: TwoStageSettings) -> bool:
    """Return whether lines of descent lie in so many regions, in many dimensions, that chains would not relax there."""
    regions = int(labels.max(initial=-1)) + 1
    return dim > settings.mixture.subspace.high_dim and regions >= settings.lines.many_regions


def _choose_lines(u: FloatArray, labels: Labels, rng: np.random.Generator, settings: LineSettings) -> FloatArray:
    """Return ends of lines (n, d) for chains to start from: a few of each region."""
    order = rng.permutation(len(u))
    chosen = [order[labels[order] == k][: settings.starts] for k in range(int(labels.max(initial=-1)) + 1)]
    return np.take(u, np.concatenate([np.empty(0, dtype=np.int64), *chosen]), axis=0)
