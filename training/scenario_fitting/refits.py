"""Refits of a base distribution: the whole fit again, to events drawn anew from the recorded ones.

Whole clusters are drawn with replacement (the bootstrap of Efron and Tibshirani, "An Introduction to the Bootstrap",
1993, chapter 8): events of one scene depend on each other, and resampling them one by one gives intervals that are too
narrow. Coordinates and number of components are selected anew in each refit (Breiman, "Bagging predictors", 1996;
Efron, "Estimation and accuracy after model selection", 2014): keeping them gives intervals that are too narrow too.
40 events do not settle the coordinates. In two worlds of car-following refits in the coordinates of the fit gave
intervals that held p in 81 and 74 % of 32 and 31 draws of events, refits that choose 96 and 98 % of 135 and 134
(`benchmarks/uncertainty/recipe_coverage.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.space import Parameter
from training.scenario_fitting.coordinate_systems import FOLD_STARTS, CoordinateSystem, SystemFit, fit_system
from training.scenario_fitting.event_filters import EventSet
from training.scenario_fitting.fit_progress import ignore_progress

N_REFITS = 30
"""Refits where all are of the same family: the noise of log-spread is then .13."""
MIN_CLUSTERS = 5
"""Clusters below which there is nothing to draw anew: refits to so few would all be alike."""
MORE_REFITS = 100
"""Refits where coordinates or number of components differ: one refit alone may then carry the spread."""


def draw_events(events: EventSet, rng: np.random.Generator) -> EventSet:
    """Return as many clusters as there are, drawn with replacement, and columns apart drawn by themselves.

    Example:
        >>> events = EventSet(np.arange(6.0).reshape(3, 2), np.array([0, 0, 1]))
        >>> draw_events(events, np.random.default_rng(1)).joint[:, 0].tolist()  # each cluster once, this time
        [0.0, 2.0, 4.0]
    """
    names = np.unique(events.clusters)
    rows: list[NDArray[np.int64]] = []
    labels: list[NDArray[np.int64]] = []
    for number, name in enumerate(rng.choice(names, len(names))):
        rows.append(np.flatnonzero(events.clusters == name))
        labels.append(np.full(len(rows[-1]), number))
    apart = events.apart
    if len(apart):
        apart = apart[rng.integers(len(apart), size=len(apart))]
    return EventSet(events.joint[np.concatenate(rows)], np.concatenate(labels), apart, events.cluster)


def refit(
    events: EventSet,
    systems: Sequence[CoordinateSystem],
    parameters: Sequence[Parameter],
    seed: int = 0,
    n: int | None = None,
    report: Callable[[str], None] = ignore_progress,
) -> tuple[SystemFit, ...]:
    """Return refits, each in the coordinate system that its events support best by the BIC.

    Args:
        events: The recorded events.
        systems: The coordinate systems to choose from; those that were tried for the base.
        parameters: Parameters of the scenario, in the order of x.
        seed: Seed of the draws and the fits.
        n: Number of refits; None for `N_REFITS`, or `MORE_REFITS` where coordinates or the number of components
            differ among these.
        report: Told of each refit.

    Returns:
        The refits; none where there are fewer than `MIN_CLUSTERS` clusters.

    Raises:
        ValueError: The events are too few.
    """
    if len(np.unique(events.clusters)) < MIN_CLUSTERS:
        return ()
    rng = np.random.default_rng(seed)
    refits: list[SystemFit] = []
    wanted = N_REFITS if n is None else n
    while len(refits) < wanted:
        report(f"refit {len(refits) + 1} of {wanted}")
        drawn = draw_events(events, rng)
        fits = [fit_system(drawn, system, parameters, seed, FOLD_STARTS) for system in systems]
        refits.append(min(fits, key=lambda fit: fit.bic + fit.bic_apart))
        if n is None and len(refits) == N_REFITS and len({each.family for each in refits}) > 1:
            wanted = MORE_REFITS
    return tuple(refits)


def describe_family(family: str, refits: Sequence[SystemFit]) -> str:
    """Return the family of a fit in words, with the share of the refits in the same coordinates if others have others.

    Args:
        family: Components and coordinates of the fit, `SystemFit.family`.
        refits: Its refits.
    """
    systems = Counter(each.system.name for each in refits)
    if len(systems) < 2:
        return family
    counts = ", ".join(f"{number} in {name}" for name, number in systems.most_common())
    return f"{family}; of the refits {counts}"
