"""Predictive checks: dangerous initial states, counted in the recorded events and expected under a base distribution.

A distribution fitted to the bulk of the events may still expect more dangerous states than were recorded, or fewer;
the probability of a collision depends on these states alone.

Example:
    >>> events = np.array([[20.0, 10.0, 30.0], [20.0, 19.0, 2.0]])  # speeds behind and ahead [m/s], gap [m]
    >>> {state.name: int(state.occurs(events[:, 0], events[:, 1], events[:, 2]).sum()) for state in DANGEROUS_STATES}
    {'TTC < 5 s': 2, 'needed deceleration > 1 m/s^2': 1, 'gap < 3 m': 1}
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.fitted import PredictiveCheck
from rare_envs.distributions.space import Distribution
from samplers.problem import FloatArray

CHECK_DRAWS = 200_000
"""Draws from which an expected count is computed; one in 2,000 events then has an error of 10 %."""


@dataclass(frozen=True)
class DangerousState:
    """A condition on three parameters of a scenario."""

    name: str
    occurs: Callable[[FloatArray, FloatArray, FloatArray], NDArray[np.bool_]]
    """Of the three columns that `CHECKED_COLUMNS` names, shape (n,) each."""


DANGEROUS_STATES = (
    DangerousState("TTC < 5 s", lambda v, ahead, gap: v - ahead > gap / 5.0),
    DangerousState("needed deceleration > 1 m/s^2", lambda v, ahead, gap: np.maximum(v - ahead, 0.0) ** 2 > 2.0 * gap),
    DangerousState("gap < 3 m", lambda v, ahead, gap: gap < 3.0),
)
"""Of speed behind, speed ahead [m/s] and gap [m].

The needed deceleration brings a vehicle to the speed ahead within the gap: (closing speed)^2 / (2 gap).
"""
BRAKING_STATES = (
    DangerousState("time headway < 0.5 s", lambda v, deceleration, gap: gap < 0.5 * v),
    DangerousState("deceleration > 3 m/s^2", lambda v, deceleration, gap: deceleration > 3.0),
    DangerousState("gap < 3 m", lambda v, deceleration, gap: gap < 3.0),
)
"""Of the speed of both [m/s], the deceleration ahead [m/s^2] and the gap [m]."""
CHECKED_COLUMNS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "car_following": (("ego_speed", "lead_speed", "gap"),),
    "cut_in": (("ego_speed", "cut_in_speed", "cut_in_gap"), ("cut_in_speed", "lead_speed", "lead_gap")),
    "hard_brake": (("speed", "deceleration", "gap"),),
}
"""Parameters of each pair of vehicles, by scenario."""


def check_predictions(
    scenario: str, names: Sequence[str], events: FloatArray, distribution: Distribution, seed: int = 0
) -> tuple[PredictiveCheck, ...]:
    """Compare recorded with expected counts of dangerous states.

    Args:
        scenario: Name of the scenario.
        names: Its parameters in the order of the columns of x.
        events: Recorded events, shape (n, k), k of the first columns of x.
        distribution: Base distribution of x.
        seed: Seed of the draws.

    Returns:
        One check for each state and pair of vehicles; none for a scenario that is not in `CHECKED_COLUMNS`.
    """
    groups = CHECKED_COLUMNS.get(scenario, ())
    states = BRAKING_STATES if scenario == "hard_brake" else DANGEROUS_STATES
    drawn = np.asarray(distribution.sample(CHECK_DRAWS, np.random.default_rng(seed))) if groups else np.empty((0, 0))
    checks = []
    for group in groups:
        columns = [list(names).index(name) for name in group]
        words = "" if len(groups) == 1 else f", {group[2]}"
        for state in states:
            recorded = int(state.occurs(*events[:, columns].T).sum())
            share = float(state.occurs(*drawn[:, columns].T).mean())
            checks.append(PredictiveCheck(f"{state.name}{words}", recorded, float(f"{share * len(events):.3g}")))
    return tuple(checks)
