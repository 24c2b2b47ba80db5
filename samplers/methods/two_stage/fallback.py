"""Where no proposal describes the failures: subset simulation, which needs none."""

import math
from dataclasses import replace

import numpy as np

from samplers.importance.draws import Draws
from samplers.method import Goal, Outcome, Steps
from samplers.methods.subset_simulation import AdaptiveSubsetSimulation
from samplers.problem import FloatArray, Inputs

HOPELESS_RATE = 0.005
"""What the last round of draws must be worth, in independent failures for each draw. Proposals that come to something
reach 0.01 to 0.9; with less, the spread of the weights is that of the failures met, not of those that there are."""
LEAST_RATE = 0.1
LARGEST_TYPICAL = 30.0
"""How many times p a point that the exploration found may weigh as a draw, where the rate is under LEAST_RATE: 1 to 3
is usual, 17 was seen to do."""
ABSURD = 1e4
"""How many times p, whatever the rate: the draws all come from a place where hardly any failure is."""
MIN_FALLBACK_BUDGET = 300
"""Subset simulation is not worth its draws with less."""
WORTH = 30.0
"""Points of a level at p0 = 0.1 for one that is independent: (1 - p0) / p0, and correlation along the chains."""


def describes_failures(last: Draws, typical: FloatArray) -> bool:
    """Return whether a proposal describes the failures so well that the weights of its draws can be believed.

    Args:
        last: The draws of the last round.
        typical: Weights of the exploration's points as draws of the proposal, one for each region, shape (m,).
    """
    if not meets_failures(last):
        return False
    return bool(np.median(typical) <= (ABSURD if last.ess >= LEAST_RATE * last.n else LARGEST_TYPICAL) * last.p)


def meets_failures(last: Draws) -> bool:
    """Return whether the draws of the last round meet failures often enough."""
    return len(last.f) > 0 and last.ess >= HOPELESS_RATE * last.n


def reconcile(found: Outcome, before: Outcome) -> Outcome:
    """Return what subset simulation found, or what was known before it, if that is more than it can be reconciled with.

    Subset simulation follows f downhill; wide draws find regions that f does not announce as well.
    """
    if before.interval[0] <= found.p:
        return found
    interval = min(before.interval[0], found.interval[0]), max(before.interval[1], found.interval[1])
    about = f"Subset simulation, with the rest, missed regions that were found before: p was {found.p:.1e} there."
    warnings = (*before.warnings, *found.warnings, about)
    return replace(before, interval=interval, status=found.status, warnings=warnings)


def run_subset_simulation(inputs: Inputs, goal: Goal, levels: int, budget: int, rng: np.random.Generator) -> Steps:
    """Run adaptive subset simulation with the points per level that a budget or a target c.o.v. asks for.

    Args:
        inputs: Dimension and base law.
        goal: What the method was asked for.
        levels: Levels that the exploration passed on its way down.
        budget: Simulations that are never exceeded.
        rng: Source of randomness.
    """
    levels = max(levels, 2)
    n = int(budget / (1 + 0.9 * levels))  # seeds are not simulated again
    if goal.target_cov is not None:
        n = min(n, math.ceil(WORTH * (levels + 1) / goal.target_cov**2))
    method = AdaptiveSubsetSimulation(n=max(n, 10))
    outcome = yield from method.steps(inputs, replace(goal, max_sim=budget), rng)
    about = (
        "No proposal describes the failures: p is from adaptive subset simulation with what was left, "
        f"{budget:,} simulations; by itself (adss) it would have had all of them."
    )
    return replace(outcome, warnings=(about, *outcome.warnings))
