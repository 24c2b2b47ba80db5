"""Fallback: adaptive subset simulation for failures that no proposal describes."""

import math
from dataclasses import replace

import numpy as np

from samplers.importance.draws import Draws
from samplers.mcmc.chains import RootedPoints
from samplers.method import Goal, Outcome, Steps
from samplers.methods.subset_simulation import AdaptiveSubsetSimulation
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, FallbackSettings
from samplers.problem import FloatArray, Inputs


def meets_too_few(
    draws: Draws,
    number: int,
    levels: int,
    settings: FallbackSettings = DEFAULT_SETTINGS.fallback,
    *,
    share: float = 1.0,
) -> bool:
    """Return whether the draws of a round meet so few failures that subset simulation does better with the rest.

    Args:
        draws: Of the last round.
        number: Of this round, from 1.
        levels: Levels of subset simulation in the exploration.
        settings: Failures that each draw must be worth.
        share: Of that number, which is enough.
    """
    early = settings.early_rates
    rate = early[number - 1] if number <= len(early) else settings.relative_rate / max(levels, settings.min_levels)
    return draws.ess < share * rate * draws.n


def misses_regions(draws: Draws, typical: FloatArray, settings: FallbackSettings = DEFAULT_SETTINGS.fallback) -> bool:
    """Return whether a proposal is far from most of the regions found.

    Args:
        draws: Of the last round.
        typical: Weights of typical points of the regions as draws of the proposal, shape (m,).
        settings: The limit.
    """
    return float(np.median(typical)) > settings.max_typical * draws.p


def reconcile(subset_outcome: Outcome, earlier: Outcome) -> Outcome:
    """Return the outcome of subset simulation, or the earlier one where its interval lies above it.

    Subset simulation follows f downhill; wide draws also find regions that f does not announce. The interval of the
    earlier outcome then grows to hold both.

    Args:
        subset_outcome: By subset simulation.
        earlier: From all draws of the exploration and the rounds.
    """
    if earlier.interval[0] <= subset_outcome.p:
        return subset_outcome
    interval = (
        min(earlier.interval[0], subset_outcome.interval[0]),
        max(earlier.interval[1], subset_outcome.interval[1]),
    )
    about = f"Subset simulation, which took over, missed failure regions found before; it gives {subset_outcome.p:.1e}."
    warnings = (*earlier.warnings, *subset_outcome.warnings, about)
    remarks = (*earlier.remarks, *subset_outcome.remarks)
    return replace(earlier, interval=interval, status=subset_outcome.status, warnings=warnings, remarks=remarks)


def run_subset_simulation(
    inputs: Inputs,
    goal: Goal,
    levels: int,
    budget: int,
    known: RootedPoints | None,
    rng: np.random.Generator,
    settings: FallbackSettings = DEFAULT_SETTINGS.fallback,
) -> Steps:
    """Run adaptive subset simulation with the points per level that a budget or a target c.o.v. asks for.

    Args:
        inputs: Dimension and base distribution.
        goal: Threshold, confidence and target.
        levels: Levels that subset simulation passed in the exploration.
        budget: Simulations that are never exceeded.
        known: Base draws of the exploration, from which it starts, if these have all coordinates.
        rng: Source of randomness.
        settings: How points per level follow from the budget.
    """
    levels = max(levels, settings.min_levels)
    n = int((budget + (0 if known is None else len(known.f))) / (1 + settings.level_share * (levels + 0.5)))
    if goal.target_cov is not None:
        n = min(n, math.ceil(settings.chain_points * (levels + 1) / goal.target_cov**2))
    n = max(n, settings.min_points)
    known = known and known.select(np.arange(min(n, len(known.f))))
    outcome = yield from AdaptiveSubsetSimulation(n=n).steps(inputs, replace(goal, max_sim=budget), rng, known)
    about = (
        "No proposal describes the failures: p is from adaptive subset simulation with the remaining "
        f"{budget:,} simulations; run by itself (--method adss) it uses all of them."
    )
    counted_before = 0 if known is None else len(known.f)
    return replace(outcome.remark_first(about), base_draws=outcome.base_draws - counted_before)
