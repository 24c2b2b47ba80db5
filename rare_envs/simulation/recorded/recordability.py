"""Recordability: rollouts of which nothing but x changes from one to the next."""

from __future__ import annotations

from typing import Any

from rare_envs.measures import MEASURES
from rare_envs.measures.registry import PAIR_CLEARANCE
from rare_envs.measures.terms import TermTracker
from rare_envs.simulation.rollout import Driver
from rare_envs.simulation.world import World

_OWN = "rare_envs."


def is_recordable(world: World, driver: Driver) -> bool:
    """Return whether a rollout may be recorded once and played with other x.

    What a recording does is fixed, as are the numbers in it. So it is for drivers whose own class says that they never
    change (`says_recordable`), for scenarios and measures of this package, not for what a user wrote.

    Example:
        >>> from rare_envs.control.idm import IDM
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> is_recordable(World(CAR_FOLLOWING), IDM()), is_recordable(World(CAR_FOLLOWING), object())
        (True, False)
    """
    drivers = (driver,) if world.background is None else (driver, world.background)
    steady = all(says_recordable(each) for each in drivers)
    scripts = (world.scenario.initial, world.scenario.others, world.scenario.driven)
    own = all(script is None or str(getattr(script, "__module__", "")).startswith(_OWN) for script in scripts)
    return steady and own and _is_known(world.measurement.episode_measure)


def says_recordable(driver: Any) -> bool:
    """Return whether a driver's own class says that it never changes; what it says is not inherited.

    Example:
        >>> from rare_envs.control.idm import IDM
        >>> class Hesitant(IDM):
        ...     "May do anything."
        >>> says_recordable(IDM()), says_recordable(Hesitant())
        (True, False)
    """
    return "recordable" in vars(type(driver)) and bool(driver.recordable)


def _is_known(measure: Any) -> bool:
    """Return whether a measure is one of this package's, or tells the terms of one apart."""
    if isinstance(measure, TermTracker):
        return _is_known(measure.measure) and _is_known(measure.order)
    return measure is PAIR_CLEARANCE or any(measure is known for known in MEASURES.values())
