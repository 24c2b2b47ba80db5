"""Measures and terms that compiled rollouts on the highway can tell apart, by number."""

from __future__ import annotations

from typing import Any

import numpy as np

from rare_envs.measures.base import Measure
from rare_envs.measures.registry import CLEARANCE, MEASURES, PAIR_CLEARANCE
from rare_envs.measures.terms import find_order
from rare_envs.simulation.measurement import Measurement

BY_TTC, BY_LIDAR, BY_CLEARANCE = range(3)
"""Measures."""
MEASURE_KINDS = {"ttc": BY_TTC, "lidar_ttc": BY_LIDAR, "clearance": BY_CLEARANCE}
"""Their names in `rare_envs.measures.registry.MEASURES`."""
NO_TERMS, DISTANCES, BEAM_TIMES, LEAD_TIMES, PAIR_DISTANCES = range(5)
"""Terms: none, distances to the ego, times along its beams, times to its lead and to the edge, distances of all."""
ORDERS: dict[int, Any] = {
    DISTANCES: CLEARANCE,
    BEAM_TIMES: MEASURES["lidar_ttc"],
    LEAD_TIMES: MEASURES["ttc"],
    PAIR_DISTANCES: PAIR_CLEARANCE,
}
"""The measures whose terms they are."""


def find_measure_kind(measurement: Measurement) -> int | None:
    """Return the number of a measure; None if it is not compiled.

    It is compared by value: one that was sent to another process is a copy.
    """
    own = measurement.episode_measure
    if type(own) is not Measure:
        return None
    return next((kind for name, kind in MEASURE_KINDS.items() if own == MEASURES[name]), None)


def find_term_kind(measurement: Measurement, gamma: float) -> int:
    """Return the number of the terms of a compiled measure for a threshold of f."""
    order, _ = find_order(measurement.episode_measure, measurement.collisions, gamma)
    return next(kind for kind, each in ORDERS.items() if each == order)


def count_terms(kind: int, vehicles: int) -> int:
    """Return the number of terms of a moment with so many vehicles."""
    others = vehicles - 1
    return {
        DISTANCES: others,
        BEAM_TIMES: 2 * others,
        LEAD_TIMES: vehicles,
        PAIR_DISTANCES: vehicles * others // 2,
    }.get(kind, 0)


def find_cut(kind: int) -> float:
    """Return the share of the horizon beyond which a term counts as a late one; infinite without such."""
    cuts = ORDERS[kind].terms.cuts if kind in ORDERS else ()
    return float(cuts[0]) if cuts else np.inf
