"""Refits of a base distribution: the whole fit again, to events drawn anew from the recorded ones.

Whole clusters are drawn with replacement (the bootstrap of Efron and Tibshirani, "An Introduction to the Bootstrap",
1993, chapter 8): events of one scene depend on each other, and resampling them one by one gives intervals that are too
narrow. The number of components is selected anew in each refit; keeping it gives intervals that are too narrow too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.coordinate_mixture import CoordinateMixture
from rare_envs.distributions.space import Parameter
from training.scenario_fitting.coordinate_systems import FOLD_STARTS, CoordinateSystem, fit_system
from training.scenario_fitting.event_filters import EventSet

N_REFITS = 30
"""Refits where all have the same number of components: the noise of log-spread is then .13."""
MIN_CLUSTERS = 5
"""Clusters below which there is nothing to draw anew: refits to so few would all be alike."""
MORE_REFITS = 100
"""Refits where the number of components differs: one refit alone may then carry the spread."""


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
    events: EventSet, system: CoordinateSystem, parameters: Sequence[Parameter], seed: int = 0, n: int | None = None
) -> tuple[CoordinateMixture, ...]:
    """Return refits in one coordinate system.

    Args:
        events: The recorded events.
        system: The coordinates, those of the base.
        parameters: Parameters of the scenario, in the order of x.
        seed: Seed of the draws and the fits.
        n: Number of refits; None for `N_REFITS`, or `MORE_REFITS` where the number of components differs among these.

    Returns:
        The refits; none where there are fewer than `MIN_CLUSTERS` clusters.

    Raises:
        ValueError: The events are too few.
    """
    if len(np.unique(events.clusters)) < MIN_CLUSTERS:
        return ()
    rng = np.random.default_rng(seed)
    refits: list[CoordinateMixture] = []
    wanted = N_REFITS if n is None else n
    while len(refits) < wanted:
        refits.append(fit_system(draw_events(events, rng), system, parameters, seed, FOLD_STARTS).distribution)
        differs = len({len(each.weights) for each in refits}) > 1
        if n is None and len(refits) == N_REFITS and differs:
            wanted = MORE_REFITS
    return tuple(refits)
