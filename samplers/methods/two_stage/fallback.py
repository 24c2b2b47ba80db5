"""Fallback: adaptive subset simulation for failures that no proposal describes."""

import math
from dataclasses import replace

import numpy as np

from samplers.importance.draws import Draws
from samplers.method import Goal, Outcome, Steps
from samplers.methods.subset_simulation import AdaptiveSubsetSimulation
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, FallbackSettings
from samplers.problem import FloatArray, Inputs


def describes_failures(
    last: Draws, expected: FloatArray, settings: FallbackSettings = DEFAULT_SETTINGS.fallback
) -> bool:
    """Return whether a proposal describes the failures so well that the weights of its draws are reliable.

    Args:
        last: The draws of the last round.
        expected: Mean weights of the exploration's points as draws of the proposal, by region, shape (m,).
        settings: Limits of the rate and of these weights.
    """
    if not meets_failures(last, settings):
        return False
    good = last.ess >= settings.good_rate * last.n
    limit = settings.max_weight if good else settings.max_region_weight
    return bool(np.median(expected) <= limit * last.p)


def meets_failures(last: Draws, settings: FallbackSettings = DEFAULT_SETTINGS.fallback) -> bool:
    """Return whether the draws of the last round meet failures often enough."""
    return len(last.f) > 0 and last.ess >= settings.min_round_rate * last.n


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
    about = f"Subset simulation, with the rest, missed regions that were found before: its p is {subset_outcome.p:.1e}."
    warnings = (*earlier.warnings, *subset_outcome.warnings, about)
    return replace(earlier, interval=interval, status=subset_outcome.status, warnings=warnings)


def run_subset_simulation(
    inputs: Inputs,
    goal: Goal,
    levels: int,
    budget: int,
    rng: np.random.Generator,
    settings: FallbackSettings = DEFAULT_SETTINGS.fallback,
) -> Steps:
    """Run adaptive subset simulation with the points per level that a budget or a target c.o.v. asks for.

    Args:
        inputs: Dimension and base distribution.
        goal: Threshold, confidence and target.
        levels: Levels that subset simulation passed in the exploration.
        budget: Simulations that are never exceeded.
        rng: Source of randomness.
        settings: How points per level follow from the budget.
    """
    levels = max(levels, settings.min_levels)
    n = int(budget / (1 + settings.level_share * levels))
    if goal.target_cov is not None:
        n = min(n, math.ceil(settings.chain_points * (levels + 1) / goal.target_cov**2))
    method = AdaptiveSubsetSimulation(n=max(n, settings.min_points))
    outcome = yield from method.steps(inputs, replace(goal, max_sim=budget), rng)
    about = (
        "No proposal describes the failures: p is from adaptive subset simulation with what was left, "
        f"{budget:,} simulations; by itself (adss) it would have had all of them."
    )
    return replace(outcome, warnings=(about, *outcome.warnings))
