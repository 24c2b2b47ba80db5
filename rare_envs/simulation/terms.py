"""Terms of rollouts: what samplers search by, beside f, in scenarios that several vehicles make dangerous."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.arrays import FloatArray
from rare_envs.measures.terms import TermTracker, find_order
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.world import World


@dataclass(frozen=True, eq=False)
class EpisodeTerms:
    """f of n rollouts and the J terms of the measure by which to search; has what `samplers.Terms` has."""

    f: FloatArray
    """The measure, shape (n,)."""
    values: FloatArray
    """Terms, shape (n, J); f <= gamma exactly where the least of them is at or below the threshold."""
    ticks: NDArray[np.int64]
    """Tick at which each term is attained, shape (n, J)."""
    threshold: float
    """Terms fail at or below it."""
    names: tuple[str, ...]
    """Of the J terms."""

    @property
    def least(self) -> NDArray[np.int64]:
        """Number of the least term, shape (n,)."""
        return np.asarray(self.values.argmin(axis=1), dtype=np.int64)

    @property
    def lowest(self) -> FloatArray:
        """Value of the least term, shape (n,)."""
        return np.asarray(self.values.min(axis=1))


def simulate_terms(world: World, gamma: float, simulate: Callable[[World], Iterable[Episode]]) -> EpisodeTerms:
    """Drive scenarios from start to horizon, and tell the terms of their measure apart.

    Args:
        world: The world, with its measure.
        gamma: Threshold of f.
        simulate: Drives the scenarios in a world and gives the episodes at the horizon, tile by tile.

    Returns:
        f and its terms. A measure that is no least over moments has one term, f itself, known at the horizon.
    """
    own, collisions = world.measurement.episode_measure, world.measurement.collisions
    order, threshold = find_order(own, collisions, gamma)
    tracker = None if order is None else TermTracker(own, order)
    if tracker is not None:
        world = replace(world, measurement=Measurement(tracker, collisions))
    f, values, ticks = [], [], []
    for end in simulate(world):
        f.append(end.f)
        values.append(end.f[:, None] if tracker is None else end.measure_state.values)
        ticks.append(torch.full((len(end.f), 1), world.clock.ticks) if tracker is None else end.measure_state.ticks)
    names = ("f",) if tracker is None else tracker.names(world.scenario.vehicle_names)
    return EpisodeTerms(_join(f), _join(values), torch.cat(ticks).numpy(force=True), threshold, names)


def _join(parts: list[Tensor]) -> FloatArray:
    return torch.cat(parts).double().numpy(force=True)
