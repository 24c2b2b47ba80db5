"""Rules of a learned driver in single precision, and what a vehicle keeps in mind of its lane changes."""

from typing import Any, NamedTuple

from rare_envs.compilation import single
from rare_envs.simulation.compiled.highway.avoidance_lanes import AvoidanceNumbers
from rare_envs.simulation.compiled.highway.dense_driver import DenseDriver
from rare_envs.simulation.compiled.highway.driving_rules.settings import CloseRangeSettings, LaneChangeSettings

PATIENCES, UNSEEN_TIMES = 0, 2
"""Places in a mind, an array of shape (10,): `agents.learned.lane_changes.ChangeState.pack`. Those of the left; behind
each is that of the right."""
CHANGE_SIDE, CHANGE_SHARE, CHANGE_PACE, CHANGE_DISTANCE, HAS_CROSSED, LAST_OFFSET = range(4, 10)
"""Likewise, of the change under way."""


class DriverRules(NamedTuple):
    """Rules of a driver beside its network; what does not apply is of no meaning."""

    eased_beyond: float
    """Deceleration that is given in full [m/s^2]."""
    hard_braking: float
    """Share that is given of what is beyond."""
    least_yaw_rate: float
    """[rad/s], likewise the next."""
    greatest_yaw_rate: float
    avoidance: AvoidanceNumbers
    has_close_range: bool
    close: CloseRangeSettings
    """In single precision, likewise `changes`."""
    has_changes: bool
    changes: LaneChangeSettings

    @classmethod
    def of(cls, driver: DenseDriver) -> "DriverRules":
        """Return the rules of a driver."""
        close, changes = driver.close_range, driver.lane_changes
        eased, hard, low, high = single(driver.eased_beyond, driver.hard_braking, driver.low[1], driver.high[1])
        return cls(
            eased,
            hard,
            low,
            high,
            AvoidanceNumbers.of(driver.avoidance),
            close is not None,
            CloseRangeSettings(*single(*(close or _zeros(CloseRangeSettings)))),
            changes is not None,
            LaneChangeSettings(*single(*(changes or _zeros(LaneChangeSettings)))),
        )


class TrafficRules(NamedTuple):
    """Rules of everybody in a rollout."""

    drivers: DriverRules
    """Of the vehicles around the ego."""
    ego: DriverRules
    """Of no meaning if the ego is no learned driver."""

    @classmethod
    def of(cls, drivers: DenseDriver, ego: Any) -> "TrafficRules | None":
        """Return the rules of everybody; None if nobody has any but plain collision avoidance.

        None is another type to the compiler, which then leaves out all that has to do with these rules: rollouts
        without them need not wait for it.
        """
        learned_ego = ego if isinstance(ego, DenseDriver) else drivers
        if not (has_rules(drivers) or has_rules(learned_ego)):
            return None
        return cls(DriverRules.of(drivers), DriverRules.of(learned_ego))


def has_rules(driver: DenseDriver) -> bool:
    """Return whether a driver has rules but plain collision avoidance."""
    return bool(driver.close_range or driver.lane_changes) or driver.hard_braking != 1.0


def _zeros(settings: type[CloseRangeSettings] | type[LaneChangeSettings]) -> list[float]:
    """Return a 0 for each setting."""
    return [0.0] * len(settings._fields)
